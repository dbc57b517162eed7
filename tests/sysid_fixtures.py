"""Logs of models themselves, made for the tests of identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from kraft.logs.log import Log, Part
from kraft.sysid.motion import Motion
from kraft.sysid.parameters import vehicle_of
from kraft.vehicle_config import VehicleConfig
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle


def random_commands(vehicle: Vehicle, seconds: float, rng: np.random.Generator, hold: float = 1.0) -> tuple[Floats, Matrix]:
    """Commands that jump about every `hold` s: anything between their bounds, more often forward."""
    times, rows = [0.0], []
    while times[-1] < seconds:
        times.append(times[-1] + hold * rng.uniform(0.5, 1.5))
    for _ in times:
        rows.append([rng.uniform(low, high) for low, high in vehicle.controls.values()])
    if "throttle" in vehicle.controls:
        column = list(vehicle.controls).index("throttle")
        for row in rows:
            row[column] = rng.uniform(0.4, 1.0)
    return np.array(times), np.array(rows)


def synthetic_log(
    vehicle: VehicleConfig | Vehicle,
    truth: Mapping[str, float],
    seed: int,
    seconds: float = 20.0,
    noise: tuple[float, float] = (0.01, 0.02),
    process: Sequence[float] = (),
    rate: float = 30.0,
    outliers: float = 0.0,
    commands: tuple[Floats, Matrix] | None = None,
    control_noise: Sequence[float] = (),
) -> Log:
    """A log of the vehicle driving with parameters (and extras) `truth`, from rest at the origin.

    `process` (nx,) is the standard deviation of what disturbs the state per square root of a second, `control_noise`
    (nu,) that of the controls held for 50 ms; `outliers` the share of poses that are off by 0.5 m.
    """
    model = vehicle_of(vehicle)
    rng = np.random.default_rng(seed)
    motion = Motion(model)
    times, values = commands if commands is not None else random_commands(model, seconds, rng)
    fine = 0.005
    per_control_noise = 10
    count = round(seconds / fine)
    grid = fine * np.arange(count + 1)
    p = np.array([truth.get(name, value) for name, value in model.parameters.items()] or [0.0])
    states = np.zeros((count + 1, len(model.state)))
    bounds = model.control_bounds
    spread = np.sqrt(fine) * np.array(process) if len(process) else None
    acting = np.zeros((count, len(model.controls)))
    for k, name in enumerate(model.controls):
        delay = truth.get("delay", 0.0) + truth.get(f"delay_{name}", 0.0)
        before = float(np.clip(0.0, *bounds[k]))
        column = np.concatenate([[before], values[:, k]])
        acting[:, k] = column[np.searchsorted(times, grid[:-1] + 0.5 * fine - delay, side="right")]
        if name == "throttle" and "dead_band" in truth:
            acting[:, k] = np.sign(acting[:, k]) * np.maximum(np.abs(acting[:, k]) - truth["dead_band"], 0.0)
    if len(control_noise):
        blocks = rng.normal(size=(count // per_control_noise + 1, len(model.controls))) * np.array(control_noise)
        acting += np.repeat(blocks, per_control_noise, axis=0)[:count]
    if spread is None:
        states = motion.simulate(states[:1], acting[:, None], p[None], np.array([fine]))[:, 0]
    else:
        for i in range(count):
            after = motion.after(states[i : i + 1], acting[i : i + 1], p, np.array([fine]))
            states[i + 1] = after[0] + spread * rng.normal(size=len(spread))
    pose_times = np.arange(0.0, seconds - 1e-9, 1.0 / rate) + 0.0123
    at = [np.interp(pose_times, grid, states[:, model.index(name)]) for name in ("x", "y", "theta")]
    x, y, theta = at
    lever, side = truth.get("lever", 0.0), truth.get("side", 0.0)
    poses = np.column_stack(
        [
            x + lever * np.cos(theta) - side * np.sin(theta),
            y + lever * np.sin(theta) + side * np.cos(theta),
            theta + truth.get("yaw_offset", 0.0),
        ]
    )
    poses += rng.normal(size=poses.shape) * np.array([noise[0], noise[0], noise[1]])
    bad = rng.random(len(poses)) < outliers
    angle = rng.uniform(0, 2 * np.pi, len(poses))
    poses[bad, 0] += 0.5 * np.cos(angle[bad])
    poses[bad, 1] += 0.5 * np.sin(angle[bad])
    return Log(f"log-{seed:03d}", (), tuple(model.controls), (Part(times, values, pose_times, poses),))
