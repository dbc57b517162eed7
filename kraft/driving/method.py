"""A method: planning mode, cycle, budget, safety, estimator and controller, composed in a YAML file.

Each file of `configs/methods/` is one row of a results table; a new method needs only a new file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import Field, PrivateAttr
from pydantic_core import PydanticCustomError

from kraft.config import bundled
from kraft.config.base import BasedFiles
from kraft.config.schema import Name, StrictModel, is_number, refuse
from kraft.config.source import Source
from kraft.config.user_code import split_file
from kraft.driving.control_settings import PREDICTIVE, RATE_MIN, ControllerSettings, OpenLoop, UserCode
from kraft.driving.estimator_settings import Adaptive, EstimatorSettings, Latest
from kraft.driving.planner_settings import PlannerSettings, with_effect
from kraft.errors import Code, Diagnostic, InputError
from kraft.vehicles import check_state
from kraft.vehicles.load import problem_of

if TYPE_CHECKING:
    from ompl_ext.vehicle import Vehicle


class Method(StrictModel):
    """A method file.

    A method that was loaded has the keys of its base, and no `base`.
    """

    base: str | None = Field(default=None, exclude=True)
    """method whose keys those of this file override: a name, or a file relative to this one"""
    name: Name
    """short name of letters, digits, - and _"""
    title: str
    """name in a results table"""
    description: str = ""
    """one sentence for `kraft list methods`"""
    planner: PlannerSettings
    """when and how long to plan"""
    estimator: EstimatorSettings = Latest(kind="latest")
    """where the vehicle is believed to be"""
    controller: ControllerSettings
    """how a plan is tracked"""

    _source: Source = PrivateAttr(default_factory=Source)

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that estimator and controller have what the planner needs."""
        planner, estimator, controller = (
            _section(content.get(name)) for name in ("planner", "estimator", "controller")
        )
        kind = estimator.get("kind", "latest" if "estimator" not in content else None)
        if with_effect(planner).get("bound") is not None and kind not in ("adaptive", None):
            problem = f"needs the uncertainty of the estimate, which the estimator {kind} does not state"
            yield refuse(problem, "expected `estimator: {kind: adaptive}`", ("planner", "bound"), Code.CONFLICT)
        objective = controller.get("objective", "goal" if controller.get("kind") in PREDICTIVE else "plan")
        heads_for_goal = objective == "goal" and controller.get("kind") in (*PREDICTIVE, "code")
        if planner.get("type") == "geodesic" and controller.get("kind") == "code" and not heads_for_goal:
            problem = "is `plan`, but `planner: {type: geodesic}` makes no plan that a vehicle can track"
            expected = "expected `objective: goal` if the class heads for the goal by itself, or another planner"
            yield refuse(problem, expected, ("controller", "objective"), Code.CONFLICT)
        elif planner.get("type") == "geodesic" and not heads_for_goal:
            expected = "expected a controller that has `objective: goal`"
            yield refuse("is a path that no vehicle can track", expected, ("planner", "type"), Code.CONFLICT)
        elif planner.get("type") != "geodesic" and heads_for_goal:
            problem = "is `goal`: the controller tracks no plan"
            expected = "expected `objective: plan`, with which it tracks the plan, or `planner: {type: geodesic}`"
            yield refuse(problem, expected, ("controller", "objective"), Code.CONFLICT)
        yield from _too_slow(planner, controller)

    @property
    def source(self) -> Source:
        """Position of each value in the file."""
        return self._source


def _section(value: object) -> Mapping[str, object]:
    """Keys of a section, as it was written or as it was read; none if it is neither."""
    if isinstance(value, StrictModel):
        return dict(value)
    return value if isinstance(value, Mapping) else {}


