"""Warnings of trials that can be driven, though something in them is probably a mistake.

Each function returns an empty text where there is nothing to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from kraft.driving.estimator_settings import Adaptive
from kraft.driving.method import Method
from kraft.planning.feasibility import nearest_obstacle
from kraft.planning.free_place import free_place
from kraft.planning.workspace import workspace_of
from kraft.scenario import Scenario, Task
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.unmapped import unstated_outside
from kraft.trial.planning_vehicle import other_robot
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

FARTHEST_MEASURED: Final = 7.6
"""Distance from the camera up to which the errors of `single-tag` were measured, m."""

NEAR_START: Final = 0.03
"""Clearance at the start up to which the error of a filtered pose of a tag may be as large, m."""


def far_camera(scenario: Scenario, *, anywhere: bool = False) -> str:
    """What to say of a camera whose poses are worse than any that were measured; else empty.

    The poses are those at start and goal, or with `anywhere` those of a vehicle in any corner of the bounds.
    """
    sensing, start, bounds = scenario.sensing, scenario.start, scenario.bounds
    if sensing.preset != "single-tag":
        return ""
    x, y, height = sensing.camera
    above = height - MARKER_HEIGHT
    if anywhere:
        corners = ((cx, cy) for cx in bounds.x for cy in bounds.y)
        places = {"farthest corner": max(corners, key=lambda corner: math.dist(corner, (x, y)))}
    else:
        places = {"start": (start.x, start.y), "goal": scenario.goal.center}
    away = {name: math.hypot(place[0] - x, place[1] - y) for name, place in places.items()}
    far = {name: level for name, level in away.items() if math.hypot(level, above) > FARTHEST_MEASURED}
    if not far:
        return ""
    from kraft.simulation.camera import PRESETS  # loads the simulator

    noise, listed = PRESETS[sensing.preset], []
    for name, level in far.items():
        distance, phi = math.hypot(level, above), math.atan2(level, above)
        error = sensing.noise_scale * noise.position_error(distance, phi)
        listed.append(f"{error:.2g} m at the {name} ({distance:.2g} m from the camera)")
    return (
        f"poses of a tag are wrong by about {' and '.join(listed)}: errors grow with the distance, and "
        f"are measured up to {FARTHEST_MEASURED:g} m; place the camera nearer (sensing.camera), or state other sensing "
        "(sensing.preset: planar)"
    )


def near_start(task: Task, vehicle: Vehicle) -> str:
    """What to say of a start that is free, but nearer to an obstacle than poses are exact; else empty."""
    pose = task.start.x, task.start.y, task.start.heading
    away = ExactClearance(workspace_of(task, vehicle), vehicle.footprint).distance(*pose)
    if away <= 0.0 or away > NEAR_START:
        return ""
    place = free_place(task, vehicle, pose)
    such = "" if place is None else f", such as at ({place[0]:.2f}, {place[1]:.2f}) with this heading"
    what = nearest_obstacle(task, vehicle, pose)
    return (
        f"the start is {100.0 * away:.2g} cm from {what}: estimated poses are wrong by as much, so the vehicle may "
        f"touch it or need long to get away; start farther away{such}"
    )


def early_watchdog(method: Method) -> str:
    """What to say of a watchdog that is not longer than the patience of the replanner; else empty.

    Such a method is stricter and may drive as well, so it is not refused: a robot's `pose_age` may also be shorter.
    """
    planner = method.planner
    if planner.mode != "replanning" or planner.watchdog is None or planner.watchdog > planner.patience:
        return ""
    return (
        f"{method.name} has planner.watchdog {planner.watchdog:g} s and planner.patience {planner.patience:g} s: "
        "without poses the watchdog brakes, which nothing verifies, before the replanner commits a verified "
        "contingency; choose a watchdog that is longer than the patience"
    )


def watchdog_of_one_plan(method: Method) -> str:
    """What to say of a watchdog with a single plan, after which no message follows; else empty."""
    planner = method.planner
    if planner.mode != "one-shot" or planner.watchdog is None:
        return ""
    return (
        f"{method.name} has planner.watchdog {planner.watchdog:g} s with planner.mode one-shot: no message follows the "
        f"plan, so it stops the car for good {planner.cycle + planner.watchdog:g} s after the start; leave it out, or "
        "choose mode replanning"
    )


def unused_polish(method: Method) -> str:
    """What to say of a method that asks a planner for local optimisation that does none; else empty."""
    planner = method.planner
    if planner.type == "dirt" or not planner.polish:
        return ""
    return (
        f"{method.name} has planner.polish, which has no effect with planner.type {planner.type}: only dirt improves "
        "plans by local optimisation"
    )


def unguided_goal(task: Task, method: Method) -> str:
    """What to say of a goal's heading and limits that the cost-to-go of the method does not know; else empty."""
    planner, goal = method.planner, task.goal
    asked = [name for name, given in (("heading", goal.heading is not None), ("limits", bool(goal.limits))) if given]
    if planner.type != "geodesic" or planner.cost_to_go != "position" or not asked:
        return ""
    return (
        f"{method.name} goes by a cost-to-go of positions, which does not know the goal's {' and '.join(asked)}: it "
        "may stand at the goal's place until the time limit; methods with a tree, such as adaptive-kraft, plan for it "
        "(planner.type dirt or sst)"
    )


def uncorrected_slope(scenario: Scenario, method: Method, vehicle: Vehicle) -> str:
    """What to say of a tilted floor whose slope is not estimated, though the method could; else empty."""
    tilted = scenario.truth.tilt is not None and scenario.truth.tilt.slope > 0.0
    if not tilted or not isinstance(method.estimator, Adaptive) or vehicle.gravity_share is not None:
        return ""
    return (
        f"the floor leans, and {vehicle.name} states no gravity_share: neither the slope nor the errors of the poses "
        "that come from it are estimated"
    )


WARNINGS: Final[tuple[Callable[[Scenario, Method, Vehicle], str], ...]] = (
    lambda scenario, _method, _vehicle: unstated_outside(scenario),
    lambda scenario, _method, _vehicle: far_camera(scenario),
    lambda scenario, _method, vehicle: near_start(scenario.task(), vehicle),
    lambda scenario, method, _vehicle: unguided_goal(scenario, method),
    lambda _scenario, method, _vehicle: early_watchdog(method),
    lambda _scenario, method, _vehicle: watchdog_of_one_plan(method),
    lambda _scenario, method, _vehicle: unused_polish(method),
    lambda scenario, _method, vehicle: other_robot(scenario, vehicle),
    uncorrected_slope,
)
"""What may be wrong with trials of a method that plans with a vehicle; each is empty where it is not."""


def warnings_of(scenario: Scenario, method: Method, vehicle: Vehicle) -> tuple[str, ...]:
    """All that there is to say of trials of a method that plans with a vehicle."""
    return tuple(text for warning in WARNINGS if (text := warning(scenario, method, vehicle)))
