"""Vehicle model of the planner: derivative function, bounds, footprint, stopping manoeuvres."""

from __future__ import annotations

import copy
import hashlib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from numbers import Real
from typing import Any

import numpy as np

from ompl_ext.arrays import Floats
from ompl_ext.fingerprint import fingerprint
from ompl_ext.jit import inlined
from ompl_ext.names import FORCE, SYMBOL

MAX_MANOEUVRES = 32  # they are simulated together as lanes
derivative = inlined  # decorator of a vehicle's functions


@dataclass(frozen=True)
class Footprint:
    """Rectangle of the vehicle in the plane, its centre `offset` m ahead of the body frame."""

    length: float
    width: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        """Check the rectangle.

        Raises:
            ValueError: a size is not a positive, or the offset not a finite number.
        """
        numbers = all(map(_is_finite, (self.length, self.width, self.offset)))
        if not (numbers and self.length > 0 and self.width > 0 and math.isfinite(self.length * self.width)):
            raise ValueError(f"footprint sizes must be positive and finite, got {self}")

    @property
    def reach(self) -> float:
        """Distance from the body frame's origin to the farthest corner (m)."""
        return math.hypot(self.length / 2 + abs(self.offset), self.width / 2)

    @property
    def inscribed(self) -> float:
        """Radius of the largest disc around the origin inside the rectangle (m), 0 if the origin is outside."""
        return max(0.0, min(self.width / 2, self.length / 2 - abs(self.offset)))

    @property
    def ends(self) -> tuple[float, float]:
        """Place of the rear and of the front along the body frame's x axis (m)."""
        return self.offset - self.length / 2, self.offset + self.length / 2

    def with_margin(self, margin: float) -> Footprint:
        """Rectangle that is larger by a margin (m) on each side."""
        return replace(self, length=self.length + 2.0 * margin, width=self.width + 2.0 * margin)

    def corners(self) -> Floats:
        """Corners counter-clockwise in the body frame, shape (4, 2)."""
        (rear, front), side = self.ends, self.width / 2
        return np.array([[front, -side], [front, side], [rear, side], [rear, -side]])


@dataclass(frozen=True)
class ParameterRange:
    """Bounds of a parameter and the standard deviation of its prior, which is centred at its value; and its unit."""

    low: float
    high: float
    std: float
    unit: str = ""

    @property
    def is_known(self) -> bool:
        """Whether the parameter is known: the bounds are its value, and its standard deviation is 0."""
        return self.std == 0.0 and self.low == self.high


@dataclass(frozen=True)
class OpenLoopErrors:
    """Root mean square errors of open-loop predictions `after` (n,) s: `along` and `across` the vehicle (m), `yaw`.

    `speeds` are the lowest and the highest mean speed of the drives, m/s.
    """

    speeds: tuple[float, float]
    after: tuple[float, ...]
    along: tuple[float, ...]
    across: tuple[float, ...]
    yaw: tuple[float, ...]

    def __post_init__(self) -> None:
        """Take any sequences of numbers.

        Raises:
            ValueError: with every problem.
        """
        low, high = pair(self.speeds)
        after = _numbers(self.after)
        problems = []
        if not 0.0 <= low <= high < math.inf:
            problems.append(f"speeds need 0 <= low <= high, finite, got {self.speeds}")
        if not after or not all(0.0 < each < math.inf for each in after) or list(after) != sorted(set(after)):
            problems.append(f"after needs positive times, ascending, at least one, got {self.after}")
        for name in ("along", "across", "yaw"):
            stated = getattr(self, name)
            values = _numbers(stated)
            if len(values) != len(after) or not all(0.0 <= each < math.inf for each in values):
                problems.append(f"{name} needs a finite number of at least 0 for each time in after, got {stated}")
        if problems:
            raise ValueError("open-loop errors: " + "; ".join(problems))
        object.__setattr__(self, "speeds", (low, high))
        for name in ("after", "along", "across", "yaw"):
            object.__setattr__(self, name, _numbers(getattr(self, name)))


