"""Estimators of the vehicle's state from late, noisy poses and the commands that were sent."""

from __future__ import annotations

from kraft.driving.car_model import CarModel
from kraft.driving.estimation.latest import LatestPose
from kraft.driving.estimation.pose_filter import PoseFilter
from kraft.driving.estimation.protocol import Estimator
from kraft.driving.method import Filter, Latest
from ompl_ext.arrays import Floats

__all__ = ["Estimator", "LatestPose", "PoseFilter", "make_estimator"]


def make_estimator(settings: Latest | Filter, model: CarModel, start_state: Floats) -> Estimator:
    """Make the estimator of a method; the state at time 0 is `start_state` (nx,)."""
    if isinstance(settings, Filter):
        return PoseFilter(settings, model, start_state)
    return LatestPose(settings, model, start_state)
