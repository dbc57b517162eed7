"""Settings of the planner of a method: when and how long to plan, and what SAFETY asks for."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from kraft.config.schema import NonNegative, Positive, Probability, StrictModel, is_number, refuse
from kraft.driving.control_settings import Deviation, Seconds
from kraft.errors import Code


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
        return with_effect(content) if isinstance(content, Mapping) else content

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check settings that exclude or need each other, and the order of numbers."""
        given = {name: field.default for name, field in cls.model_fields.items()} | with_effect(content)
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


def with_effect(content: Mapping[str, object]) -> dict[str, object]:
    """Settings of a planner without those that a method without contingencies ignores."""
    ignored = OF_CONTINGENCIES if content.get("contingency") is False else frozenset()
    return {key: value for key, value in content.items() if key not in ignored}
