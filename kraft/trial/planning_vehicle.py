"""Vehicle that a method plans a scenario with, and the check that it is the robot that drives."""

from __future__ import annotations

import math
from typing import Final

from kraft.config import bundled
from kraft.config.source import Source
from kraft.config.user_code import is_attribute
from kraft.driving.method import Method, check_vehicle
from kraft.errors import InputError
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import Scenario
from kraft.vehicles import is_car
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle
from kraft.vehicles.true_robot import CAR_SIZES, RobotTruth
from ompl_ext.vehicle import Footprint, Vehicle

ALIKE: Final = 1.25
"""Ratio of the sizes of two bodies up to which one may stand for the other."""
ALIKE_SPEED: Final = 1.5
"""Ratio of the top speeds of two cars up to which one may stand for the other."""
UNCOVERED: Final = 0.1
"""Share of the length, and of the width, by which a robot may reach beyond the footprint of its model unmentioned."""
MUSHR: Final = "mushr-drive"
"""Vehicle that was identified from the simulated MuSHR, with its top speed."""


def planning_vehicle(scenario: Scenario, method: Method, vehicle: str | None = None) -> Vehicle:
    """Model of `vehicle_reference`, loaded and checked for the method.

    Raises:
        InputError: if it cannot be loaded, or lacks what the method's estimator needs.
    """
    reference = vehicle_reference(scenario, method, vehicle)
    model = load_planning_vehicle(scenario, reference)
    check_vehicle(method, model, own=reference not in (vehicle, scenario.vehicle))
    return model


def vehicle_reference(scenario: Scenario, method: Method, vehicle: str | None = None) -> str:
    """Reference of the model that the robot plans with: `vehicle`, else the method's own, else the scenario's.

    The method's own is used if it is a model of the robot that the scenario's vehicle is a model of.  A bundled one
    never replaces one that is not bundled: a vehicle of the user's own is meant.  A path in a method file is
    relative to that file, also if another method has it from there.

    Raises:
        InputError: if the method's reference is wrong, reported at its line.
    """
    if vehicle is not None or method.planner.vehicle is None:
        return scenario.vehicle if vehicle is None else vehicle
    try:
        own = resolve_vehicle(method.planner.vehicle, method.source.folder("planner.vehicle"))
    except VehicleProblem as error:
        problem = method.source.diagnostic("planner.vehicle", error.problem, error.expected, code=error.code)
        raise InputError([problem]) from None
    if _is_bundled(own) and not _is_bundled(scenario.vehicle):
        return scenario.vehicle
    if own == scenario.vehicle or _are_of_one_robot(load_vehicle(own), vehicle_of_task(scenario)):
        return own
    return scenario.vehicle


def _is_bundled(reference: str) -> bool:
    """Whether a resolved reference is the name of a bundled vehicle: paths are absolute."""
    return bundled.is_name(reference) and not is_attribute(reference)


def _are_of_one_robot(one: Vehicle, other: Vehicle) -> bool:
    """Whether two vehicles are models of one robot: as large, and the same is true where a scenario states nothing."""
    (robot, _), (other_robot, _) = natural_robot(one), natural_robot(other)
    same = robot == other_robot and sorted(one.controls) == sorted(other.controls)
    return same and _are_alike(_size(one), _size(other))


def _size(vehicle: Vehicle) -> tuple[float, float]:
    """Length and width of a vehicle's footprint, m."""
    return vehicle.footprint.length, vehicle.footprint.width


