"""What the commands of both sides of a robot say of its motion without a model, for the screening of its logs.

Speed and turning rate follow the mean and the difference of the sides with lags: their changes over a short time are
linear in the commands of that time and in what they were before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.command_units import SIDES
from kraft.sysid.log_groups import Response, Samples
from kraft.sysid.log_motion import SPAN, STEP, LogMotion, motions, sums_of
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


USUAL_DELAY: Final = 0.05
"""Delay at which a change of the turning rate shows, s: its lag is a term of the regression."""
GROUP_DELAYS: Final = (0.0, 0.1, 0.3)
"""Delays of the response with which groups are sought, s: that of a mixture would say nothing about either."""
GROUP_LEAST, GROUP_RATIO = 0.03, 0.65
"""Share of a change that two groups explain in addition, at least, and of what is left by them, at most."""


def motions_of_sides(logs: Sequence[Log]) -> list[LogMotion]:
    """Motion of the parts of logs of a robot with two driven sides, with the commands of both; empty for others."""
    return motions(logs, SIDES) if logs and all(set(SIDES) <= set(log.controls) for log in logs) else []


def turn_samples(m: LogMotion, delay: float) -> tuple[Matrix, Floats]:
    """Terms of the change of the turning rate with commands from `delay` s before, and the change."""
    return _samples(m, m.rate, delay)


def drive_samples(m: LogMotion, delay: float) -> tuple[Matrix, Floats]:
    """Terms of the change of the speed with commands from `delay` s before, and the change."""
    return _samples(m, m.speed, delay)


def responses_of_sides(found: Sequence[LogMotion]) -> tuple[Response, ...]:
    """Motions by which the logs of two robots are told apart."""
    return tuple(
        Response(verb, [_nonlinear(found, rate, delay) for delay in GROUP_DELAYS], GROUP_LEAST, GROUP_RATIO)
        for verb, rate in (("turn", "rate"), ("accelerate", "speed"))
    )


def _nonlinear(found: Sequence[LogMotion], rate: str, delay: float) -> Samples:
    """Samples with terms of dead zones, scrub and limits of the acceleration besides."""
    samples = []
    for m in found:
        values: Floats = getattr(m, rate)
        terms, change = _samples(m, values, delay)
        sides = terms[:, [1, 2]]
        more = [sides * np.abs(sides), (values * np.abs(values))[: len(change), None]]
        samples.append((np.column_stack([terms, *more]), change))
    return samples


def _samples(m: LogMotion, values: Floats, delay: float) -> tuple[Matrix, Floats]:
    count = round(SPAN / STEP)
    commands = m.commands(delay)
    left, right = (sums_of(commands[:, k], count) / count for k in (0, 1))
    return np.column_stack([np.ones(len(left)), left, right, values[:-count]]), values[count:] - values[:-count]
