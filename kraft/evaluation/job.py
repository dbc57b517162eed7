"""Trials as jobs, and the interface of what executes them."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Protocol, TypeAlias

from kraft.config.user_code import failure_in_code
from kraft.driving.method import Method
from kraft.errors import Code, InputError, MissingDependency, MissingError, UserCodeError
from kraft.evaluation.journal import Key, TrialRow, trial_row
from kraft.evaluation.replay import replay_of
from kraft.scenario import Scenario
from kraft.text import MessageSink
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.robot_content import vehicle_hash
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class Job:
    """Trial to run in the entry of that name.

    `vehicle` is a resolved reference, because a vehicle is compiled in the process that uses it; `vehicle_hash` is that
    of the vehicle where the evaluation began.
    """

    entry: str
    scenario: Scenario
    method: Method
    vehicle: str
    vehicle_hash: str
    seed: int
    realtime: bool = False

    @property
    def key(self) -> Key:
        """Entry, method and seed."""
        return self.entry, self.method.name, self.seed


def perform(job: Job) -> TrialRow:
    """Run a trial and reduce it to its row; any other exception than those below is recorded as a failed trial.

    So is an error of a user's own controller or vehicle.

    Raises:
        InputError: if the scenario, method or vehicle is refused, which concerns the other trials too, or if the
            vehicle is another one in this process.
        MissingError: if a part of the installation is missing.
    """
    began = time.perf_counter()
    try:
        spec = TrialSpec(job.scenario, job.method, _vehicle(job.vehicle, job.vehicle_hash), job.seed, job.realtime)
        result = simulated_trial(spec)
        wall = time.perf_counter() - began
        return trial_row(job.key, result, wall, replay_of(spec, result))
    except UserCodeError as error:
        return failed_row(job, str(error), own_code=True)
    except (InputError, MissingError):
        raise
    except Exception as error:  # of the user's vehicle, or a defect: recorded, and the other trials go on
        if (failure := failure_in_code(error)) is not None:
            return failed_row(job, str(failure), own_code=True)
        place = traceback.extract_tb(error.__traceback__)[-1]
        return failed_row(job, f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})")


def failed_row(job: Job, error: str, *, own_code: bool = False) -> TrialRow:
    """Row of a failed trial; `own_code` is whether the user's own code failed.

    What UTF-8 cannot write of the text of the error, a surrogate in the name of a file, is escaped.
    """
    entry, method, seed = job.key
    text = error.encode(errors="backslashreplace").decode()
    return TrialRow(
        entry=entry, scenario=job.scenario.name, method=method, seed=seed, outcome="failed", error=text,
        own_code=own_code,
    )  # fmt: skip


def simulated_trial(spec: TrialSpec) -> TrialResult:
    """Run `kraft.trial.run_trial`, imported with the first trial because it loads the simulator; trees are kept.

    Raises:
        MissingDependency: if the simulator does not load.
    """
    try:
        from kraft.trial.trial import run_trial
    except (ImportError, OSError) as error:  # OSError: a shared library does not load
        raise MissingDependency("the simulator (kraft.trial.trial) does not load") from error
    return run_trial(spec, keep_trees=True)


@cache
def _vehicle(reference: str, expected_hash: str) -> Vehicle:
    """Vehicle of a reference; a file is read again for another hash, as a worker of a cluster outlives evaluations.

    Raises:
        InputError: if it has another hash here.
    """
    vehicle = load_vehicle(reference)
    if vehicle_hash(vehicle) != expected_hash:
        problem = "is another vehicle in a worker process than where the evaluation began"
        expected = (
            "expected the same files on every machine and no change while trials run; a worker of a cluster that has "
            "imported code before it was changed has to be started again"
        )
        raise InputError.of(reference, problem, expected, Code.MISMATCH)
    return vehicle


StopRequested: TypeAlias = Callable[[], bool]
POLL: Final = 0.1
"""Longest time until a request to stop takes effect, s."""


class Executor(Protocol):
    """Runs jobs in other processes."""

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: MessageSink) -> Iterator[TrialRow]:
        """Yield the row of every job once, in the order in which trials end.

        As soon as `stop_requested()` is true no further trial starts and the running ones are finished; closing the
        iterator aborts them.  A trial whose worker dies is repeated on another worker, and fails if workers die
        in it too often.

        Raises:
            InputError, MissingError: from a trial, see `perform`, or if no worker can be used.
        """
        ...
