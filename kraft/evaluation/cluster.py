"""Trials on a Dask cluster."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from kraft.errors import Code, InputError, MissingDependency
from kraft.evaluation.job import Job, Log, StopRequested, failed_row, perform
from kraft.evaluation.row import TrialRow
from kraft.provenance import SIMULATION, versions

if TYPE_CHECKING:
    from distributed import Client, Future

ANSWER_TIMEOUT: Final = 10.0  # s, for the scheduler to answer
POLL: Final = 0.1  # s, how late a request to stop is seen
PREFETCHED: Final = 1  # trials that a worker has in hand besides the one it is at

_one_trial_at_a_time = threading.Lock()


class Cluster:
    """Runs trials on the workers of the Dask scheduler at `address`."""

    def __init__(self, address: str) -> None:
        """Look whether it answers.

        Raises:
            InputError: if it does not.
            MissingDependency: if the package distributed is not installed.
        """
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            problem = "a Dask cluster needs the package distributed: pip install 'kraft[cluster]'"
            raise MissingDependency(problem) from error
        self.address = address
        try:
            with ThreadPoolExecutor(1) as pool:  # this thread may have an event loop of its own, as notebooks do
                pool.submit(asyncio.run, _connect(address)).result()
        except (OSError, ValueError) as error:
            raise self._no_answer(error) from error

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: Log) -> Iterator[TrialRow]:
        """See `kraft.evaluation.job.Executor`; how many deaths are too many is the scheduler's setting."""
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
        """Keep a few trials per thread of the cluster going, so that there is little to wait for when it stops."""
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
            room = 0 if stop_requested() else threads * (1 + PREFETCHED) - len(running)
            for job in [todo.pop() for _ in range(min(room, len(todo)))]:
                running[client.submit(perform_checked, job, here, pure=False)] = job
            ended = [future for future in running if future.done()]
            for future in ended:
                yield self._row(future, running.pop(future))
            if not ended:
                time.sleep(POLL)

    def _connection_lost(self) -> InputError:
        problem, expected = f"the scheduler at {self.address} went away", "expected it to answer until the last trial"
        return InputError.of_argument("cluster", problem, expected, Code.NOT_FOUND)

    def _row(self, future: Future, job: Job) -> TrialRow:
        from distributed import KilledWorker

        try:
            row: TrialRow = future.result()
        except KilledWorker as error:
            return failed_row(job, f"its worker died too often ({error})")
        return row


async def _connect(address: str) -> None:
    """Open a connection and close it: a `Client` that finds nobody goes on trying after it was given up."""
    from distributed.core import connect
    from distributed.security import Security

    connection = await connect(address, timeout=ANSWER_TIMEOUT, **Security().get_connection_args("client"))
    connection.abort()


def perform_checked(job: Job, versions_there: Mapping[str, str]) -> TrialRow:
    """Run a trial on a worker, alone in its process, if that would do what the others do."""
    here = versions(SIMULATION)
    if here != versions_there:
        names = sorted(name for name in {**here, **versions_there} if here.get(name) != versions_there.get(name))
        differences = ", ".join(f"{name} {here.get(name)} instead of {versions_there.get(name)}" for name in names)
        expected = "expected the same versions everywhere"
        raise InputError.of_argument("cluster", f"a worker has {differences}", expected, Code.MISMATCH)
    with _one_trial_at_a_time:
        return perform(job)
