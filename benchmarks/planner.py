"""How fast the compiled planner is, and how good its plans are after how long."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, number, row
from benchmarks.scenes import NO_MARGIN, RK4_STEPS, SCENES, Scene, scene
from ompl_ext.problem import make_problem
from ompl_ext.query import Settings
from ompl_ext.query_tree import Progress
from ompl_ext.solver import DirtSolver

TRIES = 5  # runs of one seed, of which the median counts: the same work every time, at other moments
LOOKS = {0.005: 11.3, 0.020: 10.7, 0.100: 10.4}  # time (s) after which the cost (s) is at most this
WARM_UP = 1000  # iterations
PROCESSES = 3  # times as many as elsewhere: first plans differ by a factor of three from seed to seed


def run(effort: Effort) -> Report:
    """Measure on all scenes."""
    rows: list[Row] = []
    for name in SCENES:
        query = scene(name)
        dirt = query.dirt()
        dirt.start(query.start)
        dirt.grow(iterations=WARM_UP)
        rows += [*first_solutions(query, dirt, effort.seeds), *over_time(query, dirt, effort.seeds)]
        rows += [first_of_process(name, PROCESSES * effort.processes), *set_up(query, max(3, effort.repeats))]
    notes = [
        "The clock of a query runs from `start`, which empties the tree's memory, to when Python sees the solution.",
        f"An edge is {RK4_STEPS} RK4 steps and its collision checks; edges/s is over the whole loop.",
        "Set-up is what is done once per goal and map, before any query.",
    ]
    return Report("planner", rows, notes=notes)


def first_solutions(query: Scene, dirt: DirtSolver, seeds: int) -> list[Row]:
    """Time to, and cost of, each seed's first solution."""
    seconds, costs = [], []
    for seed in range(seeds):
        runs = [first_solution(query, dirt, seed) for _ in range(TRIES)]
        seconds.append(float(np.median([took for took, _ in runs])))
        costs.append(runs[0][1])
    milliseconds = [1e3 * took for took in seconds]
    return [
        row(f"{query.name}: first solution", "ms", milliseconds, Target(0.5)),
        row(f"{query.name}: first solution, worst seed", "ms", milliseconds, Target(3.0, of="worst")),
        row(f"{query.name}: cost of the first solution", "s", costs),
    ]


def first_solution(query: Scene, dirt: DirtSolver, seed: int) -> tuple[float, float]:
    """Seconds from an empty planner to the first solution, and its cost."""
    began = time.perf_counter()
    dirt.start(query.start, seed)
    progress = dirt.grow(stop=lambda: bool(dirt.progress.history))
    return time.perf_counter() - began, progress.history[0][1]


def first_of_process(name: str, processes: int) -> Row:
    """Time to the first solution where it is the first plan of a process, each with a seed of its own."""
    milliseconds = []
    for seed in range(processes):
        command = [sys.executable, "-m", "benchmarks.first_plan", name, str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        milliseconds.append(float(done.stdout))
    return row(f"{name}: first solution of a new process", "ms", milliseconds, Target(0.3))


def over_time(query: Scene, dirt: DirtSolver, seeds: int) -> list[Row]:
    """Costs as time passes, and edges per second."""
    last = max(LOOKS)
    costs: dict[float, list[float]] = {look: [] for look in LOOKS}
    rates = []
    for seed in range(seeds):
        began = time.perf_counter()
        dirt.start(query.start, seed)
        started = time.perf_counter() - began
        progress = dirt.grow(seconds=last - started)
        rates.append(progress.edges / progress.seconds)
        for look, of_seed in costs.items():
            of_seed.append(cost_after(progress, look - started))
    rows = [
        row(f"{query.name}: cost after {number(1e3 * look)} ms", "s", costs[look], Target(cost))
        for look, cost in LOOKS.items()
    ]
    return [*rows, row(f"{query.name}: checked edges", "1/s", rates, Target(3e6, most=False))]


def cost_after(progress: Progress, seconds: float) -> float:
    """The best cost known `seconds` after the search began, infinite if none was."""
    return min((cost for when, cost in progress.history if when <= seconds), default=float("inf"))


def set_up(query: Scene, repeats: int) -> list[Row]:
    """What is computed once per goal and map."""

    def maps() -> object:
        return make_problem(query.vehicle, query.workspace, query.goal, NO_MARGIN, Settings())

    dirt = query.dirt()

    def start() -> object:
        return dirt.start(query.start)

    return [
        row(f"{query.name}: maps (clearance field and cost-to-go)", "ms", timed(maps, repeats)),
        row(f"{query.name}: set-up (maps and the tree's memory)", "ms", timed(query.dirt, repeats)),
        row(f"{query.name}: start of a query (in its clock)", "ms", timed(start, 10 * repeats)),
    ]


def timed(function: Callable[[], object], repeats: int) -> list[float]:
    """Milliseconds of each call, after one that does not count."""
    function()
    milliseconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        milliseconds.append(1e3 * (time.perf_counter() - began))
    return milliseconds
