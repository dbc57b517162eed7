"""Trials on a Dask cluster."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from kraft.errors import InputError, MissingDependency
from kraft.evaluation.job import Job, Say, Stop, failed, perform
from kraft.evaluation.row import TrialRow
from kraft.provenance import SIMULATION, versions

if TYPE_CHECKING:
    from distributed import Client, Future

PATIENCE: Final = 10.0  # s, for the scheduler to answer
POLL: Final = 0.1  # s, how late a request to stop is seen
AHEAD: Final = 1  # trials that a worker has in hand besides the one it is at

_alone = threading.Lock()


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
            told = "a Dask cluster needs the package distributed: pip install 'kraft[cluster]'"
            raise MissingDependency(told) from error
        self.address = address
        try:
            with ThreadPoolExecutor(1) as pool:  # this thread may have an event loop of its own, as notebooks do
                pool.submit(asyncio.run, _called(address)).result()
        except (OSError, ValueError) as error:
            raise self._silent(error) from error

    def run(self, jobs: Sequence[Job], stop: Stop, say: Say) -> Iterator[TrialRow]:
        """See `kraft.evaluation.job.Executor`; how many deaths are too many is the scheduler's setting."""
        client = self._client()
        try:
            yield from self._collected(client, jobs, stop, say)
        except (OSError, CancelledError) as error:
            raise self._gone() from error
        finally:
            client.close(timeout=PATIENCE)

    def _client(self) -> Client:
        from distributed import Client

        try:
            return Client(self.address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise self._silent(error) from error

    def _silent(self, error: Exception) -> InputError:
        problem = f"no Dask scheduler answers at {self.address} ({error})"
        return InputError.of_argument("cluster", problem, "expected its address, as in tcp://192.0.2.1:8786")

    def _collected(self, client: Client, jobs: Sequence[Job], stop: Stop, say: Say) -> Iterator[TrialRow]:
        """Keep a few trials per thread of the cluster going, so that there is little to wait for when it stops."""
        here, todo = versions(SIMULATION), list(reversed(jobs))
        running: dict[Future, Job] = {}
        told = False
        while (todo and not stop()) or running:
            if client.status != "running":
                raise self._gone()
            threads = sum(client.nthreads().values())
            if threads == 0 and not told:
                say(f"the cluster at {self.address} has no workers; waiting for one")
                told = True
            room = 0 if stop() else threads * (1 + AHEAD) - len(running)
            for job in [todo.pop() for _ in range(min(room, len(todo)))]:
                running[client.submit(perform_checked, job, here, pure=False)] = job
            ended = [future for future in running if future.done()]
            for future in ended:
                yield self._row(future, running.pop(future))
            if not ended:
                time.sleep(POLL)

    def _gone(self) -> InputError:
        expected = "expected it to answer until the last trial"
        return InputError.of_argument("cluster", f"the scheduler at {self.address} went away", expected)

    def _row(self, future: Future, job: Job) -> TrialRow:
        from distributed import KilledWorker

        try:
            row: TrialRow = future.result()
        except KilledWorker as error:
            return failed(job, f"its worker died too often ({error})")
        return row


async def _called(address: str) -> None:
    """Open a connection and close it: a `Client` that finds nobody goes on trying after it was given up."""
    from distributed.core import connect
    from distributed.security import Security

    connection = await connect(address, timeout=PATIENCE, **Security().get_connection_args("client"))
    connection.abort()


def perform_checked(job: Job, versions_there: Mapping[str, str]) -> TrialRow:
    """Run a trial on a worker, alone in its process, if that would do what the others do."""
    here = versions(SIMULATION)
    if here != versions_there:
        names = sorted(name for name in {**here, **versions_there} if here.get(name) != versions_there.get(name))
        told = ", ".join(f"{name} {here.get(name)} instead of {versions_there.get(name)}" for name in names)
        raise InputError.of_argument("cluster", f"a worker has {told}", "expected the same versions everywhere")
    with _alone:
        return perform(job)
