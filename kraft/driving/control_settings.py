"""Settings of the controllers: what tracks a plan, or heads for the goal by itself."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from kraft.config.schema import NonNegative, Positive, StrictModel, Symbol, describe, is_number, refuse
from kraft.config.user_code import is_attribute, split_file
from kraft.errors import Code
from ompl_ext.query import Safety

Seconds = Annotated[float, Field(gt=0, le=1000)]
RATE_MIN: Final = 1.0 / Safety.step
"""Least rate of commands, 1/s: contingencies, and plans where they are optimised, have a control for every 0.1 s."""
Rate = Annotated[float, Field(ge=RATE_MIN, le=500)]
Gain = Annotated[float, Field(ge=0, le=1000)]
"""Gain on a deviation; a negative one would steer away from the plan."""
LeadGain = Annotated[float, Field(ge=-1000, le=1000)]
"""Gain on a rate of change; a negative one makes the response slower."""
Deviation = Annotated[float, Field(ge=1e-6, le=1e6)]
"""Standard deviation, or an error that weighs 1: squares of the ratio of two of them have to be numbers."""


class OpenLoop(StrictModel):
    """Sends the planned controls as they are."""

    kind: Literal["open_loop"]
    """which controller"""
    rate_hz: Rate = 30.0
    """commands per second"""


class Geometric(StrictModel):
    """Steers with a PID towards a point of the path a fixed length ahead of the nearest one."""

    kind: Literal["geometric"]
    """which controller"""
    rate_hz: Rate = 30.0
    """commands per second"""
    lookahead: Positive = 0.6
    """length of path between the nearest point and the point aimed at, m"""
    window: Annotated[int, Field(ge=1, le=100_000)] = 50
    """samples of the path around the last nearest point among which the next one is searched"""
    gains: tuple[Gain, Gain, LeadGain] = (1.0, 1.5, -0.25)
    """proportional, integral and derivative gain on the direction to the point aimed at"""


class Kinodynamic(StrictModel):
    """Stanley on the planned trajectory, with speed and steering fed forward."""

    kind: Literal["kinodynamic"]
    """which controller"""
    rate_hz: Rate = 30.0
    """commands per second"""
    k_path: Gain = 5.0
    """gain on the cross-track error, 1/s"""
    k_heading: Gain = 1.0
    """gain on the heading error"""
    k_along: Gain = 1.0
    """share of full throttle per metre that the vehicle is behind its trajectory, 1/m"""
    softening: Positive = 0.3
    """speed added where the law divides by the speed, m/s"""
    look: NonNegative = 0.15
    """how far ahead of the present time the law looks, to make up for the actuators' lag, s"""


class Lqr(StrictModel):
    """Linear-quadratic regulator along the reference, from the vehicle's own model; for any vehicle."""

    kind: Literal["lqr"]
    """which controller"""
    rate_hz: Rate = 30.0
    """commands per second"""
    position: Deviation = 0.1
    """error of the position that weighs 1, m"""
    heading_deg: Deviation = 10.0
    """error of the heading that weighs 1, degrees"""
    speed: Deviation = 0.3
    """error of the speed that weighs 1; of a turning rate, that of the vehicle's sides, m/s"""
    control_share: Deviation = 0.5
    """correction of a control that weighs 1, as a share of its range"""
    settling: Positive = 1.0
    """time after the end of a reference that errors at its end count for, s"""


class Predictive(StrictModel):
    """A controller that predicts the vehicle in the map."""

    rate_hz: Rate = 30.0
    """commands per second"""
    objective: Literal["goal", "plan"] = "goal"
    """`goal` drives to the goal by the cost-to-go, `plan` tracks the plan"""
    predicted_hz: Annotated[float, Field(gt=0, le=500)] = 4.0
    """times a second that the controls are computed anew where the closed loop is only predicted"""


class RolloutCost(Predictive):
    """What controllers that roll out the model minimise."""

    step: Annotated[Seconds, Field(ge=0.005, le=0.5)] = 0.05
    """step of the rollouts, s"""
    goal: Positive = 10.0
    """weight of the time to the goal, 1/s"""
    collision: Positive = 1000.0
    """cost of a collision, and up to as much again for an early one"""
    near: NonNegative = 5.0
    """weight of being nearer to an obstacle than the margin, 1/s"""
    margin: NonNegative = 0.05
    """distance to obstacles, beyond the clearance of contingencies, below which it costs to be near, m"""
    position: Deviation = 0.1
    """error of the position from the plan that weighs 1, m"""
    heading_deg: Deviation = 20.0
    """error of the heading from the plan that weighs 1, degrees"""
    speed: Deviation = 0.3
    """error of the speed from the plan that weighs 1, m/s"""


