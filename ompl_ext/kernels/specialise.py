"""Compiled kernels of a vehicle: a module is executed with the vehicle's functions as its globals.

`lanes` has the planner's kernels; `steps` has only the model's steps, for identification; `gauss_newton` and `riccati`
have the local optimisation.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from ompl_ext.arrays import Floats, IntMatrix32, Matrix, Matrix32, Words16Matrix
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.jit import cache_folder
from ompl_ext.kernels.kernel_types import Lanes, Problem, Retained, Tree
from ompl_ext.vehicle import Vehicle

_being_compiled: list[Vehicle] = []
_kernels: dict[str, VehicleKernels] = {}
_steps: dict[str, StepKernels] = {}


@dataclass(frozen=True)
class VehicleKernels:
    """Compiled functions of one vehicle, see `ompl_ext.kernels.lanes`."""

    grow: Callable[[Tree, Problem, Lanes, Lanes, Floats, Retained, int], None]
    edge: Callable[[Problem, Lanes, float], None]
    brake: Callable[[Problem, Lanes, Lanes, float], int]
    advance: Callable[[Floats, Floats, Floats, float, Floats], None]
    roll_out: Callable[[Floats, Matrix, Floats, Floats], None]
    pose: Callable[[Matrix32, IntMatrix32, Words16Matrix, Floats, Floats, float, float, float], float]


@dataclass(frozen=True)
class StepKernels:
    """Compiled steps of one vehicle's model, see `steps`; `block` is the length of the working block."""

    linearise: Callable[[Matrix, Matrix, Floats, Floats, Floats, Floats, Matrix, Floats], None]
    simulate: Callable[[Matrix, Floats, Matrix, Floats, Floats, Floats], None]
    block: int


def vehicle_being_compiled() -> Vehicle:
    """Vehicle for which a module is being executed."""
    if not _being_compiled:
        raise ImportError("this module is executed once per vehicle; call ompl_ext.kernels.specialise.kernels(vehicle)")
    return _being_compiled[-1]


def is_cached(vehicle: Vehicle) -> bool:
    """Whether `kernels(vehicle)` loads machine code instead of compiling it."""
    return bool(vehicle.source) and _done_marker(vehicle).exists()


def are_steps_cached(vehicle: Vehicle) -> bool:
    """Whether `step_kernels(vehicle)` has or loads machine code instead of compiling it."""
    return _key(vehicle) in _steps or (bool(vehicle.source) and _done_marker(vehicle, "steps-complete").exists())


def is_polish_cached(vehicle: Vehicle) -> bool:
    """Whether `polish_kernels(vehicle)` has or loads machine code instead of compiling it."""
    loaded = _module_name(vehicle, "gauss_newton") in sys.modules
    return loaded or (bool(vehicle.source) and _done_marker(vehicle, "polish-complete").exists())


def kernels(vehicle: Vehicle) -> VehicleKernels:
    """Compiled kernels of `vehicle`: from this process, else from the cache on disk, else compiled now (seconds).

    Raises:
        numba.core.errors.NumbaError: a function of the vehicle does not compile or returns the wrong shape.
    """
    key = _key(vehicle)
    if key not in _kernels:
        module = _execute(vehicle, "lanes")
        names = VehicleKernels.__dataclass_fields__
        _kernels[key] = VehicleKernels(**{name: getattr(module, name) for name in names})
        if vehicle.source:
            _done_marker(vehicle).touch()
    return _kernels[key]


def step_kernels(vehicle: Vehicle) -> StepKernels:
    """Compiled model steps of `vehicle`: from this process, else from the cache on disk, else compiled now.

    Raises:
        numba.core.errors.NumbaError: the derivative does not compile or returns the wrong shape.
    """
    key = _key(vehicle)
    if key not in _steps:
        module = _execute(vehicle, "steps")
        _steps[key] = StepKernels(module.linearise, module.simulate, module.BLOCK)
        if vehicle.source:
            _done_marker(vehicle, "steps-complete").touch()
    return _steps[key]


@dataclass(frozen=True)
class PolishKernels:
    """Compiled parts of the local optimisation for one vehicle, see `gauss_newton` and `riccati`."""

    approximate: Callable[..., None]
    evaluate: Callable[..., float]
    replay: Callable[..., int]
    solve: Callable[..., bool]
    block: int


def polish_kernels(vehicle: Vehicle) -> PolishKernels:
    """Compiled local optimisation of `vehicle`: from this process, else from the cache on disk, else compiled now."""
    kernels(vehicle)  # parts of them are used
    steps, solver = (module_of(vehicle, name) for name in ("gauss_newton", "riccati"))
    if vehicle.source:
        _done_marker(vehicle, "polish-complete").touch()
    return PolishKernels(steps.approximate, steps.evaluate, steps.replay, solver.solve, steps.BLOCK)


def module_of(vehicle: Vehicle, source: str) -> ModuleType:
    """Module of kernels that was executed for a vehicle, or is now."""
    return sys.modules.get(_module_name(vehicle, source)) or _execute(vehicle, source)


def _module_name(vehicle: Vehicle, source: str) -> str:
    return f"ompl_ext.{source}_{_key(vehicle).replace('-', '_')}"


def _key(vehicle: Vehicle) -> str:
    return vehicle.hash if vehicle.source else f"{vehicle.hash}-{id(vehicle.derivative)}"


def vehicle_cache_folder(vehicle: Vehicle) -> Path:
    """Folder of the vehicle's machine code; a temporary one of this process for a vehicle without a source file."""
    if vehicle.source:
        return cache_folder(vehicle.hash)
    return _process_folder()


def _done_marker(vehicle: Vehicle, name: str = "complete") -> Path:
    return cache_folder(vehicle.hash) / name


_temporary: list[tempfile.TemporaryDirectory[str]] = []


def _process_folder() -> Path:
    if not _temporary:
        _temporary.append(tempfile.TemporaryDirectory(prefix="kraft-kernels-"))
    return Path(_temporary[0].name)


def _execute(vehicle: Vehicle, source: str) -> ModuleType:
    """Execute a file as a separate module: numba's symbols of machine code contain the module's name."""
    name = _module_name(vehicle, source)
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{source}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # numba imports the module by name when it loads cached code
    _being_compiled.append(vehicle)
    try:
        with interrupts_between_passes():
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        _being_compiled.pop()
    return module
