"""Row of a trial: its data in a line of `trials.jsonl`."""

from __future__ import annotations

import hashlib
from typing import Literal, TypeAlias

import numpy as np

from kraft.text import finite
from kraft.trial.measures import Measures, Record
from kraft.trial.result import TrialResult

Key: TypeAlias = tuple[str, str, int]
"""Entry, method and seed; the entry of a plain scenario has the scenario's name."""


class Measured(Record):
    """Measured times, the only part of a row that differs between repetitions.

    `planning_ms` has one value per cycle, `missed` is the number of cycles that exceeded their planning time, `wall_s`
    is the duration of the whole trial.
    """

    planning_ms: tuple[float, ...] = ()
    missed: int = 0
    wall_s: float = 0.0


class TrialRow(Record):
    """Data of a trial that the tables need.

    Attributes:
        entry: name of the entry of the evaluation; empty in rows of older evaluations, where it is the scenario's.
        t_s: time of its end, s; None if it failed.
        obstacle: obstacle of the collision.
        min_clearance_m: smallest true distance to an obstacle; None without obstacles.
        iterations: planning iterations of all cycles.
        digest: hash over all ticks, equal for equal drives.
        error: why the trial failed, which means that it ended with a defect instead of an outcome.
    """

    entry: str = ""
    scenario: str
    method: str
    seed: int
    outcome: Literal["success", "collision", "timeout", "failed"]
    t_s: float | None = None
    obstacle: str | None = None
    min_clearance_m: float | None = None
    cycles: int = 0
    contingencies: int = 0
    iterations: int = 0
    digest: str | None = None
    error: str | None = None
    measures: Measures = Measures()
    measured: Measured = Measured()

    @property
    def key(self) -> Key:
        """Entry, method and seed."""
        return self.entry or self.scenario, self.method, self.seed


def trial_row(key: Key, result: TrialResult, wall: float) -> TrialRow:
    """Row of a trial; `wall` is the duration of its computation (s)."""
    entry, method, seed = key
    planning = tuple(round(cycle.planning_ms, 3) for cycle in result.cycles)
    return TrialRow(
        entry=entry,
        scenario=result.scenario,
        method=method,
        seed=seed,
        outcome=result.outcome.value,
        t_s=float(result.time),
        obstacle=result.obstacle,
        min_clearance_m=finite(result.min_clearance),
        cycles=len(result.cycles),
        contingencies=result.contingencies,
        iterations=sum(cycle.iterations for cycle in result.cycles),
        digest=digest(result),
        measures=result.measures,
        measured=Measured(planning_ms=planning, missed=result.missed, wall_s=round(wall, 3)),
    )


def digest(result: TrialResult) -> str:
    """Hash over true state, estimated state and command at every tick."""
    found = hashlib.sha256()
    for step in result.steps:
        numbers = [step.time, *step.pose, step.speed, *step.estimate, *step.command, step.cycle]
        found.update(np.asarray(numbers, dtype=float).tobytes())
    return found.hexdigest()[:16]
