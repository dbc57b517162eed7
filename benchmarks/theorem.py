"""Theorem 1: a world that deviates from the predictions by at most delta, as badly as it can, and no collision ever.

The true vehicle is anywhere within delta of what was predicted for the reference that is being executed: every point
of its footprint, at every time.  Two worlds: one pushes it about at random, the other always towards the nearest
obstacle.  Observations lie about as much.  Conservative replanning in random arenas must never collide.
"""

from __future__ import annotations

import math
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np

from benchmarks.effort import Effort
from benchmarks.exact import Body
from benchmarks.random_scenes import RandomScene, random_scene, random_start, vehicle_named
from benchmarks.report import Report, Target, row
from kraft.driving.car_model import CarModel
from kraft.driving.control import make_controller
from kraft.driving.control_settings import Kinodynamic, OpenLoop
from kraft.driving.messages import Cycle, Estimate, Reference, ReferenceKind
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from kraft.planning.compilation import ensure_compiled
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver

DELTA = 0.08  # m
CYCLES = 25
TURN = 0.3  # share of delta that a wrong heading may use up
CAPACITY = 4_000  # nodes
ITERATIONS = 200  # of a cycle
PERIOD = 0.1  # of the controller (s)
VEHICLES = ("mushr", "mushr-lag")


@dataclass(frozen=True)
class Episode:
    """How a drive went: cycles driven, contingencies among them, and the smallest true clearance (m)."""

    number: int
    hostile: bool
    cycles: int
    contingencies: int
    arrived: bool
    clearance: float
    broken: int


def run(effort: Effort) -> Report:
    """Drive in all arenas."""
    for name in VEHICLES:
        ensure_compiled(vehicle_named(name), lambda text: print(text, file=sys.stderr))
    numbers = range(effort.episodes)
    if effort.jobs == 1:
        episodes = list(map(episode, numbers))
    else:
        with ProcessPoolExecutor(effort.jobs, mp_context=get_context("spawn")) as pool:
            episodes = list(pool.map(episode, numbers, chunksize=10))
    hits = [e.number for e in episodes if e.clearance <= 0.0]
    rows = [
        row("episodes", "", [len(episodes)]),
        row("episodes of the hostile world", "", [sum(e.hostile for e in episodes)]),
        row("cycles", "", [sum(e.cycles for e in episodes)]),
        row("contingencies", "", [sum(e.contingencies for e in episodes)]),
        row("arrivals", "", [sum(e.arrived for e in episodes)]),
        row("smallest clearance", "mm", [1000 * min(e.clearance for e in episodes)]),
        row("cycles in which the assumption did not hold", "", [sum(e.broken for e in episodes)], Target(0)),
        row("collisions", "", [len(hits)], Target(0)),
    ]
    return Report("theorem", rows, notes=[f"collisions in episodes {hits}"] if hits else [])


