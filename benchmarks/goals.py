"""Goals with a heading and at rest: turning round, parking, and problems of dynobench with known good solutions."""

from __future__ import annotations

import importlib
import importlib.util
import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from benchmarks.effort import Effort
from benchmarks.exact import Body, Rectangle
from benchmarks.judge import Motion, dense
from benchmarks.models import Model, model_of, rk4
from benchmarks.report import Report, Row, Target, row, silenced
from kraft.vehicles.dynobench import APPROACH, SPEED, TURN, UNICYCLE1_V0, UNICYCLE1_V1, UNICYCLE1_V2, UNICYCLE2_V0
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.obstacles import Workspace, box
from ompl_ext.plan import Plan
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

FOLDER = "KRAFT_DYNOBENCH"  # environment variable: a folder with NAME_0.yaml and reference_NAME_0.yaml
FOUND_WITHIN, GOOD_WITHIN = 0.2, 1.0  # s
NEAR_BEST = 1.05  # of the best known cost
FINER = 20  # steps of the independent integration in each edge
FIRST = 0.1  # s until the first solution
JUDGE_STEP, JUDGE_EVERY = 0.001, 10  # s of a step of dynobench, steps between two checks for collisions
AT_REST = {"v": (-0.05, 0.05)}


OTHERS = (("f1tenth", 1.3), ("f1tenth", 1.6), ("jackal", 1.3), ("jackal", 1.6), ("unicycle2", 1.6), ("unicycle2", 2.0))
LENGTH = 0.4  # of the vehicle for which the street is 1.4 m wide (m)
REVERSING = replace(MUSHR, controls={"throttle": (-1.0, 1.0), "steering": MUSHR.controls["steering"]})


@dataclass(frozen=True)
class Problem:
    """Start, goal and rectangles; `best` is the best known cost (s), None if unknown, `file` dynobench's problem."""

    name: str
    vehicle: Vehicle
    model: Model
    bounds: tuple[tuple[float, float], tuple[float, float]]
    solids: tuple[Rectangle, ...]
    start: Floats
    goal: Goal
    safety: Safety
    best: float | None = None
    file: Path | None = None

    def solver(self) -> DirtSolver:
        """Solver with its maps."""
        obstacles = tuple(box(solid.center, solid.size, solid.yaw) for solid in self.solids)
        return DirtSolver(self.vehicle, Workspace(self.bounds, obstacles), self.goal, self.safety, Settings())

    def holds(self, plan: Plan) -> bool:
        """Whether an independent integration of the plan is free, as `dense` looks at it, and ends in the goal."""
        motion = self.integrated(plan)
        _, states = dense(self.model, motion, self.vehicle.footprint.reach)
        free = not Body(self.solids, self.vehicle.footprint).any_collision(states[:, :3])
        return free and self.goal.contains(self.vehicle, motion.samples[-1])

    def integrated(self, plan: Plan) -> Motion:
        """The plan's controls from the start, in `FINER` steps for each edge."""
        times, samples, controls = [0.0], [self.start], []
        for control, duration in zip(plan.controls, plan.durations, strict=True):
            for _ in range(FINER):
                step = duration / FINER
                times.append(times[-1] + step)
                samples.append(rk4(self.model, samples[-1][None], control[None], np.array([step]))[0])
                controls.append(control)
        held = np.array(controls).reshape(-1, len(self.vehicle.controls))
        return Motion(np.array(times), np.array(samples), held)


def turning_round(size: float) -> Problem:
    """Turn round on the spot in a room of `size` m by `size` m."""
    goal = Goal((size / 2, size / 2), 0.05, math.pi, math.radians(5), AT_REST)
    bounds, start = ((0.0, size), (0.0, size)), np.array([size / 2, size / 2, 0.0, 0.0])
    return Problem(
        f"turning round, {size:g} m", REVERSING, model_of(REVERSING), bounds, fence(bounds), start, goal, Safety()
    )


