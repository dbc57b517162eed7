"""Executor of trials on the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from kraft.errors import Code, InputError, MissingDependency
from kraft.evaluation.job import POLL, Job, StopRequested, failed_row, perform
from kraft.evaluation.journal import TrialRow
from kraft.provenance import SIMULATION, install_command, versions
from kraft.text import MessageSink

if TYPE_CHECKING:
    from distributed import Client, Future

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
            problem = f"a Dask cluster needs the package distributed: {install_command('cluster')}"
            raise MissingDependency(problem) from error
        self.address = address
        try:
            with ThreadPoolExecutor(1) as pool:  # the calling thread may already run an event loop, as in notebooks
                pool.submit(asyncio.run, _connect(address)).result()
        except (OSError, ValueError) as error:
            raise self._no_answer(error) from error

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: MessageSink) -> Iterator[TrialRow]:
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

    def _rows(
        self, client: Client, jobs: Sequence[Job], stop_requested: StopRequested, log: MessageSink
    ) -> Iterator[TrialRow]:
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


async def _connect(address: str) -> None:
    """Open a connection and close it; a `Client` without a scheduler keeps reconnecting even after it is closed."""
    from distributed.core import connect
    from distributed.security import Security

    connection = await connect(address, timeout=ANSWER_TIMEOUT, **Security().get_connection_args("client"))
    connection.abort()
