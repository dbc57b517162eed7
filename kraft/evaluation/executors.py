"""Trials as jobs, and their executors: worker processes of this machine, and workers of a Dask cluster.

The ProcessPool of pebble 5.2 is not used: an idle worker that dies breaks it, and busy workers take 3 s each to stop.
"""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from kraft.driving.method import Method
from kraft.errors import Code, Defect, InputError, KraftError, MissingDependency, MissingError
from kraft.evaluation.journal import Key, TrialRow, trial_row
from kraft.evaluation.replay import replay_of
from kraft.provenance import SIMULATION, versions
from kraft.scenario import Scenario
from kraft.trial.result import TrialResult, TrialSpec
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from distributed import Client, Future


@dataclass(frozen=True)
class Job:
    """Trial to run in the entry of that name.

    `vehicle` is a resolved reference, because a vehicle is compiled in the process that uses it.
    """

    entry: str
    scenario: Scenario
    method: Method
    vehicle: str
    seed: int
    realtime: bool = False

    @property
    def key(self) -> Key:
        """Entry, method and seed."""
        return self.entry, self.method.name, self.seed


def perform(job: Job) -> TrialRow:
    """Run a trial and reduce it to its row; any other exception than those below is recorded as a failed trial.

    Raises:
        InputError: if the scenario, method or vehicle is refused, which concerns the other trials too.
        MissingError: if a part of the installation is missing.
    """
    began = time.perf_counter()
    try:
        spec = TrialSpec(job.scenario, job.method, _vehicle(job.vehicle), job.seed, job.realtime)
        result = run_trial(spec)
        wall = time.perf_counter() - began
        return trial_row(job.key, result, wall, replay_of(spec, result))
    except (InputError, MissingError):
        raise
    except Exception as error:  # a defect: recorded, and the other trials go on
        place = traceback.extract_tb(error.__traceback__)[-1]
        return failed_row(job, f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})")


def failed_row(job: Job, error: str) -> TrialRow:
    """Row of a failed trial."""
    entry, method, seed = job.key
    return TrialRow(entry=entry, scenario=job.scenario.name, method=method, seed=seed, outcome="failed", error=error)


def run_trial(spec: TrialSpec) -> TrialResult:
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
def _vehicle(reference: str) -> Vehicle:
    return load_vehicle(reference)


StopRequested: TypeAlias = Callable[[], bool]
Log: TypeAlias = Callable[[str], None]

POLL: Final = 0.1
"""Longest time until a request to stop takes effect, s."""


class Executor(Protocol):
    """Runs jobs in other processes."""

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """Yield the row of every job once, in the order in which trials end.

        As soon as `stop_requested()` is true no further trial starts and the running ones are finished; closing the
        iterator aborts them.  A trial whose worker dies is repeated on another worker, and fails if workers die
        in it too often.

        Raises:
            InputError, MissingError: from a trial, see `perform`, or if no worker can be used.
        """
        ...


DEATHS: Final = 2  # workers that die in a trial, after which it has failed
FAILED_STARTS: Final = 3  # workers in a row that die before they are ready


@dataclass(eq=False)
class _Worker:
    """Worker process, its pipe, and its current job; `ready` after its first message."""

    process: SpawnProcess
    pipe: Connection
    job: Job | None = None
    ready: bool = False

    @property
    def exit_text(self) -> str:
        """How the process ended, for a message."""
        self.process.join(5.0)
        code = self.process.exitcode
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exit code {code}"

    def close(self) -> None:
        """Kill the process."""
        self.pipe.close()
        self.process.kill()
        self.process.join()
        self.process.close()


@dataclass
class _State:
    """Remaining jobs and workers of a run."""

    todo: deque[Job]
    workers: list[_Worker] = field(default_factory=list)
    deaths: Counter[Key] = field(default_factory=Counter)
    failed_starts: int = 0


