"""Interface of every estimator."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.messages import Estimate, Observation
from ompl_ext.arrays import Floats


class Estimator(Protocol):
    """Estimates the state from poses as they arrive and commands as they are sent.

    A command is taken to act from the time it is sent: the robot does not know of any delay.
    """

    def observe(self, observation: Observation) -> None:
        """Process a pose that has arrived, in any order of stamps; a repeated pose changes nothing."""

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s), predicted from the newest observation with the commands since then."""

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s) for a decision that holds for a whole cycle; it may combine several observations."""
