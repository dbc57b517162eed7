"""The same algorithm twice: compiled, and over OMPL's callbacks, there beside OMPL's planners on the same callbacks."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from ompl import base as ob
from ompl import util as ou

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.scenes import SCENES, Scene, endless, scene
from benchmarks.search import has_solution
from ompl_ext.peers import PEERS
from ompl_ext.planner import DIRT

LIMIT = 30.0  # for a first solution (s)


@dataclass(frozen=True)
class Rates:
    """What one planner did in a given time: edges (DIRT only) and propagation steps per second."""

    edges: float
    steps: float


@dataclass(frozen=True)
class First:
    """A first solution over callbacks: time and cost (s), infinite without one, and propagation steps."""

    seconds: float
    cost: float
    steps: int


def run(effort: Effort) -> Report:
    """Measure on all scenes."""
    rows: list[Row] = []
    for name in SCENES:
        rows += speed(name, endless(scene(name)), effort) + solutions(name, scene(name), effort.repeats)
    notes = [
        "Speeds: a goal that nothing meets, so that all planners run for the same time; ratios within a round.",
        "A step is one call of the propagator and one of the validity checker; an edge has 10 to 20 of them.",
        "DIRT takes a blossom of 32 compiled and of 4 over callbacks, its defaults.",
    ]
    return Report("callbacks", rows, notes=notes)


def speed(name: str, query: Scene, effort: Effort) -> list[Row]:
    """Edges and steps per second, every planner once a round."""
    rounds = [one_round(query, effort.seconds, seed) for seed in range(effort.repeats)]

    def steps(planner: str) -> list[float]:
        return [of_round[planner].steps for of_round in rounds]

    ratios = [of["compiled"].edges / of["callbacks"].edges for of in rounds]
    rows = [
        row(f"{name}: compiled edges", "1/s", [of["compiled"].edges for of in rounds], more=True),
        row(f"{name}: callback edges", "1/s", [of["callbacks"].edges for of in rounds], more=True),
        row(f"{name}: compiled edges over callback edges", "times", ratios, Target(50, most=False)),
        row(f"{name}: DIRT over callbacks", "steps/s", steps("callbacks"), more=True),
    ]
    for peer in PEERS:
        against = [ours / theirs for ours, theirs in zip(steps("callbacks"), steps(peer), strict=True)]
        rows.append(row(f"{name}: {peer}", "steps/s", steps(peer), more=True))
        rows.append(row(f"{name}: DIRT's steps/s over {peer}'s", "times", against, Target(1.0, most=False)))
    return rows


def one_round(query: Scene, seconds: float, seed: int) -> dict[str, Rates]:
    """Every planner for the same time on the same callbacks."""
    setup = query.setup()
    si = setup.getSpaceInformation()
    planners: dict[str, ob.Planner] = {
        "compiled": DIRT(si, seed=seed + 1),
        "callbacks": DIRT(si, seed=seed + 1, use_callbacks=True),
    }
    reseed(seed)
    planners |= {name: make(si) for name, make in PEERS.items()}
    rates = {}
    for name, planner in planners.items():
        setup.setPlanner(planner)
        setup.clear()
        setup.setup()
        before, began = setup.steps, time.perf_counter()
        setup.solve(seconds)
        took = time.perf_counter() - began
        edges = planner.edges if isinstance(planner, DIRT) else 0
        rates[name] = Rates(edges / took, (setup.steps - before) / took)
    return rates


def solutions(name: str, query: Scene, repeats: int) -> list[Row]:
    """First solutions over callbacks, of every planner once a round."""
    found: dict[str, list[First]] = {planner: [] for planner in ("dirt", *PEERS)}
    for seed in range(repeats):
        for planner, of_planner in found.items():
            of_planner.append(first(query, planner, seed))
    rows = []
    for planner, of_planner in found.items():
        what = f"{name}, {planner} over callbacks: "
        rows.append(row(what + "first solution", "ms", [1e3 * each.seconds for each in of_planner]))
        rows.append(row(what + "steps to it", "steps", [each.steps for each in of_planner]))
        rows.append(row(what + "cost of it", "s", [each.cost for each in of_planner]))
    for peer in PEERS:
        ratios = [ours.seconds / theirs.seconds for ours, theirs in zip(found["dirt"], found[peer], strict=True)]
        rows.append(row(f"{name}: DIRT's time to a first solution over {peer}'s", "times", ratios))
    return rows


def first(query: Scene, name: str, seed: int) -> First:
    """A planner's first solution over callbacks; setting up does not count."""
    setup = query.setup()
    si = setup.getSpaceInformation()
    reseed(seed)
    planner = DIRT(si, seed=seed + 1, use_callbacks=True) if name == "dirt" else PEERS[name](si)
    setup.setPlanner(planner)
    setup.setup()
    began = time.perf_counter()

    def enough() -> bool:  # the others stop by themselves, DIRT would go on to better solutions
        late = time.perf_counter() - began > LIMIT
        return late or (isinstance(planner, DIRT) and has_solution(planner))

    setup.solve(ob.PlannerTerminationCondition(enough))
    took = time.perf_counter() - began
    if not setup.haveExactSolutionPath():
        return First(math.inf, math.inf, setup.steps)
    return First(took, setup.getSolutionPath().length(), setup.steps)


def reseed(seed: int) -> None:
    """Seed what OMPL's planners draw from, for those made from now on."""
    ou.setLogLevel(ou.LOG_NONE)  # OMPL reports an error when it is seeded again, and yet obeys
    ou.RNG.setSeed(seed + 1)  # 0 would be a seed from the clock
    ou.setLogLevel(ou.LOG_ERROR)
