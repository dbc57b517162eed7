"""Parts of kernels: which of them are compiled once for all vehicles."""

from __future__ import annotations

import sys

from support.kernels import ROVER

from ompl_ext.jit import cache_folder, inlined
from ompl_ext.kernels import tree
from ompl_ext.kernels.specialise import kernels


def shared(function: object) -> bool:
    """Whether a part is compiled once for all vehicles."""
    return bool(function.is_shared)  # type: ignore[attr-defined]


def test_only_what_is_the_same_for_every_vehicle_is_shared() -> None:
    kernels(ROVER)
    lanes = next(module for name, module in sys.modules.items() if name.startswith("ompl_ext.lanes_"))
    assert shared(tree.select)
    assert not shared(lanes.propagate)
    assert not shared(lanes.rk4_step)
    assert not shared(ROVER.derivative)


def test_shared_parts_are_kept_beside_the_kernels_of_all_vehicles() -> None:
    kernels(ROVER)
    assert list(cache_folder().rglob("tree.select-*.nbi"))


def test_a_function_from_elsewhere_is_not_shared() -> None:
    def double(x):  # type: ignore[no-untyped-def]
        return 2.0 * x

    assert not shared(inlined(double))