@dataclass(frozen=True)
class Vehicle:
    """Vehicle model: functions, names and bounds of its components, footprint, parameters.

    The functions are decorated with `@derivative` and written over plain tuples of floats, with `sin`, `cos`, `tan`,
    `atan` from `ompl_ext`:

    - `derivative(x, u, p)` returns dx/dt for state `x`, control `u`, parameters `p`.
    - `actuation(u, p)`, optional, maps the control to the inputs that `derivative` receives instead.  Controls are
      constant along an edge, so that what depends on them alone is computed once per edge instead of at every stage.
      `inputs` are the names of its results.
    - `stop(x, p, k)`, optional, is contingency manoeuvre number k as a control law, for k in range(len(manoeuvres)).
      By default the one manoeuvre is the zero control.

    Units are SI; angles in radians.
    """

    name: str
    derivative: Callable[..., Any]
    state: tuple[str, ...]
    controls: Mapping[str, tuple[float, float]]
    footprint: Footprint
    top_speed: float
    parameters: Mapping[str, float] = field(default_factory=dict)
    actuation: Callable[..., Any] | None = None
    inputs: tuple[str, ...] = ()
    stop: Callable[..., Any] | None = None
    manoeuvres: tuple[str, ...] = ("coast",)
    rest: tuple[str, ...] = ("v",)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ranges: Mapping[str, ParameterRange] = field(default_factory=dict)
    """of the parameters that may be estimated while the vehicle drives; planning does not use them"""
    gravity_share: float | None = None
    """share of gravity along a slope that accelerates the vehicle, the rest the drive takes; None if it is not known

    The force itself is the parameters `FORCE`.
    """
    delay: tuple[float, float] | None = None
    """delay of commands and its standard deviation (s), which only estimators use; None if it is not known"""
    errors_by_speed: tuple[OpenLoopErrors, ...] = ()
    """of predictions of drives that were not fitted, from slow to fast ones; estimators and measured bounds use them"""
    file: str = field(default="", compare=False)
    """file that its numbers were read from, for messages; empty for a vehicle in code alone"""

    def __post_init__(self) -> None:
        """Take any sequences.

        Raises:
            ValueError: with every problem.
        """
        problems = list(_type_problems(self))
        if not problems:  # the other checks read what these are about
            for kind in (*_NAMES, "errors_by_speed"):
                object.__setattr__(self, kind, tuple(getattr(self, kind)))
            problems = [*_shape_problems(self), *_repetitions(self), *_number_problems(self), *_range_problems(self)]
        if problems:
            raise ValueError(f"vehicle {self.name!r}: " + "; ".join(problems))

    def with_parameters(self, values: Mapping[str, float]) -> Vehicle:
        """Vehicle with some parameters replaced.

        Raises:
            KeyError: a name is not a parameter.
            ValueError: a value is not a finite number.
        """
        unknown = sorted(set(values) - set(self.parameters))
        if unknown:
            raise KeyError(f"{self.name} has no parameter {', '.join(unknown)}; it has {', '.join(self.parameters)}")
        changed = copy.copy(self)  # with what is known of it: nothing else depends on the values
        vars(changed)["parameters"] = {**self.parameters, **values}
        if problems := list(_parameter_problems(changed)):
            raise ValueError(f"vehicle {self.name!r}: " + "; ".join(problems))
        return changed

    def index(self, component: str) -> int:
        """Index of a state component, -1 if the vehicle has none of that name."""
        return self.state.index(component) if component in self.state else -1

    @cached_property
    def source(self) -> str:
        """Text of everything that the functions depend on; empty without source (functions from a prompt)."""
        return _source(tuple(f for f in (self.derivative, self.actuation, self.stop) if f is not None))

    @cached_property
    def hash(self) -> str:
        """Hash over everything that the compiled kernels depend on, which excludes parameter values and bounds."""
        shape = (self.state, tuple(self.controls), tuple(self.parameters), self.inputs, self.manoeuvres, self.rest,
                 tuple(self.limits))  # fmt: skip
        names = [getattr(f, "__qualname__", None) for f in (self.derivative, self.actuation, self.stop)]
        return hashlib.sha256(repr((self.source, shape, names)).encode()).hexdigest()[:16]

    @property
    def control_bounds(self) -> Floats:
        """Lower and upper bounds of each control, shape (controls, 2)."""
        return np.array(list(self.controls.values()), dtype=float).reshape(-1, 2)

    @property
    def state_limits(self) -> Floats:
        """Lower and upper limits of each state component, infinite without a limit, shape (states, 2)."""
        free = (-math.inf, math.inf)
        return np.array([self.limits.get(name, free) for name in self.state])

    @property
    def parameter_array(self) -> Floats:
        """Parameter values in their order, shape (max(1, parameters),)."""
        return np.array(list(self.parameters.values()) or [0.0], dtype=float)

    @cached_property
    def rest_indices(self) -> tuple[int, ...]:
        """State components that vanish at standstill; the first one is the speed."""
        return tuple(self.state.index(name) for name in self.rest)


