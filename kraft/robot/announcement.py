"""What the simulated robot announces of its scenario: a drive that knows another one is noticed before anything moves.

A real robot announces nothing, and nothing is compared.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from kraft.provenance import plain_hash
from kraft.robot.messages import make
from kraft.robot.protocol import Check
from kraft.robot.transport import Transport
from kraft.scenario import Goal, Task
from kraft.scenario.geometry import Obstacle, OccupancyMap, Polygon
from ompl_ext.vehicle import Vehicle

TOPIC: Final = "/kraft/scenario"
"""Topic of the announcement, which also late subscribers receive."""
KIND: Final = "std_msgs/msg/String"
SCHEMA: Final = "kraft.announcement/1"
KEYS: Final = frozenset({"schema", "name", "bounds", "goal", "obstacles", "vehicle", "size"})
"""Keys of an announcement."""
NAMED: Final = 3
"""Number of obstacles that a message names at most."""
SAME_SIZE: Final = 0.01
"""Difference of two footprints that counts as none, m."""


def announce(transport: Transport, task: Task, vehicle: Vehicle) -> None:
    """Announce the scenario of a simulated robot, as JSON in a string, and the vehicle that is simulated."""
    transport.advertise(TOPIC, KIND, latched=True)
    transport.publish(TOPIC, make(KIND, data=json.dumps(_content(task, vehicle))))


class Announced:
    """The newest announcement of a simulated robot; `content` is None as long as there is none."""

    def __init__(self, transport: Transport) -> None:
        self.content: dict[str, Any] | None = None
        transport.subscribe(TOPIC, KIND, self._take, latched=True)

    def _take(self, message: Any, _: int) -> None:
        try:
            content = json.loads(message.data)
        except ValueError:
            return  # somebody else's message
        if isinstance(content, dict) and content.get("schema") == SCHEMA and content.keys() >= KEYS:
            self.content = content

    def checks(self, task: Task, vehicle: Vehicle, *, is_simulated: bool, has_map: bool) -> list[Check]:
        """Checks whether a drive knows what is simulated.

        Args:
            task: what the drive knows.
            vehicle: the model of the drive.
            is_simulated: whether the robot file says that the robot is simulated.
            has_map: whether the drive also knows obstacles from the robot's map.
        """
        there = self.content
        if there is None:
            silent = "the simulated robot does not announce its scenario, so it is not compared with that of the drive"
            return [Check("scenario", "warning", silent)] if is_simulated else []
        here = _content(task, vehicle)
        problems, unknown = _differences(there, here), _only(there["obstacles"], here["obstacles"])
        if unknown and not has_map:
            problems.append(f"the drive does not know {_named(unknown)}")
        if problems:
            who = f"the robot simulates {there['name']}, and the drive is in {here['name']}"
            what = f"{who}: {'; '.join(problems)}; start both with the same scenario and the same --set"
            return [Check("scenario", "problem", what)]
        same = f"the robot simulates {there['name']}"
        mapped = f"{same}, and only its map tells the drive of {_named(unknown)}"
        check = Check("scenario", "warning", mapped) if unknown else Check("scenario", "ok", same)
        return [check, *_size_checks(there, here)]


def _content(task: Task, vehicle: Vehicle) -> dict[str, Any]:
    """Announcement: what a planner is told of a scene, and length and width of the vehicle (m)."""
    obstacles = [
        (f"{label} {_place(each)}", plain_hash(replace(each, name=None)))
        for label, each in zip(task.obstacle_labels, task.obstacles, strict=True)
    ]
    return {
        "schema": SCHEMA,
        "name": task.name,
        "bounds": {"x": list(task.bounds.x), "y": list(task.bounds.y)},
        "goal": _goal(task.goal),
        "obstacles": [list(each) for each in obstacles],
        "vehicle": vehicle.name,
        "size": [vehicle.footprint.length, vehicle.footprint.width],
    }


def _goal(goal: Goal) -> dict[str, Any]:
    return {
        "center": list(goal.center),
        "radius": goal.radius,
        "heading": goal.heading,
        "heading_tolerance": goal.heading_tolerance,
        "limits": {name: list(each) for name, each in goal.limits.items()},
    }


def _place(obstacle: Obstacle) -> str:
    """Where messages say that an obstacle is."""
    if isinstance(obstacle, OccupancyMap):
        return "(a map)"
    x, y = obstacle.vertices[0] if isinstance(obstacle, Polygon) else obstacle.center
    return f"at ({x:.4g}, {y:.4g})"


def _differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """What differs between two announcements, except the obstacles that only the simulated robot has."""
    found = []
    for key in ("bounds", "goal"):
        parts = [f"{name} {there[key].get(name)} there, {value} in the drive" for name, value in here[key].items()
                 if there[key].get(name) != value]  # fmt: skip
        if parts:
            found.append(f"{key}: {', '.join(parts)}")
    only = _only(here["obstacles"], there["obstacles"])
    return [*found, f"only the drive has {_named(only)}"] if only else found


def _only(these: Sequence[Sequence[str]], those: Sequence[Sequence[str]]) -> list[str]:
    """Labels of the obstacles of `these` whose geometry none of `those` has."""
    known = {geometry for _, geometry in those}
    return [label for label, geometry in these if geometry not in known]


def _named(labels: list[str]) -> str:
    rest = len(labels) - NAMED
    return ", ".join(labels[:NAMED]) + (f" and {rest} more" if rest > 0 else "")


def _size_checks(there: dict[str, Any], here: dict[str, Any]) -> list[Check]:
    """A warning if the vehicle that is simulated is longer or wider than the model of the drive."""
    if all(a <= b + SAME_SIZE for a, b in zip(there["size"], here["size"], strict=True)):
        return []
    sizes = [f"{each['vehicle']} of {each['size'][0]:.2f} x {each['size'][1]:.2f} m" for each in (there, here)]
    return [Check("vehicle", "warning", f"the robot simulates {sizes[0]}, and the drive plans for {sizes[1]}")]
