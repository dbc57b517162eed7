"""Open-loop control: the planned controls without feedback, a baseline of the paper."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.car_model import CarModel
from kraft.driving.messages import Estimate, Reference
from ompl_ext.arrays import Floats


class OpenLoopController:
    """Sends the planned controls and ignores the estimated state."""

    def __init__(self, model: CarModel) -> None:
        self._model = model

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) that the reference holds at the estimate's time."""
        return self._model.clamped(reference.control_at(estimate.time))


class Controller(Protocol):
    """Tracks a reference; each call may pass a new one."""

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) to send at the estimate's time, within the actuators' bounds."""
