"""Controllers: from an estimate and a reference to a command. None of them knows obstacles."""

from __future__ import annotations

from kraft.driving.car_model import CarModel
from kraft.driving.control.geometric import GeometricController
from kraft.driving.control.kinodynamic import KinodynamicController
from kraft.driving.control.open_loop import Controller, OpenLoopController
from kraft.driving.method import Geometric, Kinodynamic, OpenLoop

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
