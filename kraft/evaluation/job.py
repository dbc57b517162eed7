"""One trial as work for another process: everything it needs, small enough to send."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Protocol, TypeAlias

from kraft.driving.method import Method
from kraft.errors import InputError, MissingDependency, MissingError
from kraft.evaluation.row import Key, TrialRow, trial_row
from kraft.scenario import Scenario
from kraft.trial.result import TrialResult, TrialSpec
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class Job:
    """A trial to run.

    `vehicle` is a resolved reference: its functions are compiled where they run.
    """

    scenario: Scenario
    method: Method
    vehicle: str
    seed: int
    realtime: bool = False

    @property
    def key(self) -> Key:
        """Which trial it is."""
        return self.scenario.name, self.method.name, self.seed


def perform(job: Job) -> TrialRow:
    """Run a trial and keep what the tables need; whatever goes wrong inside it is recorded as its failure.

    Raises:
        InputError: if what was given cannot be driven; then neither can the other trials.
        MissingError: if something this installation should have is not there.
    """
    began = time.perf_counter()
    try:
        result = run_trial(TrialSpec(job.scenario, job.method, _vehicle(job.vehicle), job.seed, job.realtime))
        return trial_row(job.key, result, time.perf_counter() - began)
    except (InputError, MissingError):
        raise
    except Exception as error:  # a defect: said, recorded, and the others go on
        place = traceback.extract_tb(error.__traceback__)[-1]
        return failed_row(job, f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})")


def failed_row(job: Job, error: str) -> TrialRow:
    """The row of a trial that did not come to an end."""
    return TrialRow(scenario=job.scenario.name, method=job.method.name, seed=job.seed, outcome="failed", error=error)


def run_trial(spec: TrialSpec) -> TrialResult:
    """Run `kraft.trial.run_trial`, imported with the first trial because it loads the simulator.

    Raises:
        MissingDependency: if the simulator does not load.
    """
    try:
        from kraft.trial.trial import run_trial
    except (ImportError, OSError) as error:  # OSError: a shared library does not load
        raise MissingDependency("the simulator (kraft.trial.trial) does not load") from error
    return run_trial(spec)


@cache
def _vehicle(reference: str) -> Vehicle:
    return load_vehicle(reference)


StopRequested: TypeAlias = Callable[[], bool]
Log: TypeAlias = Callable[[str], None]

DEATHS: Final = 2
"""A trial whose worker died this often has failed."""


class Executor(Protocol):
    """Runs trials."""

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """Yield the row of every job once, in whatever order they end.

        As soon as `stop_requested()` is true no further trial is begun, and those that run are waited for.  Closing the
        iterator drops them.  A trial whose worker dies is begun again on another one, until it has died
        too often; then its row says so.

        Raises:
            InputError, MissingError: from a trial, see `kraft.evaluation.job.perform`, or if there is nowhere to run.
        """
        ...
