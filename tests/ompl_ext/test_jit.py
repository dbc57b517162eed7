"""Parts of kernels: which of them are compiled once for all vehicles, and calls by address."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import types
from numba.core.codegen import get_host_cpu_features
from support.kernels import BENCHMARK, ROVER

from ompl_ext.jit import callee, caller, compiled, inlined
from ompl_ext.kernel_cache import cache_folder
from ompl_ext.kernels import tree
from ompl_ext.kernels.functions import BRAKE, CHECK, PROPAGATE
from ompl_ext.kernels.specialise import kernels, layout_module_of, vehicle_cache_folder
from ompl_ext.processor import with_wide_vectors
from ompl_ext.vehicle import Footprint, Vehicle, derivative


def shared(function: object) -> bool:
    """Whether a part is compiled once for all vehicles."""
    return bool(function.is_shared)  # type: ignore[attr-defined]


def test_only_what_is_the_same_for_every_vehicle_is_shared() -> None:
    kernels(ROVER)
    lanes = next(module for name, module in sys.modules.items() if name.startswith("ompl_ext.lanes_"))
    assert shared(tree.select)
    assert not shared(lanes.integrate_lanes)
    assert not shared(lanes.rk4_step)
    assert not shared(ROVER.derivative)


def test_shared_parts_are_kept_beside_the_kernels_of_all_vehicles() -> None:
    kernels(ROVER)
    assert list(cache_folder().rglob("tree.select-*.nbi"))


def test_a_function_from_elsewhere_is_not_shared() -> None:
    def double(x):  # type: ignore[no-untyped-def]
        return 2.0 * x

    assert not shared(inlined(double))


def test_a_kernel_calls_whichever_function_is_at_an_address(tmp_path: Path) -> None:
    signature = types.float64(types.float64, types.float64[::1])
    call = caller(signature)

    def add(x, values):  # type: ignore[no-untyped-def]
        return x + values[0]

    def multiply(x, values):  # type: ignore[no-untyped-def]
        return x * values[0]

    def apply(address, x, values):  # type: ignore[no-untyped-def]
        return call(address, (x, values))

    kernel = compiled(apply, folder=tmp_path, signature=types.float64(types.int64, types.float64, types.float64[::1]))
    addresses = [callee(function, tmp_path, signature) for function in (add, multiply)]
    assert [kernel(address, 3.0, np.array([4.0])) for address in addresses] == [7.0, 12.0]


def test_vehicles_with_the_same_layout_of_the_state_share_its_checks_and_nothing_else() -> None:
    alike, other = replace(BENCHMARK, name="alike", stop=None, manoeuvres=("coast",)), ROVER
    assert layout_module_of(BENCHMARK, "checks") is layout_module_of(alike, "checks")
    assert layout_module_of(BENCHMARK, "checks") is not layout_module_of(other, "checks")
    first, second, third = (kernels(vehicle).functions for vehicle in (BENCHMARK, alike, other))
    assert first[CHECK] == second[CHECK] != third[CHECK]
    assert len({f[number] for f in (first, second, third) for number in (PROPAGATE, BRAKE)}) == 6


def from_a_prompt(gain: float) -> Vehicle:
    """Vehicle whose function has no source, and moves along x at `gain` times its command."""
    names: dict[str, Any] = {"derivative": derivative}
    exec(f"@derivative\ndef motion(x, u, p):\n    return {gain} * u[0], 0.0\n", names)
    return Vehicle("prompt", names["motion"], ("x", "y"), {"v": (0.0, 1.0)}, Footprint(0.4, 0.2), 1.0, rest=())


def rate_kernel(vehicle: Vehicle) -> Callable[[float], float]:
    """Kernel with the code of every vehicle's and this one's function, as `specialise` makes them: rate of x."""
    names: dict[str, Any] = {"__name__": __name__, "derivative": vehicle.derivative}
    code = "def rate(v):\n    return derivative((0.0, 0.0), (v,), (0.0,))[0]\n"
    exec(compile(code, __file__, "exec"), names)
    folder, signature = vehicle_cache_folder(vehicle), types.float64(types.float64)
    kernel: Callable[[float], float] = compiled(names["rate"], folder=folder, signature=signature)
    return kernel


def test_a_vehicle_without_source_has_its_own_machine_code_and_not_that_of_an_earlier_one() -> None:
    vehicles = [from_a_prompt(1.0), from_a_prompt(2.0)]
    assert [vehicle.source for vehicle in vehicles] == ["", ""]
    assert [rate_kernel(vehicle)(0.5) for vehicle in vehicles] == [0.5, 1.0]


def test_vectors_are_wide_only_on_processors_that_keep_their_clock_with_them() -> None:
    assert with_wide_vectors("+avx2,-avx512f,-avx512fp16") is None
    assert with_wide_vectors("+avx2,+avx512f,-avx512fp16") is None
    assert with_wide_vectors("+avx512f,+avx512fp16") == "+avx512f,+avx512fp16,-prefer-256-bit"
    assert with_wide_vectors("") is None


@pytest.mark.parametrize("chosen", [{}, {"NUMBA_CPU_FEATURES": "+avx2"}, {"NUMBA_CPU_NAME": "generic"}])
def test_the_users_choice_of_a_processor_is_kept(chosen: dict[str, str]) -> None:
    code = "import numba; before = numba.config.CPU_FEATURES; import ompl_ext.jit; print(before, numba.config.CPU_FEATURES)"
    environment = {**os.environ, **chosen}
    out = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    before, after = out.stdout.rstrip("\n").split(" ")
    wide = with_wide_vectors(get_host_cpu_features())
    assert after == (before if chosen else str(wide))