class Mppi(RolloutCost):
    """Model predictive path integral control: the mean of sampled controls, weighted by the costs of their rollouts."""

    kind: Literal["mppi"]
    """which controller"""
    rollouts: Annotated[int, Field(ge=2, le=100_000)] = 1000
    """number of rollouts of a command"""
    steps: Annotated[int, Field(ge=1, le=1000)] = 56
    """steps of a rollout"""
    iterations: Annotated[int, Field(ge=1, le=100)] = 1
    """updates of the controls before each command"""
    temperature: Positive = 0.3
    """cost by which a rollout is worse that has 1/e of the weight of the best one"""
    gamma: NonNegative = 0.015
    """weight of the controls themselves"""
    spread: Annotated[float, Field(gt=0, le=2)] = 0.25
    """standard deviation of the samples of a control, as a share of its range"""
    hold: Annotated[int, Field(ge=1, le=1000)] = 8
    """steps for which a sample of a control is held"""


class Dwa(RolloutCost):
    """Dynamic window: the best control of a grid, each held over the whole horizon."""

    kind: Literal["dwa"]
    """which controller"""
    horizon: Annotated[Seconds, Field(ge=0.05, le=60)] = 2.0
    """time for which a control is held, s"""
    samples: Annotated[int, Field(ge=2, le=100)] = 15
    """values of each control"""


class Nmpc(Predictive):
    """Nonlinear model predictive control with CasADi; its cost is that of errors over time and of changes."""

    kind: Literal["nmpc"]
    """which controller"""
    solver: Literal["sqp", "ipopt"] = "sqp"
    """`sqp` makes Gauss-Newton steps from the last solution, `ipopt` solves each problem by itself"""
    steps: Annotated[int, Field(ge=1, le=200)] = 20
    """steps of the prediction"""
    step: Annotated[Seconds, Field(ge=0.01, le=0.5)] = 0.1
    """step of the prediction, s"""
    iterations: Annotated[int, Field(ge=1, le=1000)] = 30
    """largest number of iterations of the optimiser for a command"""
    discs: Annotated[int, Field(ge=1, le=20)] = 3
    """number of discs that cover the footprint"""
    margin: NonNegative = 0.03
    """distance of the discs to obstacles, beyond the clearance of contingencies, m"""
    penalty: Positive = 300.0
    """cost of what is missing of that distance, 1/m"""
    cruise: Annotated[float, Field(gt=0, le=1)] = 0.9
    """speed along a path, as a share of the top speed"""
    position: Deviation = 0.1
    """error of the position that weighs 1, m"""
    heading_deg: Deviation = 30.0
    """error of the heading that weighs 1, degrees"""
    speed: Deviation = 0.3
    """error of the speed that weighs 1, m/s"""
    change: Deviation = 1.0
    """change of a control from step to step that weighs 1, as a share of its range"""


class UserCode(StrictModel):
    """A class of the user's own, which tracks plans or heads for the goal."""

    kind: Literal["code"]
    """which controller"""
    rate_hz: Rate = 30.0
    """commands per second"""
    code: str
    """the class, as in `pure_pursuit.py:PurePursuit`; a path is relative to the file"""
    settings: Mapping[Symbol, Any] = {}
    """keyword arguments of the class, beside the vehicle's model: true or false, numbers, text, lists of numbers"""
    objective: Literal["goal", "plan"] = "plan"
    """`plan` tracks the plan, `goal` heads for the goal by itself"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check the values of the settings."""
        settings = content.get("settings")
        for key, value in settings.items() if isinstance(settings, Mapping) else ():
            items = value if isinstance(value, tuple) else (value,)
            if not (isinstance(value, bool | str) or all(map(is_number, items))):
                expected = "expected true, false, a number, text or a list of numbers"
                yield refuse(f"is {describe(value)}", expected, ("settings", str(key)), Code.TYPE)

    @field_validator("code", mode="before")
    @classmethod
    def _of_class(cls, value: object) -> object:
        """A class in Python as the place of its code, from which every process imports it."""
        if not isinstance(value, type):
            return value
        try:
            return f"{inspect.getfile(value)}:{value.__name__}"
        except (TypeError, OSError):
            problem = f"is the class {value.__name__}, which no file defines"
            raise refuse(problem, "expected a class that is defined in a file") from None

    @field_validator("code")
    @classmethod
    def _check_code(cls, value: str) -> str:
        code = split_file(value)
        if code is None and not is_attribute(value):
            raise refuse(f"{value!r} is no class", "expected path/to/file.py:CLASS or module:CLASS")
        if code is not None and not code[1]:
            raise refuse(f"{value!r} names no class", f"expected {value}:CLASS", code=Code.MISSING)
        return value


ControllerSettings = Annotated[
    OpenLoop | Geometric | Kinodynamic | Lqr | Mppi | Dwa | Nmpc | UserCode, Field(discriminator="kind")
]

PREDICTIVE: Final = tuple(get_args(model.model_fields["kind"].annotation)[0] for model in (Mppi, Dwa, Nmpc))
"""Kinds of controllers that predict the vehicle, see `Predictive`."""
