"""A method: planning mode, cycle, budget, safety, estimator and controller, composed in a YAML file.

Each file of `configs/methods/` is one row of a results table; a new method needs only a new file.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import Field, PrivateAttr, model_validator
from pydantic_core import PydanticCustomError

from kraft.config import bundled
from kraft.config.base import BasedFiles
from kraft.config.schema import (
    Name,
    NonNegative,
    Positive,
    Probability,
    StrictModel,
    is_number,
    refuse,
)
from kraft.config.source import Source
from kraft.config.user_code import split_file
from kraft.driving.control_settings import (  # fmt: skip
    PREDICTIVE,
    RATE_MIN,
    ControllerSettings,
    Deviation,
    OpenLoop,
    Seconds,
    UserCode,
)
from kraft.errors import Code, Diagnostic, InputError
from kraft.vehicles import check_state
from kraft.vehicles.load import problem_of

if TYPE_CHECKING:
    from ompl_ext.vehicle import Vehicle


class Clearance(StrictModel):
    """SAFETY's clearance: delta(v) = delta + delta_per_speed |v|."""

    delta: NonNegative = 0.05
    """clearance at rest, m"""
    delta_per_speed: NonNegative = 0.25
    """clearance added per unit of speed, m per m/s"""
    foresight: NonNegative = 0.0
    """time for which a plan keeps the clearance, if that is longer than the cycle, s"""


class CalibratedBound(StrictModel):
    """SAFETY's clearance from the estimator's covariance, calibrated while the vehicle drives: delta(t, v)."""

    level: Annotated[Probability, Field(ge=0.5, le=0.9999)] = 0.99
    """share of the deviations that the bound shall hold"""
    growth: NonNegative = 0.008
    """standard deviation that the prediction gains in a second, m/s"""
    horizon: Seconds = 1.5
    """time after which the deviation grows no further, because the controller corrects it, s"""
    initial: Positive = 1.0
    """scale of the bound before deviations are observed"""
    prior_cycles: Positive = 5.0
    """number of cycles that the initial scale counts for"""
    memory_cycles: Annotated[float, Field(ge=2, le=1e6)] = 30.0
    """number of cycles after which an observed deviation has lost most of its weight"""
    expected_ratio: Deviation = 0.2
    """root mean square of observed deviations over the bound where the stated covariance is right"""
    limits: tuple[Positive, Positive] = (0.85, 2.5)
    """least and largest scale"""
    shares: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = (1.0, 0.7, 0.45, 0.25)
    """shares of the bound that plans keep: the first one that leaves a way to the goal"""
    recheck: Probability = 0.5
    """share of the clearance of a plan that suffices when it is checked again, from a newer estimate"""
    foresight: NonNegative = 0.0
    """time for which a plan keeps the clearance, if that is longer than the cycle, s"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check the order of the limits and of the shares."""
        limits, shares = (_numbers(content.get(name)) for name in ("limits", "shares"))
        if len(limits) == 2 and limits[0] >= limits[1]:
            problem = f"the interval [{limits[0]:g}, {limits[1]:g}] is empty or inverted"
            yield refuse(problem, "expected [least, largest] with least < largest", ("limits",), Code.CONFLICT)
        for k, (larger, smaller) in enumerate(itertools.pairwise(shares), 1):
            if smaller >= larger:
                problem = f"is {smaller:g}, not less than the share before it"
                yield refuse(problem, f"expected less than {larger:g}", ("shares", k), Code.CONFLICT)


def _numbers(value: object) -> tuple[float, ...]:
    """Numbers of a list; none if not all of its items are numbers."""
    items = tuple(value) if isinstance(value, list | tuple) else ()
    return items if all(is_number(item) for item in items) else ()


OF_CONTINGENCIES: Final = frozenset({"safety", "bound", "recover", "on_board", "contingencies", "watchdog"})
"""Settings of a planner that a method without contingencies ignores."""
ITERATIONS_MAX: Final = 1_000_000_000
"""Largest budget of a plan."""
RESERVE = 0.2
"""Share of a cycle that real-time planning leaves unused, as in the original system."""