class Processes:
    """Runs jobs in `count` processes, one job at a time in each."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """See `Executor`.

        Raises:
            Defect: if workers do not start.
        """
        state = _State(deque(jobs))
        try:
            while True:
                if stop_requested():
                    state.todo.clear()
                busy = sum(worker.job is not None for worker in state.workers)
                if not state.todo and not busy:
                    return
                self._assign(state, busy)
                for worker in _readable(state.workers):
                    try:
                        row = _receive(state, worker, worker.pipe.recv())
                    except (EOFError, OSError):  # it died: no other process has the other end
                        row = _handle_death(state, worker, log)
                    if row is not None:
                        yield row
        finally:
            for worker in state.workers:
                worker.close()

    def _assign(self, state: _State, busy: int) -> None:
        """Give idle workers a job and start workers while there are fewer than jobs."""
        for worker in state.workers:
            if worker.ready and worker.job is None and state.todo:
                worker.job = state.todo.popleft()
                with suppress(OSError):  # if it died meanwhile, `_readable` returns it
                    worker.pipe.send(worker.job)
                busy += 1
        while len(state.workers) < min(self.count, busy + len(state.todo)):
            state.workers.append(_start_worker())


def _readable(workers: Sequence[_Worker]) -> list[_Worker]:
    """Workers with a message to read; a closed pipe, after a death, is one too."""
    found = connection.wait([worker.pipe for worker in workers], POLL)
    return [worker for worker in workers if worker.pipe in found]


def _receive(state: _State, worker: _Worker, answer: Answer) -> TrialRow | None:
    """Handle the message of a worker; its row, if it is one."""
    if isinstance(answer, KraftError):
        raise answer
    if answer is None:
        worker.ready, state.failed_starts = True, 0
    else:
        worker.job = None
    return answer


def _handle_death(state: _State, worker: _Worker, log: Log) -> TrialRow | None:
    """Remove a dead worker and repeat its job; the row of the job if it fails instead.

    Raises:
        Defect: if several workers in a row die before they are ready.
    """
    how, job = worker.exit_text, worker.job
    state.workers.remove(worker)
    worker.close()
    if job is None:
        state.failed_starts += not worker.ready
        if state.failed_starts >= FAILED_STARTS:
            raise Defect(f"worker processes do not start ({how})")
        return None
    state.deaths[job.key] += 1
    if state.deaths[job.key] >= DEATHS:
        return failed_row(job, f"its worker process died {state.deaths[job.key]} times ({how})")
    log(f"the worker of {', '.join(job.key[:2])}, seed {job.seed} died ({how}); its trial is repeated on a new worker")
    state.todo.appendleft(job)
    return None


def _start_worker() -> _Worker:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs,), daemon=True)
    with _one_thread_each(), _no_interrupt():
        process.start()
    theirs.close()
    return _Worker(process, ours)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Restrict numeric libraries to one thread in processes that start within the block."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Block SIGINT within the block, also in processes that start in it, until they unblock it."""
    resource_tracker.ensure_running()  # otherwise the first start within the block starts it, which unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


Answer: TypeAlias = TrialRow | KraftError | None
"""Message of a worker: a row, an error that concerns every trial, or None when it is ready."""

ONE_THREAD: Final = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)
"""Environment variables that restrict numeric libraries to one thread; they are read when a library is loaded."""