def episode(number: int, loss: float = 0.0) -> Episode:
    """Drive in arena `number`; odd ones are hostile.

    A share `loss` of the messages is lost; the vehicle then tracks the contingency that it has on board.
    """
    scene, rng = random_scene(number), np.random.default_rng([7, number])
    vehicle = vehicle_named(VEHICLES[number // 2 % len(VEHICLES)])
    safety = Safety(cycle=1.0, delta=DELTA)
    dirt = DirtSolver(vehicle, scene.workspace, scene.goal, safety, Settings(), CAPACITY)
    model = CarModel(vehicle)
    kind = OpenLoop(kind="open_loop") if number // 4 % 2 else Kinodynamic(kind="kinodynamic")
    on_board = {"on_board": "contingency", "safety": Clearance(delta=DELTA, delta_per_speed=0.0)} if loss else {}
    settings = PlannerSettings.model_validate({"mode": "replanning", "lead": 0.0, "iterations": ITERATIONS, **on_board})
    replanner = Replanner(Solvers(dirt, dirt), settings, make_controller(kind, model), number, period=PERIOD)
    body = Body(scene.solids, vehicle.footprint)
    start = random_start(rng, vehicle, scene.workspace.bounds, body, replace(safety, delta=2 * DELTA))
    start[3] = 0.0
    drive = _Drive(scene, body, vehicle.footprint.reach, rng, hostile=bool(number % 2), loss=loss)
    return drive.run(replanner, start)


class _Drive:
    """A true vehicle that is `offset` (x, y, heading) away from what was predicted."""

    def __init__(
        self, scene: RandomScene, body: Body, reach: float, rng: np.random.Generator, *, hostile: bool, loss: float
    ) -> None:
        self._loss, self._radio = loss, np.random.default_rng([8, scene.number])
        self._scene, self._body, self._rng, self._hostile = scene, body, rng, hostile
        self._reach = reach
        self._turn = TURN * DELTA / reach
        self._offset = np.zeros(3)
        self._clearance = math.inf

    def run(self, replanner: Replanner, start: Floats) -> Episode:
        """Replan and deviate until the goal is reached or the cycles are over."""
        current, believed = replanner.begin(start), start
        stops, broken, cycles = 0, 0, 0
        for number in range(CYCLES):
            truth = believed[:3] + self._offset
            if math.dist(truth[:2], self._scene.goal.center) < self._scene.goal.radius or self._clearance <= 0.0:
                break
            estimate = believed.copy()
            estimate[:3] = truth - self._lie(truth)
            cycle = replanner.step(Estimate(float(number), estimate, 0.0), current)
            stops += cycle.kind is ReferenceKind.CONTINGENCY
            if number > 0 and self._radio.random() < self._loss:
                predicted = current.reference_at(float(number))
            else:
                predicted, current = self._predicted(cycle), cycle.commitment
            self._offset = truth - predicted.state_at(float(number))[:3]
            broken += self._deviation() > DELTA + 1e-9
            believed = self._execute(predicted, float(number))
            cycles += 1
        arrived = math.dist((believed[:3] + self._offset)[:2], self._scene.goal.center) < self._scene.goal.radius
        return Episode(self._scene.number, self._hostile, cycles, stops, arrived, self._clearance, broken)

    def _predicted(self, cycle: Cycle) -> Reference:
        """What SAFETY was asked about: the closed loop's prediction for a plan, the manoeuvre for a contingency."""
        if cycle.kind is ReferenceKind.CONTINGENCY:
            return cycle.reference
        return replace(cycle.reference, times=cycle.predicted.times, states=cycle.predicted.states)

    def _execute(self, predicted: Reference, begins: float) -> Floats:
        """A cycle of true motion; returns the state predicted at its end."""
        for time in begins + 0.05 * np.arange(1, 21):
            self._offset = self._drift(predicted.state_at(time))
            pose = predicted.state_at(time)[:3] + self._offset
            self._clearance = min(self._clearance, self._body.distance(*pose))
        return predicted.state_at(begins + 1.0)

    def _drift(self, state: Floats) -> Floats:
        """Another deviation within delta, a little farther along."""
        target = self._target(state[:3] + self._offset)
        step = target - self._offset
        most = DELTA / 4
        moved = self._offset + step * min(1.0, most / max(float(np.hypot(*step[:2])), 1e-12))
        moved[2] = min(max(moved[2], -self._turn), self._turn)
        moved[:2] *= min(1.0, self._room() / max(float(np.hypot(*moved[:2])), 1e-12))
        return moved

    def _target(self, pose: Floats) -> Floats:
        turn = self._rng.uniform(-self._turn, self._turn)
        if self._hostile:
            return np.array([*(self._room() * self._towards_obstacle(pose)), turn])
        angle, share = self._rng.uniform(-math.pi, math.pi), math.sqrt(self._rng.random())
        return np.array([self._room() * share * math.cos(angle), self._room() * share * math.sin(angle), turn])

    def _lie(self, truth: Floats) -> Floats:
        """Truth minus estimate: in the hostile world the vehicle is nearer to an obstacle than it seems."""
        return self._target(truth)

    def _towards_obstacle(self, pose: Floats) -> Floats:
        """Unit vector along which the clearance falls fastest."""
        ways, step = np.linspace(-math.pi, math.pi, 16, endpoint=False), 0.01
        around = pose + step * np.column_stack([np.cos(ways), np.sin(ways), np.zeros(len(ways))])
        best = ways[int(np.argmin(self._body.distances(around)))]
        return np.array([math.cos(best), math.sin(best)])

    def _room(self) -> float:
        return DELTA * (1.0 - TURN)

    def _deviation(self) -> float:
        """How far any point of the footprint is from where it was predicted, at most (m)."""
        return float(np.hypot(*self._offset[:2])) + abs(float(self._offset[2])) * self._reach
