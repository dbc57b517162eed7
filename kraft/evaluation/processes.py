"""Executor of trials in worker processes of this machine.

The ProcessPool of pebble 5.2 is not used: an idle worker that dies breaks it, and busy workers take 3 s each to stop.
"""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Final, TypeAlias

from kraft.errors import Defect, InputError, KraftError
from kraft.evaluation.job import POLL, Job, StopRequested, failed_row, perform
from kraft.evaluation.journal import Key, TrialRow
from kraft.text import MessageSink
from ompl_ext.cores import ONE_BLAS_THREAD
from ompl_ext.signals import STOPPING

DEATHS: Final = 2  # workers that die in a trial, after which it has failed
FAILED_STARTS: Final = 3  # workers in a row that die before they are ready
RAISED: Final = "exit code 1"  # of a process that ends with an exception, such as one on its import of the script
GUARD: Final = 'with if __name__ == "__main__": around the call of evaluate'
UNGUARDED: Final = (
    "; what they raised is above. Worker processes import the script that calls evaluate: it needs "
    'if __name__ == "__main__": around the call'
)


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


def check_script() -> None:
    """Check that worker processes can import the program of this process, as they do when they start.

    Raises:
        InputError: if it is from stdin or a pipe; a prompt, a notebook and ``python -c`` have none to import.
    """
    program = sys.modules["__main__"]
    file = getattr(program, "__file__", None)
    if getattr(program, "__spec__", None) is None and file is not None and not os.path.isfile(file):
        problem = "the program is not in a file, and worker processes, also a single one, have to import it"
        raise InputError.of(file, problem, f"save it in a file, {GUARD}, and run that")


class Processes:
    """Runs jobs in `count` processes, one job at a time in each."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(self, jobs: Sequence[Job], stop_requested: StopRequested, log: MessageSink) -> Iterator[TrialRow]:
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


def _handle_death(state: _State, worker: _Worker, log: MessageSink) -> TrialRow | None:
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
            raise Defect(f"worker processes do not start ({how}){UNGUARDED if how == RAISED else ''}")
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
    with _one_thread_each(), _no_signals():
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
def _no_signals() -> Iterator[None]:
    """Block the signals that end kraft within the block, also in processes that start in it: they may ignore them."""
    resource_tracker.ensure_running()  # otherwise the first start within the block starts it, which unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


Answer: TypeAlias = TrialRow | KraftError | None
"""Message of a worker: a row, an error that concerns every trial, or None when it is ready."""

ONE_THREAD: Final = {**ONE_BLAS_THREAD, "NUMEXPR_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""Environment variables that restrict numeric libraries to one thread; they are read when a library is loaded."""


def serve(pipe: Connection) -> None:
    """Run the jobs of the parent process until it closes the pipe or dies."""
    for number in STOPPING:  # they reach every process of a group, and the parent process handles them
        signal.signal(number, signal.SIG_IGN)
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