@cache
def _source(functions: tuple[Callable[..., Any], ...]) -> str:
    """Text of everything that some functions depend on when it is first asked for; empty without source."""
    try:
        return "\n".join(fingerprint(function) for function in functions)
    except OSError:  # compiled in every process, never cached
        return ""


_NAMES = ("state", "inputs", "manoeuvres", "rest")


def _type_problems(vehicle: Vehicle) -> Iterator[str]:
    """Values of another type than the annotated one, up to those within mappings."""
    if not isinstance(vehicle.name, str) or not vehicle.name:
        yield f"name must be a text, got {vehicle.name!r}"
    for kind in _NAMES:
        names = getattr(vehicle, kind)
        if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(n, str) for n in names):
            yield f"{kind} must be a tuple of names, got {names!r}"
    for kind in ("controls", "parameters", "limits", "ranges"):
        if not isinstance(getattr(vehicle, kind), Mapping):
            yield f"{kind} must be a dictionary, got {getattr(vehicle, kind)!r}"
    for kind in ("derivative", "actuation", "stop"):
        function, optional = getattr(vehicle, kind), kind != "derivative"
        if not (callable(function) or (function is None and optional)):
            yield f"{kind} must be a function{' or None' if optional else ''}, got {function!r}"
    if not isinstance(vehicle.footprint, Footprint):
        yield f"footprint must be a Footprint, got {vehicle.footprint!r}"
    errors = vehicle.errors_by_speed
    if not isinstance(errors, Sequence) or not all(isinstance(each, OpenLoopErrors) for each in errors):
        yield f"errors_by_speed must be a tuple of OpenLoopErrors, got {errors!r}"


def _name_problems(vehicle: Vehicle) -> Iterator[str]:
    """Names that no file and no option can state: vehicle files, goals and `--param` refer to them."""
    kinds = (("state", vehicle.state), ("controls", vehicle.controls), ("parameters", vehicle.parameters))
    for kind, names in kinds:
        wrong = [name for name in names if not (isinstance(name, str) and re.fullmatch(SYMBOL, name))]
        if wrong:
            yield f"names of {kind} need letters, digits and _, no digit first, got {', '.join(map(repr, wrong))}"


