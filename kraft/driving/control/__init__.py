"""Controllers: from an estimate and a reference to a command.  Only the predictive ones know obstacles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from kraft.driving.car_model import CarModel
from kraft.driving.control.lqr import LqrController, check_controllable
from kraft.driving.control.nmpc import NmpcController
from kraft.driving.control.nmpc_problem import casadi_of
from kraft.driving.control.path_tracking import GeometricController, KinodynamicController
from kraft.driving.control.sampling import DwaController, MppiController
from kraft.driving.control.user_controller import UserController, check_arguments, uses_map
from kraft.driving.control_settings import (  # fmt: skip
    ControllerSettings,
    Dwa,
    Geometric,
    Kinodynamic,
    Lqr,
    Mppi,
    Nmpc,
    OpenLoop,
    Predictive,
    UserCode,
)
from kraft.driving.messages import Controller, Estimate, Reference, ReferenceKind
from kraft.driving.method import Method
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.vehicles import is_car
from ompl_ext.arrays import Floats
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

__all__ = [
    "Controller",
    "DwaController",
    "GeometricController",
    "KinodynamicController",
    "LqrController",
    "MppiController",
    "NmpcController",
    "OpenLoopController",
    "UserController",
    "compiled_law",
    "make_controller",
    "needs_map",
    "set_map",
    "settings_for",
    "tracking_law",
]


Result = TypeVar("Result")


def settings_for(settings: ControllerSettings, vehicle: Vehicle) -> ControllerSettings:
    """Settings of the controller that drives a vehicle: a law for cars gives way to the LQR if the vehicle is none."""
    if isinstance(settings, Geometric | Kinodynamic) and not is_car(vehicle):
        return Lqr(kind="lqr", rate_hz=settings.rate_hz)
    return settings


def needs_map(method: Method) -> bool:
    """Whether the controller of a method needs the map.

    Raises:
        InputError: if it is code that cannot be imported, at the line of the method that names it.
    """
    controller = method.controller
    if isinstance(controller, UserCode):
        return controller.objective == "goal" or _at_its_line(method, lambda: uses_map(controller))
    return isinstance(controller, Predictive)


def check_available(method: Method) -> None:
    """Check that what only the controller of this method needs is there: a package, or code.

    Raises:
        MissingDependency: if a package is missing.
        InputError: see `check_code`.
    """
    if isinstance(method.controller, Nmpc):
        casadi_of()
    check_code(method)


def check_code(method: Method) -> None:
    """Check the code of the user's own controller, if the method has one.

    Raises:
        InputError: if it cannot be imported or does not take its settings, at the line of the method that names it.
    """
    controller = method.controller
    if isinstance(controller, UserCode):
        _at_its_line(method, lambda: check_arguments(controller))


def _at_its_line(method: Method, call: Callable[[], Result]) -> Result:
    """Result of a call, whose errors are about the code that the method names; it may come from Python instead."""
    key, source = ("controller", "code"), method.source
    try:
        return call()
    except InputError as error:
        if key not in source.values and source.replacement(key) is None:
            raise
        at = source.diagnostic
        raise InputError(
            at("controller.code", d.problem, d.expected, code=d.code) for d in error.diagnostics
        ) from error


def contingency_law(settings: ControllerSettings) -> Kinodynamic:
    """Law that tracks contingencies for a controller that has none."""
    return Kinodynamic(kind="kinodynamic", rate_hz=settings.rate_hz, k_along=3.0)


def make_controller(
    settings: ControllerSettings, model: VehicleModel, dirt: DirtSolver | None = None, seed: int = 0
) -> Controller:
    """Make the controller of a method for the vehicle of `model`, see `settings_for`.

    Args:
        settings: of the controller.
        model: of the vehicle.
        dirt: solver with map, clearance and goal, for controllers that need them, see `needs_map`.
        seed: of the samples of a controller that draws some.

    Raises:
        InputError: if feedback from the linearised model cannot control the vehicle, a controller needs a map and
            there is none, or the user's own code is wrong.
    """
    chosen = settings_for(settings, model.vehicle)
    if isinstance(chosen, UserCode):
        return UserController(chosen, model, make_controller(contingency_law(chosen), model), dirt, seed)
    if isinstance(chosen, Predictive):
        if dirt is None:
            problem = f"is {chosen.kind!r}, which needs the map"
            raise InputError.of_argument(
                "controller", problem, "expected a controller that tracks plans", Code.CONFLICT
            )
        law = make_controller(contingency_law(chosen), model)
        if isinstance(chosen, Mppi):
            return MppiController(chosen, model, dirt, law, seed)
        if isinstance(chosen, Nmpc):
            return NmpcController(chosen, model, dirt, law)
        assert isinstance(chosen, Dwa), "the last one"
        return DwaController(chosen, model, dirt, law)
    match chosen:
        case OpenLoop():
            return OpenLoopController(model)
        case Lqr() as chosen:
            check_controllable(model)
            return LqrController(chosen, model)
        case law_of_car:
            assert isinstance(model, CarModel), "laws for cars drive cars"
            return _law(law_of_car, model)


def set_map(controller: Controller, dirt: DirtSolver) -> None:
    """Let a controller that predicts the vehicle in the map use the one of another solver; the others know none."""
    if isinstance(controller, MppiController | DwaController | NmpcController | UserController):
        controller.set_map(dirt)


def tracking_law(controller: Controller, reference: Reference) -> Controller:
    """What tracks a reference for a controller: itself, or the law that some have for contingencies."""
    if reference.kind is ReferenceKind.CONTINGENCY and isinstance(
        controller, MppiController | DwaController | NmpcController | UserController
    ):
        return controller.law
    return controller


def compiled_law(controller: Controller, reference: Reference) -> KinodynamicController | None:
    """What tracks a reference for a controller, if that is compiled."""
    law = tracking_law(controller, reference)
    return law if isinstance(law, KinodynamicController) else None


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
