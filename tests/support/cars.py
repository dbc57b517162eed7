"""A car with terms whose parameters are known, and logs that it makes of itself."""

from __future__ import annotations

import numpy as np

from kraft.logs.log import Log, Part
from kraft.sysid.dynamics import DiscreteModel
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

STEP, EVERY = 0.02, 2
TRUTH = {
    "L": 0.33, "steer": 0.36, "a_drive": 3.0, "damping": 1.2, "friction": 0.5, "dead_zone": 0.0, "back_emf": 0.0,
    "drag": 0.0, "scrub": 0.0, "understeer": 0.0, "slide": 0.0, "slip": 0.0, "saturation": 0.0,
}  # fmt: skip
LEVER = 0.12


def car(**values: float) -> Vehicle:
    return load_vehicle("car", parameters={**TRUTH, **values})


def drive(
    model: Vehicle,
    seed: int,
    seconds: float = 15.0,
    low: tuple[float, float] = (0.15, -1.0),
    high: float = 1.0,
    neutral: int = 0,
) -> Log:
    """Random levels of both commands, observed with 1 mm and 3 mrad at a tracked point ahead of the model's.

    If `neutral` is not 0, the throttle of each level with such a number is neutral.
    """
    rng, steps = np.random.default_rng(seed), round(seconds / STEP)
    levels = rng.uniform(low, high, (steps // 40 + 1, 2))
    if neutral:
        levels[neutral - 1 :: neutral, 0] = 0.0
    levels = np.repeat(levels, 40, axis=0)[:steps]
    start = np.zeros((1, len(model.state)))
    controls = np.ascontiguousarray(levels[:, None, :])
    states = DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([STEP]))[:, 0]
    states = states[::EVERY]
    poses = states[:, :3] + rng.normal(0.0, [0.001, 0.001, 0.003], (len(states), 3))
    poses[:, :2] += LEVER * np.column_stack([np.cos(states[:, 2]), np.sin(states[:, 2])])
    part = Part(STEP * np.arange(steps), levels, STEP * EVERY * np.arange(len(states)), poses)
    return Log(f"drive_{seed}", (), tuple(model.controls), (part,))
