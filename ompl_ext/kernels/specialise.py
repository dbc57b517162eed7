"""Compiled kernels of a vehicle: a module is executed with the vehicle's functions as its globals.

`lanes` integrates the planner's edges, `steps` the steps for identification, `shooting` the intervals of the local
optimisation.  What depends on the layout of the state alone is compiled once for all vehicles that share it: the
`checks` of edges, and `gauss_newton` and `riccati` of the local optimisation.  Few methods use `rollouts`, the costs of
a sampling-based controller.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, ParamSpec, TypeAlias, TypeVar

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.kernel_cache import cache_folder, is_marked, mark
from ompl_ext.kernels.functions import FUNCTIONS
from ompl_ext.kernels.search import search
from ompl_ext.vehicle import Vehicle

T = TypeVar("T")
Given = ParamSpec("Given")
FOR_ALL_VEHICLES = ("sst",)  # modules that few methods use and that do not depend on the vehicle
MODEL = "model-complete"
ModelStep: TypeAlias = Callable[[Floats, Floats, Floats, float, Floats], None]
_kernels: dict[str, VehicleKernels] = {}
_steps: dict[str, StepKernels] = {}


class Layout(NamedTuple):
    """Layout of a vehicle's state: number of components and controls, and indices, -1 without such a component."""

    components: int
    controls: int
    x: int
    y: int
    theta: int
    rest: tuple[int, ...]  # components that vanish at standstill, the speed first

    @property
    def key(self) -> str:
        """Name for files and modules."""
        return "_".join(str(k).replace("-", "m") for k in (*self[:-1], *self.rest))


@dataclass(frozen=True)
class VehicleKernels:
    """Compiled functions of one vehicle, see `ompl_ext.kernels.lanes`."""

    advance: ModelStep
    roll_out: Callable[[Floats, Matrix, Floats, Floats], None]
    functions: Ints
    """addresses of those that kernels call, see `ompl_ext.kernels.functions`"""


@dataclass(frozen=True)
class StepKernels:
    """Compiled steps of one vehicle's model, see `steps`; `block` is the length of the working block."""

    linearise: Callable[[Matrix, Matrix, Floats, Floats, Floats, Floats, Matrix, Floats], None]
    simulate: Callable[[Matrix, Floats, Matrix, Matrix, bool, Floats, Floats], None]
    block: int


class _BeingCompiled(threading.local):
    """Subjects for which this thread executes modules, the innermost last."""

    def __init__(self) -> None:
        self.vehicles: list[Vehicle] = []
        self.layouts: list[Layout] = []


_being_compiled = _BeingCompiled()
_loading = threading.RLock()


def _one_at_a_time(function: Callable[Given, T]) -> Callable[Given, T]:
    """The function for one thread at a time: another one would find modules that are executed in part."""

    @wraps(function)
    def waiting(*args: Given.args, **kwargs: Given.kwargs) -> T:
        with _loading:
            return function(*args, **kwargs)

    return waiting


def vehicle_being_compiled() -> Vehicle:
    """Vehicle for which a module is being executed."""
    if not _being_compiled.vehicles:
        raise ImportError("this module is executed once per vehicle; call ompl_ext.kernels.specialise.kernels(vehicle)")
    return _being_compiled.vehicles[-1]


def layout_being_compiled() -> Layout:
    """Layout for which a module is being executed."""
    if not _being_compiled.layouts:
        raise ImportError("this module is executed once per layout of a state; use ompl_ext.kernels.specialise.kernels")
    return _being_compiled.layouts[-1]


def is_cached(vehicle: Vehicle) -> bool:
    """Whether `kernels(vehicle)` loads machine code instead of compiling it."""
    return bool(vehicle.source) and is_marked(_done_marker(vehicle))


def are_steps_cached(vehicle: Vehicle) -> bool:
    """Whether `step_kernels(vehicle)` has or loads machine code instead of compiling it."""
    return _key(vehicle) in _steps or (bool(vehicle.source) and is_marked(_done_marker(vehicle, "steps-complete")))


def is_polish_cached(vehicle: Vehicle) -> bool:
    """Whether `polish_kernels(vehicle)` has or loads machine code instead of compiling it."""
    loaded = _module_name(_key(vehicle), "shooting") in sys.modules
    return loaded or (bool(vehicle.source) and is_marked(_done_marker(vehicle, "polish-complete")))


@_one_at_a_time
def kernels(vehicle: Vehicle) -> VehicleKernels:
    """Compiled kernels of `vehicle`: from this process, else from the cache on disk, else compiled now (seconds).

    Raises:
        numba.core.errors.NumbaError: a function of the vehicle does not compile or returns the wrong shape.
    """
    key = _key(vehicle)
    if key not in _kernels:
        search()
        module, checks = module_of(vehicle, "lanes"), layout_module_of(vehicle, "checks")
        functions = np.zeros(FUNCTIONS, np.int64)
        for number, address in {**module.ADDRESSES, **checks.ADDRESSES}.items():
            functions[number] = address
        _kernels[key] = VehicleKernels(module.advance, module.roll_out, functions)
        if vehicle.source:
            mark(_done_marker(vehicle))
    return _kernels[key]


def is_model_cached(vehicle: Vehicle) -> bool:
    """Whether `model_step(vehicle)` has or loads machine code instead of compiling it."""
    loaded = _module_name(_key(vehicle), "lanes") in sys.modules
    return loaded or is_cached(vehicle) or (bool(vehicle.source) and is_marked(_done_marker(vehicle, MODEL)))


