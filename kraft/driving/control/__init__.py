"""Controllers: from an estimate and a reference to a command. None of them knows obstacles."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.car_model import CarModel
from kraft.driving.control.geometric import GeometricController
from kraft.driving.control.kinodynamic import KinodynamicController
from kraft.driving.messages import Estimate, Reference
from kraft.driving.method import Geometric, Kinodynamic, OpenLoop
from ompl_ext.arrays import Floats

__all__ = ["Controller", "GeometricController", "KinodynamicController", "OpenLoopController", "make_controller"]


def make_controller(settings: OpenLoop | Geometric | Kinodynamic, model: CarModel) -> Controller:
    """Make the controller of a method for the vehicle of `model`."""
    match settings:
        case OpenLoop():
            return OpenLoopController(model)
        case Geometric():
            return GeometricController(settings, model)
        case Kinodynamic():
            return KinodynamicController(settings, model)


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
