"""What the rows of the peers cost: processor time of a trial and time of a command."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from benchmarks import peers_table
from benchmarks.effort import Effort
from benchmarks.report import Report, Target, number, row
from benchmarks.tuning import changed
from kraft.driving.method import Method, load_method
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

ROWS: Final = (*peers_table.METHODS, "kraft", "filtered-kraft")
ENTRIES: Final = ("turns", "boxes", "bump-1.3", "boxes-5-poses", "turns-friction-0.12", "slope-across-9")
"""Entries of the suites `paper` and `hard` in which the rows are driven."""
SEED: Final = 1000
SEEDS: Final = 3
"""First seed, and the largest number of seeds."""
TRIALS: Final = 6 * 30 + 30 * 10
"""Trials of a row: 30 in each of the six scenes, 10 in each of the 30 hard entries."""
LIMIT: Final = 2 * 1800.0 / (len(ROWS) * TRIALS)
"""Processor time of a trial with which all rows take 30 minutes on two cores, s."""
COMMAND: Final = Target(12.0)
"""Limit of MPPI's command, ms."""


def run(effort: Effort) -> Report:
    """Drive every row in the entries, one trial after the other in one process."""
    peers_table.compile_all()
    found = {name: trials(load_method(name), ENTRIES, effort.peer_trials) for name in ROWS}
    _, by_ipopt = trials(changed(load_method("nmpc"), {"controller": {"solver": "ipopt"}}), ENTRIES[:2], 1)
    means = [float(np.mean(seconds)) for seconds, _ in found.values()]
    rows = [row("processor time of a trial, mean of all rows", "s", [float(np.mean(means))], Target(LIMIT))]
    rows += [row(f"{name}: processor time of a trial", "s", seconds) for name, (seconds, _) in found.items()]
    rows += [
        row(f"{name}: one command", "ms", commands, COMMAND if name in ("mppi", "kraft-mppi") else None)
        for name, (_, commands) in found.items()
    ]
    rows.append(row("nmpc with solver ipopt: one command", "ms", by_ipopt))
    hours = sum(means) * TRIALS / 3600.0
    notes = [
        f"In {', '.join(ENTRIES)}, seeds from {SEED}; times of commands by the wall clock.",
        f"{TRIALS} trials of each of the {len(ROWS)} rows: {number(60.0 * hours / 2)} min on two cores.",
    ]
    return Report("commands", rows, {}, notes)


def trials(method: Method, entries: Sequence[str], seeds: int) -> tuple[Sequence[float], Sequence[float]]:
    """Processor times of the trials of a row (s), and times of its commands (ms)."""
    drive(method, entries[0], SEED - 1)  # loads the kernels
    seconds, commands = list[float](), list[float]()
    for entry in entries:
        for seed in range(SEED, SEED + min(seeds, SEEDS)):
            began = time.process_time()
            result = drive(method, entry, seed)
            seconds.append(time.process_time() - began)
            commands.extend(result.command_ms)
    return seconds, commands


def drive(method: Method, name: str, seed: int) -> TrialResult:
    """One trial of a row in an entry."""
    entry = next(entry for entry in peers_table.entries() if entry.name == name)
    vehicle = load_vehicle(method.planner.vehicle or entry.scenario.vehicle)
    return run_trial(TrialSpec(entry.scenario, method, vehicle, seed))
