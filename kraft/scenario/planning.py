"""Settings of the planner: the `planning` section of a scenario."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Final, Literal

from pydantic import Field
from pydantic_core import PydanticCustomError

from kraft.config.schema import NonNegative, Probability, StrictModel, build, is_number, refuse
from kraft.errors import Code, InputError

STEPS_MAX: Final = 100_000
"""Most steps of an edge: as many as the planner has memory for (`ompl_ext.query.MAX_STEPS`)."""
ROUNDING: Final = 1e-9
"""Error of the quotient of a duration and a step."""
DEFAULT_ITERATIONS: Final = 20_000
EDGE_DURATION: Final = (0.5, 1.0)
INTEGRATION_STEP: Final = 0.1

Duration = Annotated[float, Field(gt=0, le=1000)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]


class Safety(StrictModel):
    """Clearance that every contingency manoeuvre must keep: delta(v) = delta + delta_per_speed |v|."""

    delta: NonNegative = 0.0
    """clearance at rest, m"""
    delta_per_speed: NonNegative = 0.0
    """clearance added per unit of speed, m per m/s"""
    horizon: Duration = 10.0
    """time within which a contingency manoeuvre must have stopped the vehicle, s"""


class Planning(StrictModel):
    """Settings of the planner; all of them have defaults."""

    planner: Literal["dirt", "sst", "rrt", "est", "kpiece1"] = "dirt"
    """name of the planner"""
    cycle: Duration = 1.0
    """time after which a plan of `kraft plan` needs a contingency, s; a drive has the cycle of its method"""
    iterations: Count | None = None
    """planning budget in iterations, repeatable; 20000 unless `time` is given"""
    time: Duration | None = None
    """planning budget in wall-clock time, not repeatable, s"""
    edge_duration: tuple[Duration, Duration] | None = None
    """shortest and longest duration of one tree edge, s; 0.5 and 1, or longer for a vehicle that is slow"""
    integration_step: Duration = INTEGRATION_STEP
    """longest step of the integrator, s; the longest edge takes ten steps or more"""
    blossom: Annotated[int, Field(ge=1, le=32)] = 32
    """candidate edges that are propagated together when a node is expanded; the best of them is added"""
    goal_bias: Probability = 0.05
    """fraction of the random samples that are drawn from the goal"""
    child_extension: bool = True
    """expand a child next if it is nearer to the goal than its parent"""
    pruning: bool = False
    """remove nodes that can no longer improve the solution"""
    polish: bool = True
    """improve the best plan by local optimisation of its controls and durations"""
    safety: Safety = Safety()
    """clearance of contingency manoeuvres"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check the order of the durations, the step beside them, and that there is one budget."""
        if content.get("iterations") is not None and content.get("time") is not None:
            yield refuse("both `iterations` and `time` are given", "expected one of them", ("time",), Code.CONFLICT)
        durations = content.get("edge_duration") or EDGE_DURATION
        shortest, longest = durations if isinstance(durations, Sequence) and len(durations) == 2 else (None, None)
        step = content.get("integration_step", INTEGRATION_STEP)
        if not (is_number(shortest) and is_number(longest)):
            return
        if shortest > longest:
            problem = f"the shortest duration {shortest:g} is longer than the longest {longest:g}"
            yield refuse(problem, "expected [shortest, longest]", ("edge_duration",))
        if is_number(step) and step > shortest:
            problem = f"is {step:g}, longer than the shortest edge"
            yield refuse(problem, f"expected at most {shortest:g}", ("integration_step",), Code.CONFLICT)
        elif is_number(step) and step > 0.0 and longest / step - ROUNDING > STEPS_MAX:
            expected = f"expected a step with which the longest edge takes at most {STEPS_MAX} steps"
            yield refuse(f"is {step:g}", expected, ("integration_step",), Code.CONFLICT)

    def with_budget(self, *, iterations: int | None = None, time: float | None = None) -> Planning:
        """Same settings with another budget: iterations, or time in s.

        Raises:
            InputError: if the budget is not positive and finite, or both are given.
        """
        try:
            return build(Planning, {**dict(self), "iterations": iterations, "time": time}, "planning")
        except InputError as error:
            raise InputError(replace(d, file=d.path, path="", argument=True) for d in error.diagnostics) from None

    def steps_of(self, longest: float) -> int:
        """Integration steps of an edge of which the longest takes `longest` s."""
        return _steps_of(longest, self.integration_step)

    @property
    def iteration_budget(self) -> int | None:
        """Budget in iterations, or None if the budget is `time`."""
        return self.iterations if self.iterations is not None or self.time is not None else DEFAULT_ITERATIONS


def _steps_of(duration: float, step: float) -> int:
    """Integration steps of an edge, of at most `step` s."""
    return max(10, math.ceil(duration / step - ROUNDING))
