"""What is kept of a trial in an evaluation: one line of `trials.jsonl`."""

from __future__ import annotations

import hashlib
from typing import Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict

from kraft.text import finite
from kraft.trial.result import TrialResult

Key: TypeAlias = tuple[str, str, int]
"""scenario, method, seed"""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Measured(_Record):
    """What the clock said; nothing in here repeats, and everything else does.

    `planning_ms` has one value per cycle, `missed` counts cycles that took longer than there was time, `wall_s` is
    what the whole trial took.
    """

    planning_ms: tuple[float, ...] = ()
    missed: int = 0
    wall_s: float = 0.0


class TrialRow(_Record):
    """A trial, reduced.

    Attributes:
        t_s: when it ended, s; None if it failed.
        obstacle: what was hit.
        min_clearance_m: smallest true distance to an obstacle; None if there is no obstacle.
        iterations: planning iterations of all cycles.
        digest: hash over every tick: equal for equal drives.
        error: why it failed.  A failed trial is one that kraft did not bring to an end; that is a defect.
    """

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
    measured: Measured = Measured()

    @property
    def key(self) -> Key:
        """Which trial it is."""
        return self.scenario, self.method, self.seed


def trial_row(key: Key, result: TrialResult, wall: float) -> TrialRow:
    """Keep of a trial what the tables need; `wall` is how long it took (s)."""
    scenario, method, seed = key
    planning = tuple(round(cycle.planning_ms, 3) for cycle in result.cycles)
    return TrialRow(
        scenario=scenario,
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
        measured=Measured(planning_ms=planning, missed=result.missed, wall_s=round(wall, 3)),
    )


def digest(result: TrialResult) -> str:
    """Hash over truth, belief and command at every tick."""
    found = hashlib.sha256()
    for step in result.steps:
        numbers = [step.time, *step.pose, step.speed, *step.estimate, *step.command, step.cycle]
        found.update(np.asarray(numbers, dtype=float).tobytes())
    return found.hexdigest()[:16]
