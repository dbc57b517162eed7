"""Controllers: from an estimate and a reference to a command. None of them knows obstacles."""

from __future__ import annotations

from typing import Protocol, TypeAlias

from kraft.driving.car_model import CarModel, is_car
from kraft.driving.control.geometric import GeometricController
from kraft.driving.control.kinodynamic import KinodynamicController
from kraft.driving.control.lqr import LqrController
from kraft.driving.messages import Estimate, Reference
from kraft.driving.method import Geometric, Kinodynamic, Lqr, OpenLoop
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

__all__ = [
    "Controller",
    "GeometricController",
    "KinodynamicController",
    "LqrController",
    "OpenLoopController",
    "make_controller",
    "settings_for",
]

Settings: TypeAlias = OpenLoop | Geometric | Kinodynamic | Lqr


def settings_for(settings: Settings, vehicle: Vehicle) -> Settings:
    """Settings of the controller that drives a vehicle: a law for cars gives way to the LQR if the vehicle is none."""
    if isinstance(settings, Geometric | Kinodynamic) and not is_car(vehicle):
        return Lqr(kind="lqr", rate_hz=settings.rate_hz)
    return settings


def make_controller(settings: Settings, model: VehicleModel) -> Controller:
    """Make the controller of a method for the vehicle of `model`, see `settings_for`."""
    match settings_for(settings, model.vehicle):
        case OpenLoop():
            return OpenLoopController(model)
        case Lqr() as chosen:
            return LqrController(chosen, model)
        case law:
            assert isinstance(model, CarModel), "laws for cars drive cars"
            return _law(law, model)


def _law(settings: Geometric | Kinodynamic, model: CarModel) -> Controller:
    if isinstance(settings, Geometric):
        return GeometricController(settings, model)
    return KinodynamicController(settings, model)


class OpenLoopController:
    """Sends the planned controls and ignores the estimated state."""

    def __init__(self, model: VehicleModel) -> None:
        self._model = model

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) that the reference holds at the estimate's time."""
        return self._model.clamped(reference.control_at(estimate.time))


class Controller(Protocol):
    """Tracks a reference; each call may pass a new one."""

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) to send at the estimate's time, within the actuators' bounds."""