def _too_slow(planner: Mapping[str, object], controller: Mapping[str, object]) -> Iterator[PydanticCustomError]:
    """Problem of a controller that sends no command in some cycles, whose decisions nothing tracks then, if it does."""
    rate = controller.get("rate_hz", OpenLoop.model_fields["rate_hz"].default)
    given = (planner.get("cycle", PlannerSettings.model_fields["cycle"].default), planner.get("clock_cycle"))
    cycles = [cycle for cycle in given if is_number(cycle) and cycle > 0]
    if planner.get("mode") != "replanning" or not cycles or not is_number(rate):
        return
    least = 1.0 / min(cycles)
    # slower than `RATE_MIN` is refused by itself; the share is for the rounding of 1 / cycle
    if least > RATE_MIN and rate < least * (1.0 - 1e-9):
        problem = f"is {rate:g}, less than one command in each cycle of {min(cycles):g} s"
        yield refuse(problem, f"expected at least {least:.6g}", ("controller", "rate_hz"), Code.CONFLICT)


METHOD_FILES: Final = BasedFiles("method", Method, ("name", "title", "description"))


def load_method(name_or_path: str | Path) -> Method:
    """Load a bundled method (``kraft``) or a method file, with the keys of its base.

    Raises:
        InputError: with every problem of the file and of its base, or if there is no such name or file.
    """
    method, document = METHOD_FILES.read(bundled.find("method", name_or_path))
    if isinstance(method.controller, UserCode):
        method = method.model_copy(update={"controller": _with_place(method.controller, document.source)})
    method._source = document.source  # frozen fields stay as they are; this is where they came from
    return method


def _with_place(controller: UserCode, source: Source) -> UserCode:
    """Controller in code whose file is absolute; in a method file it is relative to that file.

    Raises:
        InputError: if there is no such file.
    """
    code = split_file(controller.code)
    if code is None:
        return controller
    file = source.folder("controller.code") / code[0]
    if not file.is_file():
        problem, expected = f"there is no file {file}", "expected the path of a Python file"
        raise InputError([source.diagnostic("controller.code", problem, expected, code=Code.NOT_FOUND)])
    return controller.model_copy(update={"code": f"{file.resolve()}:{code[1]}"})


RANGES_IN_CODE: Final = (
    "ranges={name: ParameterRange(low, high, std)} with ParameterRange of ompl_ext.vehicle, std 0 and both bounds the "
    "value if that is known"
)
"""How a vehicle in code states what is known of its parameters before a drive."""


def check_vehicle(method: Method, vehicle: Vehicle, *, own: bool) -> None:
    """Check that a vehicle has what the method's estimator needs; `own` is whether the method itself names it.

    Raises:
        InputError: if the vehicle's state lacks a pose or a speed, or if parameters are to be estimated whose ranges it
            does not state; at the line of the method that names the vehicle, if one does.
    """
    check_state(vehicle)
    if not isinstance(method.estimator, Adaptive):
        return
    problem = unstated_ranges(vehicle, f"the method {method.name}")
    if problem is not None and own:
        what = f"{vehicle.name} {problem.problem}"
        raise InputError([method.source.diagnostic("planner.vehicle", what, problem.expected, code=problem.code)])
    if problem is not None:
        raise InputError([problem])


def unstated_ranges(vehicle: Vehicle, estimates: str) -> Diagnostic | None:
    """Why the parameters of a vehicle cannot be estimated while it drives, at its file; None if they can.

    `estimates` is what estimates them, as in a sentence.
    """
    reason = f"because {estimates} estimates parameters while it drives"
    if not vehicle.parameters:
        return Diagnostic(vehicle.name, "has no parameters", f"expected at least one, {reason}", code=Code.MISSING)
    missing = ", ".join(name for name in vehicle.parameters if name not in vehicle.ranges)
    if not missing:
        return None
    problem = f"states no min, max and std of {missing}"
    if vehicle.file:
        expected = f"expected each parameter with these, or with `fixed: true` if its value is known, {reason}"
    else:
        expected = f"expected {RANGES_IN_CODE}, or a vehicle file that states them, {reason}"
    return problem_of(vehicle, "parameters", problem, expected, Code.MISSING)
