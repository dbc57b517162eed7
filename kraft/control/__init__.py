"""How a plan is tracked: controllers from an estimate and a reference to a command. All are blind to obstacles."""

from __future__ import annotations

from kraft.control.geometric import GeometricController
from kraft.control.kinodynamic import KinodynamicController
from kraft.control.open_loop import OpenLoopController
from kraft.control.protocol import Controller
from kraft.method import Geometric, Kinodynamic, OpenLoop
from kraft.model import Model

__all__ = ["Controller", "GeometricController", "KinodynamicController", "OpenLoopController", "make_controller"]


def make_controller(settings: OpenLoop | Geometric | Kinodynamic, model: Model) -> Controller:
    """The controller that a method names, for the vehicle of `model`."""
    match settings:
        case OpenLoop():
            return OpenLoopController(model)
        case Geometric():
            return GeometricController(settings, model)
        case Kinodynamic():
            return KinodynamicController(settings, model)
