"""Logs that a vehicle model makes of itself, with known parameters: for the tests and benchmarks of identification."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.signal import lfilter

from kraft.logs.log import Log, Part
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.parameters import vehicle_of
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

FINE = 0.005
"""Integration step, s: ten times finer than what identification uses."""
CONTROL_HOLD = 10  # fine steps for which the noise of a control stays the same
BREAKAWAY = 0.01
"""Speed over which friction rises from nothing, m/s: a fifth of what identification takes."""
FIRST_POSE = 0.0123
"""Time of the first pose, s: the clocks of commands and poses have nothing to do with each other."""
OUTLIER = 0.5  # m

CommandSeries = tuple[Floats, Matrix]
Motion = Callable[[Floats], Floats]
"""States (steps + 1, logs, nx) from rest with the controls (steps, logs, nu) that act in each step of `FINE` s."""


def random_commands(vehicle: Vehicle, seconds: float, rng: np.random.Generator, hold: float = 1.0) -> CommandSeries:
    """CommandSeries that jump about every `hold` s, to anything between their bounds, but never far back."""
    times = np.cumsum([0.0, *(hold * rng.uniform(0.5, 1.5, round(2 * seconds / hold) + 1))])
    times = times[times < seconds]
    columns = []
    for name, (low, high) in vehicle.controls.items():
        least = high * 0.3 if name == "throttle" else low
        columns.append(rng.uniform(least, high, len(times)))
    return times, np.column_stack(columns)


def synthetic_logs(
    vehicle: VehicleConfig | Vehicle,
    truth: Mapping[str, float],
    seeds: Sequence[int],
    *,
    seconds: float = 20.0,
    noise: tuple[float, float] = (0.01, 0.02),
    process: Sequence[float] = (),
    control_noise: Sequence[float] = (),
    rate: float = 30.0,
    outliers: float = 0.0,
    commands: Sequence[CommandSeries] | None = None,
    motion: Motion | None = None,
) -> list[Log]:
    """One log per seed, each from rest at the origin, of a vehicle with parameters and extras `truth`.

    `noise` of the poses is in m and rad; `process` (nx,) what disturbs the state per square root of a second,
    `control_noise` (nu,) the deviation of controls held for 50 ms; `outliers` the share of poses that are off by 0.5 m;
    `motion` what moves instead of the vehicle's model, undisturbed.
    """
    model = vehicle_of(vehicle)
    generators = [np.random.default_rng(seed) for seed in seeds]
    given = commands or [random_commands(model, seconds, rng) for rng in generators]
    acting = np.stack([_acting(model, truth, c, seconds) for c in given], axis=1)
    if len(control_noise):
        acting += _held(generators, acting.shape, np.array(control_noise))
    states = motion(acting) if motion else _driven(model, truth, acting, generators, np.array(process))
    return [
        Log(
            f"log-{seed:03d}",
            (),
            tuple(model.controls),
            (Part(*c, *_seen(model, truth, states[:, k], rng, seconds, noise, rate, outliers)),),
        )
        for k, (seed, c, rng) in enumerate(zip(seeds, given, generators, strict=True))
    ]


def _acting(model: Vehicle, truth: Mapping[str, float], commands: CommandSeries, seconds: float) -> Matrix:
    """Controls (steps, nu) as they act: delayed, behind the play, less the dead band, and lagging."""
    times, values = commands
    middles = FINE * (np.arange(round(seconds / FINE)) + 0.5)
    acting = np.empty((len(middles), len(model.controls)))
    for k, (name, bounds) in enumerate(model.controls.items()):
        delay = truth.get("delay", 0.0) + truth.get(f"delay_{name}", 0.0)
        column = np.concatenate([[float(np.clip(0.0, *bounds))], values[:, k]])
        column = _pushed(column, truth.get(f"play_{name}", 0.0), -truth.get("phi_diff", 0.0))
        u = column[np.searchsorted(times, middles - delay, side="right")]
        held = np.sign(u) * np.maximum(np.abs(u) - truth.get(f"dead_band_{name}", 0.0), 0.0)
        acting[:, k] = _lagging(held, truth.get(f"lag_{name}", 0.0))
    return acting


def _pushed(values: Floats, play: float, at: float) -> Floats:
    """What values (n,) push from `at` on, at the ends of a play of +-`play`."""
    found = [at := min(max(at, value - play), value + play) for value in values.tolist()]
    return np.array(found)


def _lagging(held: Floats, lag: float) -> Floats:
    """What follows a signal (steps,) with a time constant, s, in the middle of each step."""
    if lag == 0.0:
        return held
    stays = float(np.exp(-FINE / lag))
    after: Floats = lfilter([1.0 - stays], [1.0, -stays], held, zi=[stays * held[0]])[0]
    return 0.5 * (after + np.concatenate([held[:1], after[:-1]]))


def _held(generators: Sequence[np.random.Generator], shape: tuple[int, ...], sigma: Floats) -> Floats:
    blocks = [rng.normal(size=(shape[0] // CONTROL_HOLD + 1, shape[2])) * sigma for rng in generators]
    held: Floats = np.repeat(np.stack(blocks, axis=1), CONTROL_HOLD, axis=0)[: shape[0]]
    return held


def _driven(
    model: Vehicle,
    truth: Mapping[str, float],
    acting: Floats,
    generators: Sequence[np.random.Generator],
    process: Floats,
) -> Floats:
    """States (steps + 1, logs, nx)."""
    discrete_model, count = DiscreteModel(model), acting.shape[1]
    p = np.array([truth.get(name, value) for name, value in model.parameters.items()] or [0.0])
    h = np.full(count, FINE)
    start = np.zeros((count, len(model.state)))
    friction = 0.0 if "friction" in model.parameters else truth.get("friction", 0.0)
    if not len(process) and not friction:
        return discrete_model.simulate(start, acting, np.tile(p, (count, 1)), h)
    states = np.empty((len(acting) + 1, *start.shape))
    states[0] = start
    pushes = _pushes(generators, len(acting), process) if len(process) else np.zeros((len(acting), *start.shape))
    for i, push in enumerate(pushes):
        states[i + 1] = discrete_model.step(states[i], _rubbed(model, acting[i], states[i], friction), p, h) + push
    return states


def _pushes(generators: Sequence[np.random.Generator], steps: int, process: Floats) -> Floats:
    """What disturbs the states in each step (steps, logs, nx)."""
    pushes = np.stack([rng.normal(size=(steps, len(process))) for rng in generators], axis=1)
    return pushes * process * np.sqrt(FINE)


def _rubbed(model: Vehicle, controls: Matrix, states: Matrix, friction: float) -> Matrix:
    """Controls (logs, nu) less the throttle that friction takes; what is left of the full one counts as full."""
    if friction == 0.0:
        return controls
    k, full = list(model.controls).index("throttle"), max(map(abs, model.controls["throttle"]))
    sense = np.clip(states[:, model.index("v")] / BREAKAWAY, -1.0, 1.0)
    rubbed = controls.copy()
    rubbed[:, k] = (controls[:, k] - friction * sense) / (1.0 - friction / full)
    return rubbed


def _seen(
    model: Vehicle,
    truth: Mapping[str, float],
    states: Matrix,
    rng: np.random.Generator,
    seconds: float,
    noise: tuple[float, float],
    rate: float,
    outliers: float,
) -> tuple[Floats, Matrix]:
    times = np.arange(FIRST_POSE, seconds, 1.0 / rate)
    grid = FINE * np.arange(len(states))
    x, y, theta = (np.interp(times, grid, states[:, model.index(name)]) for name in ("x", "y", "theta"))
    beside = {name: value for name, value in truth.items() if name not in model.parameters}
    lever, side, offset = (beside.get(name, 0.0) for name in ("lever", "side", "yaw_offset"))
    c, s = np.cos(theta), np.sin(theta)
    poses = np.column_stack([x + lever * c - side * s, y + lever * s + side * c, theta + offset])
    poses += rng.normal(size=poses.shape) * np.array([noise[0], noise[0], noise[1]])
    bad, angle = rng.random(len(poses)) < outliers, rng.uniform(0.0, 2.0 * np.pi, len(poses))
    poses[:, 0] += np.where(bad, OUTLIER * np.cos(angle), 0.0)
    poses[:, 1] += np.where(bad, OUTLIER * np.sin(angle), 0.0)
    return times, poses