def _are_alike(size: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether a body may stand for another, by lengths and widths (m)."""
    return all(1.0 / ALIKE < one / two < ALIKE for one, two in zip(size, other, strict=True))


def load_planning_vehicle(scenario: Scenario, reference: str) -> Vehicle:
    """Model of a `vehicle_reference`; problems with the scenario's own are reported at its line.

    Raises:
        InputError: if it cannot be loaded.
    """
    return vehicle_of_task(scenario) if reference == scenario.vehicle else load_vehicle(reference)


def check_robot(scenario: Scenario, vehicle: Vehicle) -> None:
    """Check that the true robot of a scenario can be simulated there and takes the controls of the planning model.

    Raises:
        InputError: at the line that states the robot, if not.
    """
    if not _is_a_bundled_car(scenario, vehicle) or scenario.truth.movable_boxes:
        from kraft.simulation.true_world import check_world  # loads the simulator

        check_world(scenario, vehicle)


def _is_a_bundled_car(scenario: Scenario, vehicle: Vehicle) -> bool:
    """Whether a car drives that has no dimensions of its own: it can be simulated wherever no box is in its way."""
    car = natural_robot(vehicle)[0].car if scenario.truth.kind is None else None
    return car is not None and car.is_preset and is_car(vehicle)


def check_own_robot(vehicle: Vehicle) -> None:
    """Check the robot that a vehicle's file states.

    Raises:
        InputError: at its line, if it cannot be simulated or takes other controls.
    """
    robot, source = natural_robot(vehicle)
    if robot.kind is not None and ("truth",) in source.keys:
        from kraft.simulation.true_world import check_own_truth  # loads the simulator

        check_own_truth(vehicle)


def other_robot(scenario: Scenario, vehicle: Vehicle) -> str:
    """What to say of a true robot that the vehicle's footprint does not cover; else empty.

    It is one that scenario or vehicle file state, or, for a car, the MuSHR by default: of that also if its size or top
    speed is another one.

    Raises:
        InputError: if the robot that is stated does not load.
    """
    robot, source = natural_robot(vehicle)
    if scenario.truth.kind is not None:
        robot, source = scenario.truth, scenario.source
    elif robot.car is not None and ("truth",) not in source.keys:
        return _by_default(vehicle)
    highest = max((obstacle.height for obstacle in scenario.obstacles), default=math.inf)
    return stated_robot(robot, source, vehicle, highest)


def own_robot(vehicle: Vehicle) -> str:
    """What to say of a robot that the vehicle's file states and its footprint does not cover; else empty.

    Raises:
        InputError: if that robot does not load.
    """
    robot, source = natural_robot(vehicle)
    return stated_robot(robot, source, vehicle) if ("truth",) in source.keys else ""


def stated_robot(robot: RobotTruth, source: Source, vehicle: Vehicle, highest: float = math.inf) -> str:
    """What to say of a true robot that is stated, or will be, beside a footprint that does not cover it; else empty.

    Args:
        robot: the true robot, with absolute paths.
        source: where it is stated.
        vehicle: vehicle with the footprint.
        highest: height of the highest obstacle that it may touch, m.

    Raises:
        InputError: if that robot does not load.
    """
    outline = _simple_outline(robot, vehicle)
    if outline is None:
        from kraft.simulation.outline import outline_of  # loads the simulator

        outline = outline_of(robot, source, vehicle, highest)
    return "" if outline is None else _uncovered(outline, vehicle)


def _simple_outline(robot: RobotTruth, vehicle: Vehicle) -> Footprint | None:
    """Outline of a true robot of a kind that is known without the simulator; None of others."""
    if robot.kind is None:
        return vehicle.footprint
    if robot.car is not None and robot.car.is_preset:
        return Footprint(*CAR_SIZES[robot.car.preset])
    return None


def _by_default(vehicle: Vehicle) -> str:
    """What to say of the MuSHR that drives because nothing else is stated."""
    shape, size, top_speed = vehicle.footprint, CAR_SIZES["mushr"], load_vehicle(MUSHR).top_speed
    if _are_alike(_size(vehicle), size) and 1.0 / ALIKE_SPEED < vehicle.top_speed / top_speed < ALIKE_SPEED:
        return ""
    stated = f"the file of {vehicle.name}" if vehicle.file else f"{vehicle.name}, which is code and cannot,"
    place = "the file of the vehicle" if vehicle.file else "a vehicle file whose model is that code"
    robot = (
        f"{{car: {{length: {shape.length:g}, width: {shape.width:g}, "
        f"drive: {{top_speed: {vehicle.top_speed:.2g}, time_constant: 0.5}}}}}}"
    )
    return (
        f"the true robot is the MuSHR ({size[0]:g} m x {size[1]:g} m, top speed {top_speed:.2g} m/s) because neither "
        f"the scenario nor {stated} states another; {vehicle.name} is {shape.length:g} m x {shape.width:g} m, top "
        f"speed {vehicle.top_speed:.2g} m/s; expected its robot, such as truth: {robot}, in {place} or in the "
        "scenario, there also with --set 'truth={...}'"
    )


def _uncovered(outline: Footprint, vehicle: Vehicle) -> str:
    """What to say of a stated robot that reaches farther than the footprint of its model; else empty."""
    shape = vehicle.footprint
    (rear, front), (own_rear, own_front) = outline.ends, shape.ends
    ends, side = max(front - own_front, own_rear - rear), (outline.width - shape.width) / 2.0
    if ends <= UNCOVERED * outline.length and side <= UNCOVERED * outline.width:
        return ""
    return (
        f"the true robot ({outline.length:.3g} m x {outline.width:.3g} m) is not covered by the footprint of "
        f"{vehicle.name} ({shape.length:g} m x {shape.width:g} m) and reaches up to {max(ends, side):.2g} m beyond it, "
        f"where nothing keeps it from obstacles; expected footprint: {_that_covers(outline)} in the file of the vehicle"
    )


def _that_covers(outline: Footprint) -> str:
    """Footprint in whole millimetres that holds an outline, as the file of a vehicle states it."""
    offset = round(outline.offset, 3)
    length = outline.length + 2.0 * abs(outline.offset - offset)
    sizes = f"length: {_rounded_up(length):g}, width: {_rounded_up(outline.width):g}"
    return f"{{{sizes}, offset: {offset:g}}}" if offset else f"{{{sizes}}}"


def _rounded_up(length: float) -> float:
    """Length in whole millimetres, m."""
    return math.ceil(1000.0 * length - 1e-6) / 1000.0