@_one_at_a_time
def model_step(vehicle: Vehicle) -> ModelStep:
    """Compiled step of the model of `vehicle`: `advance` of its kernels, without the search."""
    advance: ModelStep = module_of(vehicle, "lanes").advance
    if vehicle.source:
        mark(_done_marker(vehicle, MODEL))
    return advance


@_one_at_a_time
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
            mark(_done_marker(vehicle, "steps-complete"))
    return _steps[key]


@dataclass(frozen=True)
class PolishKernels:
    """Compiled parts of the local optimisation for one vehicle, see `gauss_newton`, `riccati` and `shooting`."""

    approximate: Callable[..., float]
    evaluate: Callable[..., float]
    replay: Callable[..., int]
    solve: Callable[..., bool]
    intervals: int
    """address of the integration of intervals"""
    block: int
    """length of its working block"""


@_one_at_a_time
def polish_solver(vehicle: Vehicle) -> tuple[ModuleType, ModuleType]:
    """Modules of the local optimisation that need no search: motions of `vehicle`, and the solver of the equations."""
    return module_of(vehicle, "shooting"), layout_module_of(vehicle, "riccati")


@_one_at_a_time
def polish_kernels(vehicle: Vehicle) -> PolishKernels:
    """Compiled local optimisation of `vehicle`: from this process, else from the cache on disk, else compiled now."""
    shooting, solver = polish_solver(vehicle)
    steps = layout_module_of(vehicle, "gauss_newton")
    if vehicle.source:
        mark(_done_marker(vehicle, "polish-complete"))
    address = shooting.ADDRESS
    return PolishKernels(steps.approximate, steps.evaluate, steps.replay, solver.solve, address, shooting.BLOCK)


def is_module_cached(vehicle: Vehicle, source: str) -> bool:
    """Whether `optional_module(vehicle, source)` has or loads machine code instead of compiling it."""
    loaded = _module_name(_key(vehicle), source) in sys.modules
    return loaded or (bool(vehicle.source) and is_marked(_optional_marker(vehicle, source)))


@_one_at_a_time
def optional_module(vehicle: Vehicle, source: str) -> ModuleType:
    """Module of kernels that few methods use, `rollouts` or `sst`: from this process, the cache, or compiled now."""
    kernels(vehicle)  # parts of them are used
    shared = source in FOR_ALL_VEHICLES
    module = importlib.import_module(f"ompl_ext.kernels.{source}") if shared else module_of(vehicle, source)
    if vehicle.source:
        mark(_optional_marker(vehicle, source))
    return module


def _optional_marker(vehicle: Vehicle, source: str) -> Path:
    return _done_marker(vehicle, f"{source}-complete") if source not in FOR_ALL_VEHICLES else cache_folder() / source


@_one_at_a_time
def module_of(vehicle: Vehicle, source: str) -> ModuleType:
    """Module of kernels that was executed for a vehicle, or is now."""
    return sys.modules.get(_module_name(_key(vehicle), source)) or _execute(vehicle, source)


@_one_at_a_time
def layout_module_of(vehicle: Vehicle, source: str) -> ModuleType:
    """Module of kernels that was executed for the layout of a vehicle's state, or is now."""
    layout = _layout(vehicle)
    name = _module_name(layout.key, source)
    module = sys.modules.get(name)
    if module is None:
        module = _execute_as(name, source, _being_compiled.layouts, layout)
    return module


def _layout(vehicle: Vehicle) -> Layout:
    x, y, theta = (vehicle.index(name) for name in ("x", "y", "theta"))
    return Layout(len(vehicle.state), len(vehicle.controls), x, y, theta, vehicle.rest_indices)


def layout_cache_folder(layout: Layout) -> Path:
    """Folder of the machine code for a layout of the state."""
    return cache_folder(f"layout_{layout.key}")


def _module_name(key: str, source: str) -> str:
    return f"ompl_ext.{source}_{key.replace('-', '_')}"


def _key(vehicle: Vehicle) -> str:
    if vehicle.source:
        return vehicle.hash
    functions = vehicle.derivative, vehicle.actuation, vehicle.stop
    return "-".join([vehicle.hash, *(str(id(function)) for function in functions)])


def vehicle_cache_folder(vehicle: Vehicle) -> Path:
    """Folder of the vehicle's machine code; a temporary one of this process for a vehicle without a source file.

    Each vehicle has one of its own: the key of a cached kernel has its own code, not that of the vehicle's functions.
    """
    return cache_folder(vehicle.hash) if vehicle.source else _process_folder() / _key(vehicle)


def _done_marker(vehicle: Vehicle, name: str = "complete") -> Path:
    return cache_folder(vehicle.hash) / name


_temporary: list[tempfile.TemporaryDirectory[str]] = []


def _process_folder() -> Path:
    if not _temporary:
        _temporary.append(tempfile.TemporaryDirectory(prefix="kraft-kernels-"))
    return Path(_temporary[0].name)


def _execute(vehicle: Vehicle, source: str) -> ModuleType:
    return _execute_as(_module_name(_key(vehicle), source), source, _being_compiled.vehicles, vehicle)


def _execute_as(name: str, source: str, being_compiled: list[T], subject: T) -> ModuleType:
    """Execute a file as a separate module: numba's symbols of machine code contain the module's name."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{source}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # numba imports the module by name when it loads cached code
    being_compiled.append(subject)
    try:
        with interrupts_between_passes():
            spec.loader.exec_module(module)
    except BaseException:
        sys.modules.pop(name, None)
        raise
    finally:
        being_compiled.pop()
    return module