def _shape_problems(vehicle: Vehicle) -> list[str]:
    problems = list(_name_problems(vehicle))
    if not {"x", "y"} <= set(vehicle.state):
        problems.append(f"state needs components named x and y (and theta if it turns), got {vehicle.state}")
    for name, bounds in vehicle.controls.items():
        low, high = pair(bounds)
        if not -math.inf < low < high < math.inf:
            problems.append(f"control {name} needs finite bounds with low < high, got {bounds}")
    for kind, names in (("rest", vehicle.rest), ("limits", vehicle.limits)):
        for name in names:
            if name not in vehicle.state:
                problems.append(f"{kind} names {name!r}, which is not a state component")
    if not (_is_finite(vehicle.top_speed) and vehicle.top_speed > 0):
        problems.append(f"top_speed must be positive and finite, got {vehicle.top_speed!r}")
    problems += [] if vehicle.controls else ["controls are empty"]
    if (vehicle.actuation is None) != (not vehicle.inputs):
        problems.append("actuation and the names of its outputs, inputs, go together")
    if len(vehicle.manoeuvres) > MAX_MANOEUVRES:
        problems.append(f"there are {len(vehicle.manoeuvres)} manoeuvres, at most {MAX_MANOEUVRES} are possible")
    if not vehicle.manoeuvres:
        problems.append("manoeuvres are empty: a vehicle needs a way to stop")
    if vehicle.stop is None and len(vehicle.manoeuvres) > 1:
        problems.append("several manoeuvres need a stop(x, p, k) function")
    return problems


def _repetitions(vehicle: Vehicle) -> Iterator[str]:
    """Names that stand for two things: a contingency, above all, is known by the name of its manoeuvre."""
    for kind, what, names in (
        ("state", "a component", vehicle.state),
        ("rest", "a component", vehicle.rest),
        ("inputs", "an input", vehicle.inputs),
        ("manoeuvres", "a manoeuvre", vehicle.manoeuvres),
    ):
        if len(set(names)) != len(names):
            yield f"{kind} names {what} twice: {names}"


def _number_problems(vehicle: Vehicle) -> Iterator[str]:
    """Parameters that are not numbers, limits that no state keeps, and what is stated for estimators."""
    yield from _parameter_problems(vehicle)
    for name, bounds in vehicle.limits.items():
        low, high = pair(bounds)
        if not low < high:
            yield f"the limits of {name} need low < high, got {bounds}"
    if vehicle.gravity_share is not None:
        if not (_is_finite(vehicle.gravity_share) and 0.0 < vehicle.gravity_share <= 1.0):
            yield f"gravity_share must be above 0 and at most 1, got {vehicle.gravity_share!r}"
        if missing := [name for name in FORCE if name not in vehicle.parameters]:
            yield f"gravity_share needs the parameters {' and '.join(FORCE)}, there is no {' and no '.join(missing)}"
    if vehicle.delay is not None:
        value, std = pair(vehicle.delay)
        if not (0.0 <= value < math.inf and 0.0 < std < math.inf):
            yield f"delay needs a value of at least 0 s and a positive std, both finite, got {vehicle.delay}"


def _parameter_problems(vehicle: Vehicle) -> Iterator[str]:
    for name, value in vehicle.parameters.items():
        if not _is_finite(value):
            yield f"parameter {name} needs a finite number, got {value!r}"


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def pair(values: object) -> tuple[float, float]:
    """Two numbers, NaN if the values are anything else."""
    numbers = _numbers(values)
    return (numbers[0], numbers[1]) if len(numbers) == 2 else (math.nan, math.nan)


def _numbers(values: object) -> tuple[float, ...]:
    """A sequence of numbers, of which what is no number is NaN; empty if it is no sequence."""
    if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray):
        return ()
    return tuple(float(each) if isinstance(each, Real) else math.nan for each in values)


def _range_problems(vehicle: Vehicle) -> list[str]:
    unknown = [name for name in vehicle.ranges if name not in vehicle.parameters]
    problems = [f"ranges names {name!r}, which is not a parameter" for name in unknown]
    for name, allowed in vehicle.ranges.items():
        if not isinstance(allowed, ParameterRange):
            problems.append(f"the range of {name} needs a ParameterRange, got {allowed!r}")
        elif not (allowed.is_known or _is_uncertain(allowed)):
            problems.append(f"the range of {name} needs finite low < high and a finite positive std, got {allowed}")
    return problems


def _is_uncertain(allowed: ParameterRange) -> bool:
    numbers = allowed.low, allowed.high, allowed.std
    return all(map(_is_finite, numbers)) and allowed.low < allowed.high and allowed.std > 0
