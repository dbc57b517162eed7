"""How far the estimated state is from the true one while a robot drives: unknown cars, random arenas, four scenes.

Estimates are those that the controller gets, 30 times a second: ahead by the delay that the estimator makes up for, and
compared with the truth at their own time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.arenas import arena
from benchmarks.effort import Effort
from benchmarks.estimated import episode_parts
from benchmarks.parallel import each, planning_vehicle
from benchmarks.report import Report, row
from kraft.driving.method import load_method
from kraft.scenario import load_scenario
from kraft.simulation.model_world import ModelWorld
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.vehicle import Vehicle

CARS, ROOMS, SCENES = "unknown cars", "arenas", ("movable", "slope", "slip", "bump")
KINDS = (CARS, ROOMS, *SCENES)
FIRST_CAR, FIRST_ARENA = 20_000, 1_000
"""Numbers of the first episode and arena: with these and later ones nothing was chosen, and no target is measured."""
QUANTILE = 0.99


@dataclass(frozen=True)
class Errors:
    """Errors (n, 4) of a drive's estimates: along x and y (m), of the heading (rad) and of the speed (m/s)."""

    kind: str
    values: Matrix


def run(effort: Effort) -> Report:
    """Drive `effort.estimates` times in each kind of world."""
    planning_vehicle(effort.method)
    drives = each(partial(drive, name=effort.method), range(effort.estimates * len(KINDS)), effort.jobs)
    rows = []
    for kind in KINDS:
        found = [d.values for d in drives if d.kind == kind]
        apart = [np.hypot(values[:, 0], values[:, 1]) for values in found]
        rows += [
            row(f"{kind}: error of the position, root mean square of a drive", "cm", [100.0 * _rms(a) for a in apart]),
            row(f"{kind}: 99 % of the errors of the position", "cm", [100.0 * np.quantile(a, QUANTILE) for a in apart]),
            row(f"{kind}: error of the heading", "deg", [math.degrees(_rms(values[:, 2])) for values in found]),
            row(f"{kind}: error of the speed", "m/s", [_rms(values[:, 3]) for values in found]),
        ]
    table = [["", "position, rms, cm", "99 %, cm", "heading, rms, deg", "speed, rms, m/s"]]
    table += [_line(kind, [d.values for d in drives if d.kind == kind]) for kind in KINDS]
    notes = [
        f"{effort.method}; {effort.estimates} drives of each kind.  Samples are drives; the table has all estimates.",
        "The true speed is that along the heading.",
    ]
    return Report("estimates", rows, {"all estimates": table}, notes)


def drive(number: int, name: str) -> Errors:
    """Drive `number`; kinds take turns."""
    k, kind = number // len(KINDS), KINDS[number % len(KINDS)]
    if kind == CARS:
        spec, true = episode_parts(FIRST_CAR + k, name)
        world = ModelWorld(spec.scenario, true, {}, spec.seed)
        return Errors(kind, errors_of(run_trial(spec, world=world), spec.vehicle))
    scenario = arena(FIRST_ARENA + k)[1] if kind == ROOMS else load_scenario(kind, {})
    method = load_method(name)
    vehicle = load_vehicle(method.planner.vehicle or scenario.vehicle)
    return Errors(kind, errors_of(run_trial(TrialSpec(scenario, method, vehicle, k)), vehicle))


def errors_of(result: TrialResult, vehicle: Vehicle) -> Matrix:
    """Errors (n, 4) of the estimates of a drive, see `Errors`."""
    times = np.array([step.time for step in result.steps])
    poses = np.array([step.pose for step in result.steps])
    poses[:, 2] = np.unwrap(poses[:, 2])
    velocity = np.gradient(poses[:, :2], times, axis=0)
    speeds = velocity[:, 0] * np.cos(poses[:, 2]) + velocity[:, 1] * np.sin(poses[:, 2])
    own = times + np.array([step.ahead for step in result.steps])
    within = own <= times[-1]
    truth = interpolated_rows(own[within], times, np.column_stack([poses, speeds]))
    components = [*(vehicle.index(name) for name in ("x", "y", "theta")), vehicle.rest_indices[0]]
    estimates = np.array([step.estimate[components] for step in result.steps])[within]
    errors: Matrix = estimates - truth
    errors[:, 2] -= math.tau * np.round(errors[:, 2] / math.tau)
    return errors


def _line(kind: str, values: Sequence[Matrix]) -> list[str]:
    together = np.concatenate(values)
    apart = np.hypot(together[:, 0], together[:, 1])
    position, most = 100.0 * _rms(apart), 100.0 * np.quantile(apart, QUANTILE)
    return [
        kind,
        f"{position:.1f}",
        f"{most:.1f}",
        f"{math.degrees(_rms(together[:, 2])):.1f}",
        f"{_rms(together[:, 3]):.3f}",
    ]


def _rms(errors: Matrix) -> float:
    return float(np.sqrt(np.mean(errors**2)))