def parking(lengths: float, *, left: bool = False, vehicle: Vehicle = REVERSING) -> Problem:
    """Park between two cars, on the right or left of the street; the gap is that many vehicle lengths long.

    All other lengths are proportional to the vehicle's.
    """
    size, scale = (vehicle.footprint.length, vehicle.footprint.width), vehicle.footprint.length / LENGTH
    gap, x, y = lengths * size[0], 1.6 * scale, size[1] / 2 + 0.06 * scale
    y = 1.4 * scale - y if left else y
    cars = tuple(Rectangle((x + side * (gap + size[0]) / 2, y), size, 0.0) for side in (-1, 1))
    at_rest = dict.fromkeys(vehicle.rest, AT_REST["v"])
    goal = Goal((x - vehicle.footprint.offset, y), 0.05 * scale, 0.0, math.radians(5), at_rest)
    bounds, start = ((0.0, 3.2 * scale), (0.0, 1.4 * scale)), np.zeros(len(vehicle.state))
    start[[vehicle.index("x"), vehicle.index("y")]] = 0.6 * scale, 0.7 * scale
    name = f"parking{' left' if left else ''}, {lengths:g} lengths"
    name += "" if vehicle is REVERSING else f", {vehicle.name}"
    return Problem(name, vehicle, model_of(vehicle), bounds, fence(bounds) + cars, start, goal, Safety())


def fence(bounds: tuple[tuple[float, float], tuple[float, float]], thick: float = 0.4) -> tuple[Rectangle, ...]:
    """Walls around the bounds."""
    (x0, x1), (y0, y1) = bounds
    across, along = (x1 - x0 + 2 * thick, thick), (thick, y1 - y0)
    return (
        Rectangle(((x0 + x1) / 2, y0 - thick / 2), across, 0.0),
        Rectangle(((x0 + x1) / 2, y1 + thick / 2), across, 0.0),
        Rectangle((x0 - thick / 2, (y0 + y1) / 2), along, 0.0),
        Rectangle((x1 + thick / 2, (y0 + y1) / 2), along, 0.0),
    )


def first_order(x: Matrix, u: Matrix) -> Matrix:
    """Unicycle of first order."""
    return np.column_stack([u[:, 0] * np.cos(x[:, 2]), u[:, 0] * np.sin(x[:, 2]), u[:, 1]])


def second_order(x: Matrix, u: Matrix) -> Matrix:
    """Unicycle of second order, whose accelerations fade where a speed reaches its limit."""
    v, omega = x[:, 3], x[:, 4]
    speeds = ((u[:, 0], v, SPEED), (u[:, 1], omega, TURN))
    rates = [np.clip(a, -APPROACH * (most + s), APPROACH * (most - s)) for a, s, most in speeds]
    return np.column_stack([v * np.cos(x[:, 2]), v * np.sin(x[:, 2]), omega, *rates])


ROBOTS = {
    **{vehicle.name: (vehicle, first_order) for vehicle in (UNICYCLE1_V0, UNICYCLE1_V1, UNICYCLE1_V2)},
    UNICYCLE2_V0.name: (UNICYCLE2_V0, second_order),
}


def dynobench(folder: Path) -> list[Problem]:
    """Problems of a folder for dynobench's unicycles; goals within 2 cm, 2 degrees, and at rest 0.02 m/s and rad/s."""
    problems = []
    for path in sorted(folder.glob("[!r]*_[0-9].yaml")):
        content, best = yaml.safe_load(path.read_text()), folder / f"reference_{path.name}"
        robot, place = content["robots"][0], content["environment"]
        vehicle, model = ROBOTS[robot["type"]]
        bounds = ((place["min"][0], place["max"][0]), (place["min"][1], place["max"][1]))
        solids = tuple(Rectangle(tuple(one["center"]), tuple(one["size"]), 0.0) for one in place["obstacles"])
        x, y, theta, *rest = map(float, robot["goal"])
        limits = {name: (value - 0.02, value + 0.02) for name, value in zip(vehicle.rest, rest, strict=True)}
        goal, safety = Goal((x, y), 0.02, theta, math.radians(2), limits), Safety(enabled=False, cycle=0.0)
        cost = float(yaml.safe_load(best.read_text())["cost"]) if best.exists() else None
        start = np.array(robot["start"], dtype=float)
        problems.append(Problem(content["name"], vehicle, model, bounds, solids, start, goal, safety, cost, path))
    return problems


