"""Tuning of the peers: the same number of settings and of trials for each row, on seeds that the tables do not have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Final

import numpy as np

from benchmarks import peers_table
from benchmarks.effort import Effort
from benchmarks.parallel import each
from benchmarks.report import Report, number, row
from kraft.driving.method import Method, load_method
from kraft.evaluation.suite import Entry
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

ENTRIES: Final = ("turns", "boxes", "boxes-weak-car-delays", "turns-noise-2.5")
"""Entries of the suites `paper` and `hard` in which each setting is driven."""
FIRST_SEED: Final = 1000
Changes = Mapping[str, Mapping[str, Any]]
"""Settings that differ from the bundled method, by section."""
POSES: Final[Changes] = {"planner": {"cost_to_go": "pose"}}


def controller(**values: Any) -> Changes:
    """Changes of the controller."""
    return {"controller": values}


def planner(**values: Any) -> Changes:
    """Changes of the planner."""
    return {"planner": values}


BUNDLED: Final[Changes] = {}
TRACKING: Final = (
    BUNDLED, controller(k_along=1.0), controller(k_along=5.0), controller(k_path=3.0), controller(k_path=8.0),
    planner(margin=0.01), planner(margin=0.05), planner(max_iterations=4000),
)  # fmt: skip
CANDIDATES: Final[Mapping[str, tuple[Changes, ...]]] = {
    "adaptive-kraft": TRACKING,
    "sst": TRACKING,
    "mppi": (
        BUNDLED, controller(hold=1, near=50.0), controller(hold=14), controller(goal=5.0), controller(margin=0.05),
        controller(temperature=0.1), controller(spread=0.4), POSES,
    ),
    "dwa": (
        BUNDLED, controller(horizon=2.0), controller(horizon=3.0), controller(goal=10.0), controller(margin=0.05),
        controller(near=10.0), controller(samples=21), POSES,
    ),
    "nmpc": (
        BUNDLED, controller(steps=30), controller(cruise=1.0), controller(cruise=0.8), controller(position=0.2),
        controller(margin=0.03), controller(change=0.5), POSES,
    ),
    "kraft-mppi": (
        BUNDLED, controller(hold=1), controller(hold=4), controller(spread=0.1), controller(spread=0.4),
        controller(temperature=0.1), controller(position=0.05), controller(position=0.2),
    ),
    "kraft-nmpc": (
        BUNDLED, controller(steps=10), controller(position=0.05), controller(position=0.2),
        controller(heading_deg=15.0), controller(speed=0.6), controller(change=0.5), controller(change=2.0),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Driven:
    """How a trial of a setting ended."""

    method: str
    candidate: int
    outcome: str
    time: float


def run(effort: Effort) -> Report:
    """Drive every setting of every row in the entries, `peer_tuning` seeds each."""
    peers_table.compile_all()
    total = sum(map(len, CANDIDATES.values())) * len(ENTRIES) * effort.peer_tuning
    driven = each(partial(drive, seeds=effort.peer_tuning), range(total), effort.jobs)
    ranked = {name: ranking(name, driven) for name in CANDIDATES}
    rows = [row(f"{name}: place of the bundled setting of {len(order)}", "", [1.0 + order.index(0)])
            for name, order in ranked.items()]  # fmt: skip
    notes = [
        f"{len(TRACKING)} settings a row, seeds from {FIRST_SEED}, {len(TRACKING) * len(ENTRIES) * effort.peer_tuning} "
        f"trials a row, in {', '.join(ENTRIES)}.",
        "Ranked by successes, then fewer collisions, then the mean time of the successes.",
    ]
    return Report("tuning", rows, {"settings, the best one first": table(ranked, driven)}, notes)


@cache
def entries() -> tuple[Entry, ...]:
    """The entries in which settings are driven."""
    found = {entry.name: entry for entry in peers_table.entries()}
    return tuple(found[name] for name in ENTRIES)


def drive(k: int, seeds: int) -> Driven:
    """Drive number `k`: seed after seed, then entry after entry, then setting after setting, then row after row."""
    pairs = [(name, candidate) for name, found in CANDIDATES.items() for candidate in range(len(found))]
    name, candidate = pairs[k // seeds // len(ENTRIES)]
    entry, method = entries()[k // seeds % len(ENTRIES)], changed(load_method(name), CANDIDATES[name][candidate])
    vehicle = load_vehicle(method.planner.vehicle or entry.scenario.vehicle)
    found = run_trial(TrialSpec(entry.scenario, method, vehicle, FIRST_SEED + k % seeds))
    return Driven(name, candidate, str(found.outcome), found.time)


def changed(method: Method, changes: Changes) -> Method:
    """A method with other settings."""
    content = method.model_dump()
    for section, values in changes.items():
        content[section] |= values
    return Method.model_validate(content)


def ranking(name: str, driven: Sequence[Driven]) -> list[int]:
    """Settings of a row, the best one first."""
    return sorted(range(len(CANDIDATES[name])), key=lambda candidate: _merit(name, candidate, driven))


def _merit(name: str, candidate: int, driven: Sequence[Driven]) -> tuple[float, ...]:
    mine = _trials(name, candidate, driven)
    return -_count(mine, Outcome.SUCCESS), _count(mine, Outcome.COLLISION), _mean_time(mine)


def _trials(name: str, candidate: int, driven: Sequence[Driven]) -> list[Driven]:
    return [each for each in driven if (each.method, each.candidate) == (name, candidate)]


def _count(driven: Sequence[Driven], outcome: Outcome) -> int:
    return sum(each.outcome == outcome for each in driven)


def _mean_time(driven: Sequence[Driven]) -> float:
    """Mean time of the successes, s; infinite without any."""
    times = [each.time for each in driven if each.outcome == Outcome.SUCCESS]
    return float(np.mean(times)) if times else np.inf


def table(ranked: Mapping[str, Sequence[int]], driven: Sequence[Driven]) -> list[list[str]]:
    """Every setting with its trials."""
    found = [["row", "setting", "success", "collision", "timeout", "mean time, s"]]
    for name, order in ranked.items():
        for candidate in order:
            mine = _trials(name, candidate, driven)
            counts = [_count(mine, outcome) for outcome in (Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT)]
            time = _mean_time(mine)
            shown = number(time) if np.isfinite(time) else "-"
            found.append([name, described(CANDIDATES[name][candidate]), *map(str, counts), shown])
    return found


def described(changes: Changes) -> str:
    """What a setting changes, in words."""
    named = [f"{name} {value}" for values in changes.values() for name, value in values.items()]
    return ", ".join(named) or "as bundled"
