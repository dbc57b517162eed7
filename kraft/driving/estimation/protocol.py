"""What every estimator can do."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.messages import Estimate, Observation
from ompl_ext.arrays import Floats


class Estimator(Protocol):
    """Believes in a state, given poses as they arrive and commands as they are sent.

    A command counts from the time it is sent, as if it took effect at once: a delay between the two is part of what
    the robot does not know.
    """

    def observe(self, observation: Observation) -> None:
        """Take in a pose that has arrived, in whatever order of stamps; one seen before changes nothing."""

    def commanded(self, time: float, control: Floats) -> None:
        """Note that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""

    def estimate(self, time: float) -> Estimate:
        """State at `time` (s), predicted from the newest observation with the commands since."""

    def replanning_estimate(self, time: float) -> Estimate:
        """State at `time` (s) for a decision that holds for a whole cycle: it need not rest on one observation."""
