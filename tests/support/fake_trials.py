"""Trials that need no simulator, decided by scenario, method and seed alone, and how workers run them."""

from __future__ import annotations

import math
import os
import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from kraft.driving.messages import Cycle, PredictedMotion, Reference, ReferenceKind
from kraft.errors import InputError, MissingDependency
from kraft.evaluation import cluster, job, processes
from kraft.evaluation.job import Job, StopRequested, perform
from kraft.evaluation.journal import TrialRow
from kraft.text import MessageSink
from kraft.trial.measures import Step
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from support.passages import passage

LEFT = "KRAFT_TEST_FOLDER"
"""environment variable: folder in which trials leave what the next ones find"""

Trial: TypeAlias = Callable[[TrialSpec], TrialResult]


def use(patch: pytest.MonkeyPatch, trial: Trial, *, inline: bool = False) -> None:
    """Run `trial` instead of the simulator: in worker processes, on a Dask cluster, or all `inline` in this process."""
    from kraft.evaluation import evaluator  # which workers do not need

    patch.setattr(job, "simulated_trial", trial)
    patch.setattr(processes, "serve", partial(serve, trial))
    patch.setattr(cluster, "perform_checked", partial(perform_checked, trial))
    if inline:
        patch.setattr(evaluator, "Processes", Inline)


def serve(trial: Trial, pipe: Connection) -> None:
    """Entry of a worker process; what is patched in the process that starts it is not patched here."""
    job.simulated_trial = trial
    processes.serve(pipe)


def perform_checked(trial: Trial, task: Job, versions_there: Mapping[str, str]) -> TrialRow:
    """Run one trial on a Dask worker."""
    job.simulated_trial = trial
    return cluster.perform_checked(task, versions_there)


def quick(spec: TrialSpec) -> TrialResult:
    """A trial that takes no time."""
    chance = random.Random(f"{spec.scenario.name} {spec.method.name} {spec.seed}")
    outcome = chance.choice((Outcome.SUCCESS, Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT))
    count = chance.randint(1, 9)
    cycles = tuple(cycle(number, chance.choice(("plan", "plan", "contingency"))) for number in range(count))
    steps = tuple(
        Step(t / 30, (chance.random(), 0.0, 0.0), chance.random(), np.zeros(4), np.zeros(2), 0) for t in range(30)
    )
    end, clearance = chance.uniform(5, 60), chance.uniform(0, 0.3)
    obstacle = "first box" if outcome is Outcome.COLLISION else None
    return TrialResult(
        spec.scenario.name, spec.method.name, spec.seed, outcome, end, obstacle, clearance, cycles, steps
    )


def slow(spec: TrialSpec) -> TrialResult:
    """The same, in 0.2 s, leaving a file for each time it was begun."""
    leave(spec, "begun")
    time.sleep(0.2)
    return quick(spec)


def uneven(spec: TrialSpec) -> TrialResult:
    """The same; seed 0 ends after seed 2 has begun, which another worker begins after the result of seed 1 is received."""
    leave(spec, "begun")
    limit = time.monotonic() + 60
    while spec.seed == 0 and not list(Path(os.environ[LEFT]).glob("*-2-begun-*")):
        assert time.monotonic() < limit
        time.sleep(0.02)
    return quick(spec)


def dies_once(spec: TrialSpec) -> TrialResult:
    """Seed 1 kills its process, the first time."""
    if spec.seed == 1 and leave(spec, "died") == 1:
        os.kill(os.getpid(), 9)
    return quick(spec)


def dies(spec: TrialSpec) -> TrialResult:
    """Seed 1 ends its process, every time."""
    if spec.seed == 1:
        leave(spec, "died")
        os._exit(7)
    return quick(spec)


def raises(spec: TrialSpec) -> TrialResult:
    """Seed 1 has a defect."""
    if spec.seed == 1:
        raise ZeroDivisionError("no speed at all")
    return quick(spec)


def raises_once(spec: TrialSpec) -> TrialResult:
    """Every trial has a defect, the first time."""
    if leave(spec, "raised") == 1:
        raise ZeroDivisionError("no speed at all")
    return quick(spec)


def prints(spec: TrialSpec) -> TrialResult:
    """The same, with words on stdout."""
    print("a word from a library", flush=True)
    return quick(spec)


def threads(spec: TrialSpec) -> TrialResult:
    """Fails if numeric libraries were allowed more than one thread."""
    assert os.environ["OMP_NUM_THREADS"] == os.environ["NUMBA_NUM_THREADS"] == "1"
    return quick(spec)


def refuses(spec: TrialSpec) -> TrialResult:
    """Nothing can be driven."""
    raise InputError.of("the car", "does not fit", "expected another")


def missing(spec: TrialSpec) -> TrialResult:
    """Nothing to drive in."""
    raise MissingDependency("no simulator")


def endless(spec: TrialSpec) -> TrialResult:
    """Later seeds than 0 do not end."""
    time.sleep(60.0 * (spec.seed > 0))
    return quick(spec)


def cycle(number: int, kind: str) -> Cycle:
    """A cycle in which nothing moves."""
    reference = Reference(ReferenceKind(kind), np.array([0.0, 1.0]), np.zeros((2, 4)), np.zeros((1, 2)), np.zeros(2))
    fields = {
        "number": number, "time": float(number), "speed": 0.5, "reason": "because",
        "cost_to_goal": math.inf if kind == "contingency" else 9.0, "passage": passage(0.1), "iterations": 1000, "nodes": 50,
        "retained": 3, "planning_ms": 4.0 + number, "missed": number == 3, "reference": reference, "contingency": None,
        "predicted": PredictedMotion(np.array([0.0, 1.0]), np.zeros((2, 4)), 0.1),
    }  # fmt: skip
    return Cycle(**fields)


def leave(spec: TrialSpec, what: str) -> int:
    """Leave a file more and return how many there are now of this trial."""
    folder = Path(os.environ[LEFT])
    name = f"{spec.scenario.name}-{spec.method.name}-{spec.seed}-{what}"
    count = len(list(folder.glob(f"{name}-*"))) + 1
    (folder / f"{name}-{count}").touch()
    return count


class Inline:
    """An executor in this very process, in the order that `shuffle` makes of the jobs."""

    def __init__(self, count: int = 1, shuffle: Callable[[list[Job]], None] = lambda _: None) -> None:
        self._shuffle = shuffle

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: MessageSink) -> Iterator[TrialRow]:
        order = list(jobs)
        self._shuffle(order)
        for task in order:
            if stop_requested():
                return
            yield perform(task)
