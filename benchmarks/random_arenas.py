"""Random scenarios for whole drives, with narrower passages than `kraft generate` makes; a number gives one scenario.

A scenario counts only if it can be driven: the planner finds a plan to the goal without any margin.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any, Final, Literal

import numpy as np

from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.solvers import Solvers
from kraft.errors import InputError
from kraft.planning.workspace import start_state
from kraft.scenario import Scenario, parse_scenario
from kraft.vehicles.load import load_vehicle
from kraft.worlds import layouts
from kraft.worlds.layouts import Gap, Obstacle
from ompl_ext.vehicle import Vehicle

SEED = 7
CAR = 0.28  # width of the car (m)
END = 0.5  # distance of start and goal from the ends of the arena (m)
COST_MAX = 25.0  # of the plan that shows that an arena can be driven (s)
ITERATIONS = 20_000  # of its search
Kind = Literal["arena", "posts", "open"]
LAYOUTS: Final[dict[Kind, Callable[[np.random.Generator, float, float, Gap], list[Obstacle]]]] = {
    "arena": layouts.divided,
    "posts": layouts.rows_of_posts,
    "open": lambda rng, width, length, _: layouts.scattered(rng, width, length, (4, 8)),
}


def random_arena(number: int, kind: Kind, gap: tuple[float, float], **sections: Any) -> Scenario:
    """Scenario `number` of a kind, with gaps of `gap` times the car's width; `sections` are added to its content."""
    for attempt in count():
        rng = np.random.default_rng([SEED, number, attempt])
        width, length = float(rng.uniform(4.0, 5.0)), float(rng.uniform(5.0, 6.0))
        obstacles = LAYOUTS[kind](rng, width, length, (CAR * gap[0], CAR * gap[1]))
        content = {
            "name": f"{kind}-{number:03d}",
            "bounds": {"x": [0.0, width], "y": [0.0, length]},
            "obstacles": [*obstacles, *layouts.outer_walls(width, length)],
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
