"""What has to be compiled of a vehicle before a method drives it to a goal."""

from __future__ import annotations

from kraft.driving.control import contingency_law, settings_for
from kraft.driving.control_settings import Dwa, Lqr, Mppi, Nmpc, Predictive, UserCode
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.method import Method
from kraft.planning.compilation import Needs
from kraft.scenario import Goal
from ompl_ext.vehicle import Vehicle


def needs_of(method: Method, vehicle: Vehicle, goal: Goal) -> Needs:
    """What a method needs of a vehicle that it drives to a goal."""
    modules = [
        *(["rollouts"] if isinstance(method.controller, Mppi | Dwa) else []),
        *(["sst"] if method.planner.type == "sst" else []),
    ]
    own = Needs(
        vehicle,
        steps=uses_steps(method, vehicle),
        polish=bool(method.planner.polish),
        modules=tuple(modules),
        poses=method.planner.cost_to_go == "pose",
    )
    return own | Needs.of_goal(vehicle, goal)


def uses_steps(method: Method, vehicle: Vehicle) -> bool:
    """Whether a method identifies or regulates a vehicle by its model, which takes the compiled steps of the model."""
    own = method.controller
    law = contingency_law(own) if isinstance(own, Predictive | UserCode) else own
    simulates = isinstance(own, Nmpc) or isinstance(settings_for(law, vehicle), Lqr)
    return simulates or isinstance(method.estimator, Adaptive)