def serve(pipe: Connection) -> None:
    """Run the jobs of the parent process until it closes the pipe or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles interrupts
    os.dup2(2, 1)  # what a trial prints must not mix with the results on stdout
    try:
        pipe.send(None)
        while True:
            job: Job = pipe.recv()
            pipe.send(_answer(job))
    except (EOFError, OSError):
        return


def _answer(job: Job) -> Answer:
    try:
        return perform(job)
    except KraftError as error:
        return error


ANSWER_TIMEOUT: Final = 10.0  # s, for the scheduler to answer
PREFETCHED: Final = 1  # trials queued at each worker thread besides the running one

_one_trial_at_a_time = threading.Lock()


class Cluster:
    """Runs trials on the workers of the Dask scheduler at `address`."""

    def __init__(self, address: str) -> None:
        """Connect to the scheduler once, to check that it answers.

        Raises:
            InputError: if it does not answer.
            MissingDependency: if the package distributed is not installed.
        """
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            problem = "a Dask cluster needs the package distributed: pip install 'kraft[cluster]'"
            raise MissingDependency(problem) from error
        self.address = address
        try:
            with ThreadPoolExecutor(1) as pool:  # the calling thread may already run an event loop, as in notebooks
                pool.submit(asyncio.run, _connect(address)).result()
        except (OSError, ValueError) as error:
            raise self._no_answer(error) from error

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """See `Executor`; the scheduler's settings state how often a worker may die."""
        client = self._client()
        try:
            yield from self._rows(client, jobs, stop_requested, log)
        except (OSError, CancelledError) as error:
            raise self._connection_lost() from error
        finally:
            client.close(timeout=ANSWER_TIMEOUT)

    def _client(self) -> Client:
        from distributed import Client

        try:
            return Client(self.address, timeout=ANSWER_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise self._no_answer(error) from error

    def _no_answer(self, error: Exception) -> InputError:
        problem = f"no Dask scheduler answers at {self.address} ({error})"
        expected = "expected its address, as in tcp://192.0.2.1:8786"
        return InputError.of_argument("cluster", problem, expected, Code.NOT_FOUND)

    def _rows(self, client: Client, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """Yield rows; only a few trials per thread are submitted at once, so that stopping does not wait for many."""
        here, todo = versions(SIMULATION), list(reversed(jobs))
        running: dict[Future, Job] = {}
        warned = False
        while (todo and not stop_requested()) or running:
            if client.status != "running":
                raise self._connection_lost()
            threads = sum(client.nthreads().values())
            if threads == 0 and not warned:
                log(f"the cluster at {self.address} has no workers; waiting for one")
                warned = True
            free = 0 if stop_requested() else threads * (1 + PREFETCHED) - len(running)
            for job in [todo.pop() for _ in range(min(free, len(todo)))]:
                running[client.submit(perform_checked, job, here, pure=False)] = job
            ended = [future for future in running if future.done()]
            for future in ended:
                yield self._row(future, running.pop(future))
            if not ended:
                time.sleep(POLL)

    def _connection_lost(self) -> InputError:
        problem = f"the scheduler at {self.address} closed the connection"
        expected = "expected it to answer until the last trial"
        return InputError.of_argument("cluster", problem, expected, Code.NOT_FOUND)

    def _row(self, future: Future, job: Job) -> TrialRow:
        from distributed import KilledWorker

        try:
            row: TrialRow = future.result()
        except KilledWorker as error:
            return failed_row(job, f"its worker died too often ({error})")
        return row


async def _connect(address: str) -> None:
    """Open a connection and close it; a `Client` without a scheduler keeps reconnecting even after it is closed."""
    from distributed.core import connect
    from distributed.security import Security

    connection = await connect(address, timeout=ANSWER_TIMEOUT, **Security().get_connection_args("client"))
    connection.abort()


def perform_checked(job: Job, caller_versions: Mapping[str, str]) -> TrialRow:
    """Run a trial on a worker, one at a time in its process, if the versions there are those of the caller."""
    here = versions(SIMULATION)
    if here != caller_versions:
        names = sorted(name for name in {**here, **caller_versions} if here.get(name) != caller_versions.get(name))
        differences = ", ".join(f"{name} {here.get(name)} instead of {caller_versions.get(name)}" for name in names)
        expected = "expected the same versions everywhere"
        raise InputError.of_argument("cluster", f"a worker has {differences}", expected, Code.MISMATCH)
    with _one_trial_at_a_time:
        return perform(job)