class PlannerSettings(StrictModel):
    """When and how long to plan."""

    type: Literal["dirt", "sst", "geodesic"] = "dirt"
    """what plans: the tree planners `dirt` or `sst`, or nothing but the path of least cost-to-go, `geodesic`"""
    mode: Literal["one-shot", "replanning"]
    """`one-shot` plans once before it drives, `replanning` in every cycle"""
    cycle: Seconds = 1.0
    """duration of a replanning cycle, s"""
    clock_cycle: Seconds | None = None
    """duration of a cycle on the wall clock, where decisions have to be early; `cycle` if it is left out, s"""
    lead: NonNegative = 0.1
    """how long before a cycle ends its plan is checked again and sent, s"""
    iterations: Annotated[int, Field(ge=1, le=ITERATIONS_MAX)] = 1000
    """planning budget of a cycle, or of the one plan, in iterations"""
    max_iterations: Annotated[int, Field(ge=1, le=ITERATIONS_MAX)] | None = None
    """largest budget of a cycle, used while the plan is not settled; `iterations` if left out"""
    first_iterations: Annotated[int, Field(ge=1, le=ITERATIONS_MAX)] | None = None
    """planning budget of the first plan, before the vehicle drives; `iterations` if left out"""
    first_max_iterations: Annotated[int, Field(ge=1, le=ITERATIONS_MAX)] | None = None
    """largest budget of the first plan, used while it is not settled; twice `first_iterations` if left out"""
    retain: Literal["plan", "tree"] = "plan"
    """what a cycle retains of the last one: the remainder of its `plan`, or that corrected, with its `tree`"""
    switch_gain: NonNegative = 0.0
    """cost that a plan which goes another way than the last one must save, s"""
    cost_to_go: Literal["position", "pose"] = "position"
    """what guides the search: the shortest way of a `position`, or of a `pose`, which knows how the vehicle turns"""
    polish: bool | None = None
    """whether plans are improved by local optimisation; if it is left out, only those to a goal with a heading"""
    patience: Seconds = 0.5
    """how old the newest observation may be when a plan is committed, s"""
    margin: NonNegative = 0.0
    """distance that every part of a plan keeps from obstacles: the footprint is planned that much larger, m"""
    goal_margin: NonNegative = 0.0
    """how much smaller the region is that the planner aims for, m; half the tolerances if the goal has limits too"""
    safety: Clearance | None = None
    """clearance of plans and contingencies in the coming cycle; without it plans are only free of collisions"""
    bound: CalibratedBound | None = None
    """clearance from the estimator's covariance instead of `safety`, calibrated while the vehicle drives"""
    recover: bool = False
    """a vehicle that rests nearer to an obstacle than `safety` allows may leave with the clearance that it has"""
    on_board: Literal["plan", "contingency"] = "plan"
    """what the car has on board beyond a cycle: the remainder of the plan, or the contingency, tracked from then on"""
    contingency: bool = True
    """whether there are contingencies; without, safety, bound, recover, on_board, contingencies, watchdog do nothing"""
    blocked: Seconds | None = None
    """time on a plan without motion after which what is ahead of the vehicle counts as an obstacle; none: never, s"""
    watchdog: Seconds | None = None
    """how old the newest observation may be, or how late a message, before the car itself stops; none: never, s"""
    contingencies: Literal["model", "tracked"] = "model"
    """contingencies are verified as the model drives them, or as the controller tracks them"""
    vehicle: str | None = None
    """model to plan with instead of the scenario's: a name, a YAML file or code"""

    @property
    def car_switches(self) -> bool:
        """Whether the car switches to the contingency by itself at the end of a cycle."""
        return self.on_board == "contingency"

    @property
    def clock_budget(self) -> float:
        """Planning time of a cycle in real-time mode, s."""
        return self.cycle * (1.0 - RESERVE) - self.lead

    @property
    def capacity(self) -> int:
        """Number of nodes that the tree has memory for."""
        return max(10_000, min(200_000, max(4 * self.largest_budget, 2 * self.for_first_plan.largest_budget)))

    @property
    def largest_budget(self) -> int:
        """Largest number of iterations of a cycle."""
        return self.iterations if self.max_iterations is None else self.max_iterations

    @property
    def for_first_plan(self) -> PlannerSettings:
        """Settings with the budget of the first plan."""
        first = self.first_iterations
        if first is None:
            return self
        most = self.first_max_iterations or min(2 * first, ITERATIONS_MAX)
        return self.model_copy(update={"iterations": first, "max_iterations": most})

    @model_validator(mode="before")
    @classmethod
    def _without_contingency(cls, content: Any) -> Any:
        return _with_effect(content) if isinstance(content, Mapping) else content

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check settings that exclude or need each other, and the order of numbers."""
        given = {name: field.default for name, field in cls.model_fields.items()} | _with_effect(content)
        replans = given["mode"] != "one-shot"
        if given["type"] == "geodesic" and not replans:
            yield refuse(
                "is a path for controllers that replan", "expected `mode: replanning`", ("type",), Code.CONFLICT
            )
        if given["safety"] is not None and given["bound"] is not None:
            yield refuse("replaces `safety`, which is there too", "expected one of them", ("bound",), Code.CONFLICT)
        for name, problem in (("bound", "is set in every cycle"), ("blocked", "is noticed in later cycles")):
            if given[name] is not None and not replans:
                yield refuse(problem, "expected `mode: replanning`", (name,), Code.CONFLICT)
        if not replans or (given["safety"] is None and given["bound"] is None):
            for name, value in (("on_board", "contingency"), ("contingencies", "tracked")):
                if given[name] == value:
                    expected = "expected `mode: replanning`, and `safety` or `bound`"
                    yield refuse("needs contingencies", expected, (name,))
        if given["first_max_iterations"] is not None and given["first_iterations"] is None:
            problem, expected = "is given without first_iterations", "expected first_iterations, too"
            yield refuse(problem, expected, ("first_max_iterations",), Code.CONFLICT)
        yield from cls._misordered(given)

    @classmethod
    def _misordered(cls, given: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the lead is shorter than the cycle, and largest budgets are no smaller than the usual ones."""
        lead, cycle = given["lead"], given["cycle"]
        if is_number(lead) and is_number(cycle) and lead >= cycle:
            yield refuse(f"is {lead:g}, not less than the cycle", f"expected less than {cycle:g}", ("lead",))
        for most, least in (("max_iterations", "iterations"), ("first_max_iterations", "first_iterations")):
            largest, usual = given[most], given[least]
            if is_number(largest) and is_number(usual) and largest < usual:
                yield refuse(f"is {largest}, less than {least}", f"expected at least {usual}", (most,))