def holds_by_dynobench(problem: Problem, plan: Plan) -> bool:
    """Whether dynobench's own integration of a plan is free by its own collision check and ends in the goal.

    Its `step` is Euler's, made 1 ms long; the second-order robot gets the accelerations that the plan's controls cause.
    """
    package = importlib.import_module("dynobench")
    with silenced():
        model = f"{package.PKGDIR}models/{problem.vehicle.name}.yaml"
        robot, found = package.robot_factory_with_env(model, str(problem.file)), package.CollisionOut()
    state, after, count = problem.start.copy(), np.zeros(len(problem.start)), 0
    for control, duration in zip(plan.controls, plan.durations, strict=True):
        steps = max(1, math.ceil(duration / JUDGE_STEP))
        for _ in range(steps):
            action = problem.model(state[None], control[None])[0, 3:] if len(state) > 3 else control
            if np.any(action < robot.get_u_lb() - 1e-6) or np.any(action > robot.get_u_ub() + 1e-6):
                return False
            robot.step(after, state, np.ascontiguousarray(action), duration / steps)
            state, count = after.copy(), count + 1
            if count % JUDGE_EVERY == 0:
                robot.collision_distance(state, found)
                if found.distance < 0.0:
                    return False
    return problem.goal.contains(problem.vehicle, state)


def run(effort: Effort) -> Report:
    """Measure every problem."""
    seeds = max(1, effort.seeds // 5) if effort.seeds < 100 else 50
    problems = [turning_round(size) for size in (1.5, 2.0, 3.0)]
    problems += [parking(lengths) for lengths in (1.3, 1.6, 2.0)] + [parking(1.3, left=True)]
    problems += [parking(lengths, vehicle=load_vehicle(name)) for name, lengths in OTHERS]
    if effort.nodes < 100_000:  # one of each kind
        problems = [problems[1], problems[3]]
    rows = [each for problem in problems for each in measured(problem, seeds, FOUND_WITHIN)]
    if folder := os.environ.get(FOLDER):
        for problem in dynobench(Path(folder)):
            rows += measured(problem, max(1, min(seeds, 20)), GOOD_WITHIN)
    notes = [
        "Parking, turning round: `mushr` that drives backwards as fast as ahead; within 5 cm and 5 degrees, at rest.",
        f"Problems of dynobench are read from the folder in {FOLDER}: within 2 cm and 2 degrees.",
        f"Holds by dynobench: by its own step of {1e3 * JUDGE_STEP:g} ms and its own collision check.",
        "A plan holds if an independent integration of its controls is free and ends in the goal.",
    ]
    return Report("goals", rows, notes=notes)


def measured(problem: Problem, seeds: int, seconds: float) -> list[Row]:
    """Rows of one problem: set-up, first solutions, costs, and how many plans hold."""
    began = time.perf_counter()
    solver = problem.solver()
    set_up = time.perf_counter() - began
    firsts, costs, held, judged = [], [], [], []
    for seed in range(seeds):
        solver.start(problem.start, seed)
        progress = solver.grow(seconds=seconds)
        plan = solver.plan()
        first = progress.first_solution
        firsts.append(1e3 * first[0] if first else math.inf)
        costs.append(progress.history[-1][1] if progress.history else math.inf)
        if problem.file is not None and importlib.util.find_spec("dynobench"):
            judged.append(100.0 if plan is not None and holds_by_dynobench(problem, plan) else 0.0)
        held.append(100.0 if plan is not None and plan.reaches_goal and problem.holds(plan) else 0.0)
    cost = Target(NEAR_BEST * problem.best) if problem.best else None
    limit = FIRST if problem.best else FOUND_WITHIN
    rows = [
        row(f"{problem.name}: set-up", "ms", [1e3 * set_up]),
        row(f"{problem.name}: first solution", "ms", firsts, Target(1e3 * limit)),
        row(f"{problem.name}: cost after {seconds:g} s", "s", costs, cost),
        row(f"{problem.name}: plans that hold after {seconds:g} s", "%", held, Target(100.0, most=False, of="worst")),
    ]
    if judged:
        judge = Target(100.0, most=False, of="worst")
        rows.append(row(f"{problem.name}: plans that hold by dynobench", "%", judged, judge))
    return rows
