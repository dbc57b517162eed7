"""Estimators of the vehicle's state from late, noisy poses and the commands that were sent."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.estimation.camera_model import CameraModel
from kraft.driving.estimation.dead_reckoning import LatestPose
from kraft.driving.estimation.pose_filter import PoseFilter
from kraft.driving.estimator_settings import Adaptive, Filter, Latest
from kraft.driving.messages import Estimate, Observation, PoseBelief, Uncertainty
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats

__all__ = ["CameraModel", "Estimator", "LatestPose", "PoseFilter", "make_estimator"]


class Estimator(Protocol):
    """Estimates the state from poses as they arrive and commands as they are sent.

    A command is taken to act `horizon` s after it is sent.  Estimates are that far ahead of the time of the call, so
    that the controller computes commands for the state in which they act.
    """

    @property
    def horizon(self) -> float:
        """Delay of commands that estimates make up for, s."""

    @property
    def belief(self) -> PoseBelief | None:
        """Pose with its covariance after the newest observation; None before one, or without a covariance."""

    def observe(self, observation: Observation) -> None:
        """Process a pose that has arrived, in any order of stamps; a repeated pose changes nothing.

        Raises:
            InputError: the pose is not finite; the estimate is as before.
        """

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held until the next one."""

    def leave_out(self, begin: float, end: float) -> None:
        """Identify nothing from the time from `begin` to `end` (s), in which something held the vehicle."""

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s) plus the horizon, predicted from the newest observation with the commands."""

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate for a decision that holds for a whole cycle; it may combine several observations."""

    def uncertainty(self, time: float) -> Uncertainty | None:
        """Uncertainty of the estimate at `time` (s); None if the estimator states none."""


def make_estimator(
    settings: Latest | Filter | Adaptive, model: VehicleModel, start_state: Floats, camera: CameraModel | None = None
) -> Estimator:
    """Make the estimator of a method; the state at time 0 is `start_state` (nx,).

    `camera` is the one that the poses come from, if it is known.

    Raises:
        InputError: if parameters are to be estimated whose ranges the vehicle does not state.
    """
    if isinstance(settings, Adaptive):
        from kraft.driving.estimation.adaptive import AdaptiveEstimator  # which needs system identification

        return AdaptiveEstimator(settings, model, start_state, camera)
    if isinstance(settings, Filter):
        return PoseFilter(settings, model, start_state)
    return LatestPose(settings, model, start_state)
