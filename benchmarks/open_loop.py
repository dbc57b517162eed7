"""Plans with identified models, driven open loop by the true robot: how far off it is where they end.

Each vehicle is recorded as `kraft record` does it, identified as `kraft sysid LOGS --out FILE` does it, and its plans
are made with that file.  The true robot, in MuJoCo, gets the commands of the plan at their times and nothing else, on
an empty floor, so that no wall ends the drive.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

import kraft
from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from kraft.scenario import Scenario
from kraft.scenario.schema import Bounds
from kraft.simulation.true_world import world_of
from kraft_cli.work.record import RecordRequest, record_logs
from kraft_cli.work.sysid import run_sysid
from kraft_cli.work.sysid_request import SysidRequest
from ompl_ext.plan import Plan
from ompl_ext.vehicle import Vehicle

VEHICLES: Final = ("f1tenth", "jackal")
SCENES: Final = ("turns", "boxes", "posts", "track")
RUNS: Final = 10
SIDE: Final = 100.0
"""Half of the side of the empty floor, m."""
OFF: Final = 0.1
"""Largest distance from the end of a plan, over its length."""


def run(effort: Effort) -> Report:
    """Measure over recordings with several seeds; with each several plans of each scene."""
    seeds = max(1, min(effort.repeats, 3))
    rows = [entry for name in VEHICLES for entry in measured(name, seeds, SCENES if effort.repeats > 1 else SCENES[:1])]
    return Report("open_loop", rows, notes=[f"{RUNS} runs of kraft record training, kraft sysid with its defaults."])


def measured(name: str, seeds: int, scenes: tuple[str, ...]) -> list[Row]:
    """Distances from the ends of plans of a vehicle, for `seeds` recordings and as many plans with each."""
    shares: dict[str, list[float]] = {scene: [] for scene in scenes}
    distances, lengths = [], []
    with TemporaryDirectory() as folder:
        for seed in range(seeds):
            vehicle = identified(name, Path(folder) / f"{name}-{seed}", 100 + seed)
            for scene in scenes:
                for number in range(seeds):
                    scenario = kraft.load_scenario(scene)
                    plan = kraft.plan(scenario.task(), vehicle=vehicle, seed=number).plan
                    assert plan is not None, f"{name} has no plan in {scene}"
                    off, length = deviation(scenario, vehicle, plan), path_length(vehicle, plan)
                    shares[scene].append(off / length)
                    distances.append(100.0 * off)
                    lengths.append(length)
    return [
        *(row(f"{name}, {scene}: off at the end, over the length of the plan", "1", each, Target(OFF, of="worst"))
          for scene, each in shares.items()),
        row(f"{name}: off at the end", "cm", distances),
        row(f"{name}: length of the plans", "m", lengths),
    ]  # fmt: skip


def identified(name: str, folder: Path, seed: int) -> Vehicle:
    """The vehicle of the file that `kraft sysid` writes from recorded runs."""
    record_logs(RecordRequest(out=folder, runs=RUNS, seed=seed, vehicle=name), lambda text: None)
    file = folder.with_suffix(".yaml")
    result = run_sysid(SysidRequest(logs=(folder,), out=file), lambda text: None, lambda text: None)
    assert not result.objections, result.objections
    return kraft.load_vehicle(str(file))


def deviation(scenario: Scenario, vehicle: Vehicle, plan: Plan) -> float:
    """Distance of the true robot from the end of a plan that it drove open loop, m."""
    floor = replace(scenario, obstacles=(), bounds=Bounds(x=(-SIDE, SIDE), y=(-SIDE, SIDE)))
    world = world_of(floor, vehicle, 0)
    order = [list(vehicle.controls).index(control) for control in world.controls]
    steps = np.diff(np.round(np.concatenate([[0.0], np.cumsum(plan.durations)]) / world.dt).astype(int))
    for control, count in zip(plan.controls, steps, strict=True):
        world.apply(control[order])
        world.step(int(count))
    end = plan.trajectory[-1, [vehicle.index("x"), vehicle.index("y")]]
    return float(np.hypot(*(world.pose[:2] - end)))


def path_length(vehicle: Vehicle, plan: Plan) -> float:
    """Length of the path of a plan, m."""
    return float(np.hypot(*np.diff(plan.trajectory[:, [vehicle.index("x"), vehicle.index("y")]], axis=0).T).sum())
