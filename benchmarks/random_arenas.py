"""Random scenarios for whole drives: arenas with dividing walls, and rooms of posts; each with its number is the same.

A scenario counts only if it can be driven: the planner finds a plan to the goal without any margin.
"""

from __future__ import annotations

import json
import math
from functools import cache
from itertools import count
from typing import Any, Literal

import numpy as np

from kraft.driving.method import PlannerSettings
from kraft.driving.proposer import Solvers
from kraft.errors import InputError
from kraft.planning.workspace import start_state
from kraft.scenario import Scenario, parse_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

SEED = 7
CAR = 0.28  # width of the car (m)
WALL = 0.1  # thickness (m)
END = 0.5  # distance of start and goal from the ends of the arena (m)
COST_MAX = 25.0  # of the plan that shows that an arena can be driven (s)
ITERATIONS = 20_000  # of its search
Kind = Literal["arena", "posts", "open"]
Obstacle = dict[str, Any]


def random_arena(number: int, kind: Kind, gap: tuple[float, float], **sections: Any) -> Scenario:
    """Scenario `number` of a kind, with gaps of `gap` times the car's width; `sections` are added to its content."""
    for attempt in count():
        rng = np.random.default_rng([SEED, number, attempt])
        width, length = float(rng.uniform(4.0, 5.0)), float(rng.uniform(5.0, 6.0))
        obstacles = {"arena": divided, "posts": posts, "open": scattered}[kind](rng, width, length, gap)
        content = {
            "name": f"{kind}-{number:03d}",
            "bounds": {"x": [0.0, width], "y": [0.0, length]},
            "obstacles": [*obstacles, *outer_walls(width, length)],
            "start": {"x": float(rng.uniform(0.6, width - 0.6)), "y": END, "heading_deg": 90.0},
            "goal": {"center": [float(rng.uniform(0.6, width - 0.6)), length - END], "radius": 0.25},
            "sensing": {"camera": [width / 2, length / 2, 5.0]},
        }
        for section, values in sections.items():
            content[section] = {**content.get(section, {}), **values}
        try:
            scenario = parse_scenario(json.dumps(content), f"{kind}-{number:03d}.yaml")
        except InputError:  # an obstacle whose edges cross, for example
            continue
        if can_be_driven(scenario):
            return scenario
    raise AssertionError("the attempts are endless")


def divided(rng: np.random.Generator, width: float, length: float, gap: tuple[float, float]) -> list[Obstacle]:
    """Two walls across with two gaps each, and obstacles of all shapes between start and goal."""
    walls = []
    for y in (0.35 * length, 0.65 * length):
        begin = 0.0
        for middle in sorted(rng.uniform(0.4, width - 0.4, 2).tolist()):
            half = 0.5 * CAR * float(rng.uniform(*gap))
            walls.append((begin, middle - half, y))
            begin = middle + half
        walls.append((begin, width, y))
    found = [box((0.5 * (a + b), y), (b - a, 0.12), 0.0) for a, b, y in walls if b - a > 0.05]
    return found + scattered(rng, width, length, gap, (6, 10))


def posts(rng: np.random.Generator, width: float, length: float, gap: tuple[float, float]) -> list[Obstacle]:
    """Rows of posts."""
    found, y = [], 1.2
    while y < length - 1.2:
        x = float(rng.uniform(0.1, 0.4))
        while x < width:
            place = (x, y + float(rng.uniform(-0.08, 0.08)))
            found.append({"circle": {"center": place, "radius": float(rng.uniform(0.06, 0.12))}})
            x += 0.2 + CAR * float(rng.uniform(*gap))
        y += float(rng.uniform(0.75, 1.0))
    return found


def scattered(
    rng: np.random.Generator, width: float, length: float, gap: tuple[float, float], number: tuple[int, int] = (4, 8)
) -> list[Obstacle]:
    """Discs, turned rectangles and polygons anywhere between start and goal."""
    found: list[Obstacle] = []
    for _ in range(int(rng.integers(number[0], number[1] + 1))):
        center, kind = (float(rng.uniform(0.2, width - 0.2)), float(rng.uniform(1.1, length - 1.1))), rng.random()
        if kind < 0.4:
            found.append({"circle": {"center": center, "radius": float(rng.uniform(0.08, 0.3))}})
        elif kind < 0.8:
            found.append(box(center, rng.uniform(0.1, 0.7, 2).tolist(), float(rng.uniform(0.0, 180.0))))
        else:
            corners = int(rng.integers(3, 6))
            turns = math.tau * (np.arange(corners) + rng.uniform(0.0, 0.4, corners)) / corners
            radii = rng.uniform(0.1, 0.4, corners)
            vertices = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)]) + np.array(center)
            found.append({"polygon": {"vertices": vertices.tolist()}})
    return found


def outer_walls(width: float, length: float) -> list[Obstacle]:
    """Walls around the bounds."""
    return [
        box((-WALL / 2, length / 2), (WALL, length + 2 * WALL), 0.0),
        box((width + WALL / 2, length / 2), (WALL, length + 2 * WALL), 0.0),
        box((width / 2, -WALL / 2), (width, WALL), 0.0),
        box((width / 2, length + WALL / 2), (width, WALL), 0.0),
    ]


def box(center: tuple[float, float], size: tuple[float, float] | list[float], yaw: float) -> Obstacle:
    """A rectangle turned by `yaw` degrees."""
    return {"box": {"center": center, "size": list(size), "yaw_deg": yaw}}


@cache
def reference_vehicle() -> Vehicle:
    """Model whose plan shows that an arena can be driven."""
    return load_vehicle("mushr-drive")


def can_be_driven(scenario: Scenario) -> bool:
    """Whether a plan without margin leads to the goal in reasonable time."""
    task, vehicle = scenario.task(), reference_vehicle()
    settings = PlannerSettings(mode="replanning", iterations=ITERATIONS, goal_margin=0.1)
    dirt = Solvers.of(task, vehicle, settings).checking
    if dirt.start(start_state(task, vehicle), 1) < 0.0:
        return False
    spent = 0
    while spent < ITERATIONS:
        dirt.grow(iterations=ITERATIONS // 10)
        spent += ITERATIONS // 10
        plan = dirt.plan()
        if plan is not None and plan.reaches_goal and plan.cost < COST_MAX:
            return True
    return False
