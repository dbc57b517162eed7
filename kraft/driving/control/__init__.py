"""Controllers: from an estimate and a reference to a command. None of them knows obstacles."""

from __future__ import annotations

from typing import Protocol, TypeAlias

from kraft.driving.car_model import CarModel
from kraft.driving.control.geometric import GeometricController
from kraft.driving.control.kinodynamic import KinodynamicController
from kraft.driving.control.lqr import LqrController, check_controllable
from kraft.driving.messages import Estimate, Reference
from kraft.driving.method import Adaptive, Geometric, Kinodynamic, Lqr, Method, OpenLoop
from kraft.driving.vehicle_model import VehicleModel
from kraft.vehicles import is_car
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

__all__ = [
    "Controller",
    "GeometricController",
    "KinodynamicController",
    "LqrController",
    "OpenLoopController",
    "make_controller",
    "needs_steps",
    "settings_for",
]

Settings: TypeAlias = OpenLoop | Geometric | Kinodynamic | Lqr


def settings_for(settings: Settings, vehicle: Vehicle) -> Settings:
    """Settings of the controller that drives a vehicle: a law for cars gives way to the LQR if the vehicle is none."""
    if isinstance(settings, Geometric | Kinodynamic) and not is_car(vehicle):
        return Lqr(kind="lqr", rate_hz=settings.rate_hz)
    return settings


def needs_steps(method: Method, vehicle: Vehicle) -> bool:
    """Whether a method identifies or regulates a vehicle by its model, which takes the compiled steps of the model."""
    return isinstance(method.estimator, Adaptive) or isinstance(settings_for(method.controller, vehicle), Lqr)


def make_controller(settings: Settings, model: VehicleModel) -> Controller:
    """Make the controller of a method for the vehicle of `model`, see `settings_for`.

    Raises:
        InputError: if feedback from the linearised model cannot control the vehicle.
    """
    match settings_for(settings, model.vehicle):
        case OpenLoop():
            return OpenLoopController(model)
        case Lqr() as chosen:
            check_controllable(model)
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
