"""Parts of kernels: which of them are compiled once for all vehicles."""

from __future__ import annotations

import sys

from support.kernels import ROVER

from ompl_ext.jit import cache_folder, inlined
from ompl_ext.kernels import tree
from ompl_ext.kernels.specialise import kernels


def cached(function: object) -> bool:
    """Whether numba keeps the machine code of a part."""
    return type(function._cache).__name__ != "NullCache"  # type: ignore[attr-defined]


def test_only_what_is_the_same_for_every_vehicle_is_shared() -> None:
    kernels(ROVER)
    lanes = next(module for name, module in sys.modules.items() if name.startswith("ompl_ext.lanes_"))
    assert cached(tree.select)
    assert not cached(lanes.propagate)
    assert not cached(lanes.rk4_step)
    assert not cached(ROVER.derivative)


def test_shared_parts_are_kept_beside_the_kernels_of_all_vehicles() -> None:
    kernels(ROVER)
    assert list(cache_folder().rglob("tree.select-*.nbi"))


def test_a_function_from_elsewhere_is_not_shared() -> None:
    def double(x):  # type: ignore[no-untyped-def]
        return 2.0 * x

    assert not cached(inlined(double))