def _with_effect(content: Mapping[str, object]) -> dict[str, object]:
    """Settings of a planner without those that a method without contingencies ignores."""
    ignored = OF_CONTINGENCIES if content.get("contingency") is False else frozenset()
    return {key: value for key, value in content.items() if key not in ignored}


def _section(value: object) -> Mapping[str, object]:
    """Keys of a section, as it was written or as it was read; none if it is neither."""
    if isinstance(value, StrictModel):
        return dict(value)
    return value if isinstance(value, Mapping) else {}


class Latest(StrictModel):
    """The newest observed pose, predicted forward with the model; the speed is the model's response to the commands."""

    kind: Literal["latest"]
    """which estimator"""
    replanning_window: NonNegative = 0.3
    """time before the newest pose: replanning takes the mean of the poses in it, each predicted to now, s"""


class Filter(StrictModel):
    """A Kalman filter over the model and all observed poses, which doubts outliers."""

    kind: Literal["filter"]
    """which estimator"""
    position_noise: Deviation = 0.1
    """standard deviation of an observed position, m"""
    heading_noise_deg: Deviation = 8.0
    """standard deviation of an observed heading, degrees"""
    start_position_noise: Deviation = 0.02
    """standard deviation of the start that the scenario gives, m"""
    start_heading_noise_deg: Deviation = 2.0
    """standard deviation of the start's heading, degrees"""
    drift: Deviation = 0.03
    """standard deviation of the position that the model loses in one second, m"""
    heading_drift_deg: Deviation = 5.0
    """standard deviation of the heading that the model loses in one second, degrees"""
    speed_drift: Deviation = 0.2
    """standard deviation of the speed that the model loses in one second, m/s"""
    confidence: Annotated[Probability, Field(gt=0.5, lt=1)] = 0.997
    """an observation that is farther off than this share of them is given less weight"""


class Adaptive(StrictModel):
    """A Kalman filter that knows correlated pose errors, and online identification of car, delay and noise."""

    kind: Literal["adaptive"]
    """which estimator"""
    identify: bool = True
    """estimate the parameters of the vehicle"""
    compensate: bool = True
    """estimate the delay of commands and make up for it"""
    correlated: bool = True
    """take a share of the pose error as correlated in time"""
    window: Annotated[Seconds, Field(ge=1, le=60)] = 10.0
    """moving time from which parameters and delay are identified, s"""
    step: Annotated[Seconds, Field(ge=0.02, le=0.5)] = 0.1
    """time between two states of the identification, s"""
    iterations: Annotated[int, Field(ge=1, le=50)] = 2
    """largest number of iterations of the identification in a cycle; each cycle begins at the result of the last one"""
    delay_std: Deviation = 0.15
    """standard deviation of the prior of the delay, s"""
    position_noise: Deviation = 0.04
    """standard deviation of an observed position before residuals are known, m"""
    heading_noise_deg: Deviation = 2.0
    """standard deviation of an observed heading before residuals are known, degrees"""
    correlated_share: Probability = 0.6
    """share of the pose error's variance that is correlated, before residuals are known"""
    correlation_time: Seconds = 1.0
    """time constant of the correlated pose error, s"""
    position_offset: Deviation = 0.03
    """standard deviation of the camera's offset, which differs from place to place, m"""
    heading_offset_deg: Deviation = 0.5
    """the same of the heading, degrees"""
    offset_time: Seconds = 4.0
    """time in which the vehicle comes to a place with another offset, s"""
    start_position_noise: Deviation = 0.02
    """standard deviation of the start that the scenario gives, m"""
    start_heading_noise_deg: Deviation = 2.0
    """standard deviation of the start's heading, degrees"""
    drift: Deviation = 0.01
    """standard deviation of the position that the model loses in one second, m"""
    heading_drift_deg: Deviation = 1.5
    """standard deviation of the heading that the model loses in one second, degrees"""
    speed_drift: Deviation = 0.06
    """standard deviation of the speed that the model loses in one second, m/s"""
    control_share: Probability = 0.015
    """standard deviation of an applied control from its command, as a share of its range"""
    confidence: Annotated[Probability, Field(gt=0.5, lt=1)] = 0.997
    """an observation that is farther off than this share of them is given less weight"""


class Oracle(StrictModel):
    """The truth: true state, true car, known delay of commands.  It shows what is possible; no robot has it."""

    kind: Literal["oracle"]
    """which estimator"""


EstimatorSettings = Annotated[Latest | Filter | Adaptive | Oracle, Field(discriminator="kind")]


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
        if _with_effect(planner).get("bound") is not None and kind not in ("adaptive", None):
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
