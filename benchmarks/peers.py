"""DIRT beside OMPL's RRT, EST and KPIECE1 from the same wheel: the same query, the same run, turn by turn."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ompl import util as ou

from benchmarks.effort import Effort
from benchmarks.ompl_log import write_log
from benchmarks.planner import cost_after, first_solution
from benchmarks.report import Report, Row, number, row
from benchmarks.scenes import RK4_STEPS, SCENES, Scene, scene
from ompl_ext.peers import PEERS
from ompl_ext.solver import DirtSolver

LOOKS = (0.1, 1.0)  # planning times at which costs are compared (s)
PATIENCE = 30.0  # for a peer's first solution (s)


@dataclass(frozen=True)
class PeerRun:
    """A peer's run to its first solution: time, duration of the plan (s, infinite without one), propagation steps."""

    seconds: float
    cost: float
    steps: int


@dataclass(frozen=True)
class Trial:
    """One planner's planning from nothing: until, cost of, and propagation steps of its first solution, then on."""

    first_seconds: float
    first_cost: float
    first_steps: int
    steps_per_second: float
    cost_at: dict[float, float]


def run(effort: Effort, out: Path) -> Report:
    """Compare on all scenes, and write OMPL's benchmark log and the database for Planner Arena."""
    rows: list[Row] = []
    looks = [look for look in LOOKS if look <= effort.seconds] or [effort.seconds]
    costs = [f"cost after {number(1e3 * look)} ms" for look in looks]
    table = [["scene", "DIRT against", "first solution", "steps to it", "steps/s", "first cost", *costs]]
    for name in SCENES:
        trials = compare(scene(name), looks, effort.repeats)
        rows += [each for planner, of_planner in trials.items() for each in summary(name, planner, of_planner)]
        table += [[name, peer, *ratios(trials["dirt"], trials[peer])] for peer in PEERS]
    log = write_log(effort, out)
    notes = [
        "OMPL's planners run compiled over Python callbacks (RK4 and FCL's verdict, both compiled); DIRT all compiled.",
        "Steps are RK4 steps: of 0.05 s for the peers, a tenth of an edge for DIRT.",
        "The peers stop at their first solution; for costs later on they are restarted and the best one counts.",
        *log,
    ]
    title = "How many times better DIRT is, median of the rounds (cost: theirs over DIRT's)"
    return Report("peers", rows, {title: table}, notes)


def compare(query: Scene, looks: list[float], repeats: int) -> dict[str, list[Trial]]:
    """Trials of each planner; round k runs all of them one after the other."""
    dirt = query.dirt()
    dirt.start(query.start)
    dirt.grow(iterations=100)
    trials: dict[str, list[Trial]] = {name: [] for name in ("dirt", *PEERS)}
    for seed in range(repeats):
        trials["dirt"].append(dirt_trial(query, dirt, seed, looks))
        for name in PEERS:
            trials[name].append(peer_trial(query, name, seed, looks))
    return trials


def dirt_trial(query: Scene, dirt: DirtSolver, seed: int, looks: list[float]) -> Trial:
    """DIRT's anytime search."""
    seconds, cost = first_solution(query, dirt, seed)
    steps = dirt.progress.edges * RK4_STEPS
    dirt.start(query.start, seed)
    progress = dirt.grow(seconds=max(looks))
    rate = progress.edges * RK4_STEPS / progress.seconds
    return Trial(seconds, cost, steps, rate, {look: cost_after(progress, look) for look in looks})


def peer_trial(query: Scene, name: str, seed: int, looks: list[float]) -> Trial:
    """A peer, restarted after each solution until the last look."""
    runs: list[PeerRun] = []
    while not runs or sum(each.seconds for each in runs) < max(looks):
        runs.append(peer(query, name, 1000 * seed + len(runs)))
    first, ends = runs[0], np.cumsum([each.seconds for each in runs]).tolist()
    best = {
        look: min((each.cost for each, end in zip(runs, ends, strict=True) if end <= look), default=math.inf)
        for look in looks
    }
    until = first.seconds if math.isfinite(first.cost) else math.inf
    return Trial(until, first.cost, first.steps, sum(each.steps for each in runs) / ends[-1], best)


def peer(query: Scene, name: str, seed: int) -> PeerRun:
    """A peer until its first solution; making its problem and maps does not count."""
    ou.setLogLevel(ou.LOG_NONE)  # OMPL reports an error when it is seeded again, and yet obeys
    ou.RNG.setSeed(seed + 1)  # 0 would be a seed from the clock
    setup = query.setup()
    setup.setPlanner(PEERS[name](setup.getSpaceInformation()))
    setup.setup()
    began = time.perf_counter()
    setup.solve(PATIENCE)
    took = time.perf_counter() - began
    ou.setLogLevel(ou.LOG_WARN)
    solved = setup.haveExactSolutionPath()
    return PeerRun(took, setup.getSolutionPath().length() if solved else math.inf, setup.steps)


def summary(scene_name: str, planner: str, trials: list[Trial]) -> list[Row]:
    """Rows of one planner."""
    name = f"{scene_name}, {planner}: "
    return [
        row(name + "first solution", "ms", (1e3 * trial.first_seconds for trial in trials)),
        row(name + "cost of it", "s", (trial.first_cost for trial in trials)),
        row(name + "propagation", "steps/s", (trial.steps_per_second for trial in trials), more=True),
        *(
            row(name + f"cost after {number(1e3 * look)} ms", "s", (trial.cost_at[look] for trial in trials))
            for look in trials[0].cost_at
        ),
    ]


def ratios(dirt: list[Trial], peer: list[Trial]) -> list[str]:
    """Median over the rounds of how many times better DIRT is."""

    def median(values: Callable[[Trial], float], more: bool = False) -> str:
        pairs = [(values(ours), values(theirs)) for ours, theirs in zip(dirt, peer, strict=True)]
        return number(float(np.median([ours / theirs if more else theirs / ours for ours, theirs in pairs])))

    return [
        median(lambda trial: trial.first_seconds),
        median(lambda trial: trial.first_steps),
        median(lambda trial: trial.steps_per_second, more=True),
        median(lambda trial: trial.first_cost),
        *(median(lambda trial, at=look: trial.cost_at[at]) for look in dirt[0].cost_at),  # type: ignore[misc]
    ]
