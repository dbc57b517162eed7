"""Trials in processes of this machine."""

from __future__ import annotations

import os
import signal
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Final

from kraft.errors import Defect, KraftError
from kraft.evaluation.executor import DEATHS, Say, Stop
from kraft.evaluation.job import Job, failed
from kraft.evaluation.row import Key, TrialRow
from kraft.evaluation.worker import ONE_THREAD, Answer, serve

POLL: Final = 0.1  # s, how late a request to stop is seen
FALSE_STARTS: Final = 3  # workers in a row that die before they are ready


@dataclass(eq=False)
class _Worker:
    """A process, its pipe, and the job it is at; `ready` once it has said so."""

    process: SpawnProcess
    pipe: Connection
    job: Job | None = None
    ready: bool = False

    @property
    def how_it_died(self) -> str:
        """For a sentence."""
        self.process.join(5.0)
        self.process.kill()  # one that closed its pipe and does not end
        self.process.join()
        code = self.process.exitcode
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exit code {code}"


@dataclass
class _State:
    """A run: what is still to do and who does it."""

    todo: deque[Job]
    workers: list[_Worker] = field(default_factory=list)
    deaths: Counter[Key] = field(default_factory=Counter)
    false_starts: int = 0


class Processes:
    """Runs trials in `count` processes, one trial each at a time."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(self, jobs: Sequence[Job], stop: Stop, say: Say) -> Iterator[TrialRow]:
        """See `kraft.evaluation.executor.Executor`.

        Raises:
            Defect: if workers do not start.
        """
        state = _State(deque(jobs))
        try:
            while True:
                if stop():
                    state.todo.clear()
                busy = sum(worker.job is not None for worker in state.workers)
                if not state.todo and not busy:
                    return
                self._assign(state, busy)
                for worker in _heard(state.workers):
                    answer = _receive(worker)
                    if isinstance(answer, KraftError):
                        raise answer
                    if answer is not None:
                        yield answer
                    elif row := self._buried(state, worker, say):
                        yield row
        finally:
            for worker in state.workers:
                worker.pipe.close()
                worker.process.kill()
                worker.process.join()
                worker.process.close()

    def _assign(self, state: _State, busy: int) -> None:
        """Give every idle worker a job, and start workers while there are fewer than there is work for."""
        for worker in state.workers:
            if worker.ready and worker.job is None and state.todo:
                worker.job = state.todo.popleft()
                with suppress(OSError):  # if it died meanwhile, `_heard` will see
                    worker.pipe.send(worker.job)
                busy += 1
        while len(state.workers) < min(self.count, busy + len(state.todo)):
            state.workers.append(_started())

    def _buried(self, state: _State, worker: _Worker, say: Say) -> TrialRow | None:
        """Take note of what a worker that sent no row is: ready, or dead; the row of a job that is given up."""
        if worker.process.is_alive() and not worker.pipe.closed:
            state.false_starts = 0
            return None
        how, job = worker.how_it_died, worker.job
        state.workers.remove(worker)
        worker.process.close()
        if job is None:
            state.false_starts += not worker.ready
            if state.false_starts >= FALSE_STARTS:
                raise Defect(f"worker processes do not start ({how})")
            return None
        state.deaths[job.key] += 1
        name = f"{job.scenario.name}, {job.method.name}, seed {job.seed}"
        if state.deaths[job.key] < DEATHS:
            say(f"the worker of {name} died ({how}); the trial is repeated on a fresh one")
            state.todo.appendleft(job)
            return None
        return failed(job, f"its worker process died {state.deaths[job.key]} times ({how})")


def _heard(workers: Sequence[_Worker]) -> list[_Worker]:
    """The workers that sent something or died."""
    sources: dict[object, _Worker] = {}
    for worker in workers:
        sources[worker.pipe] = sources[worker.process.sentinel] = worker
    found = connection.wait(list(sources), POLL)  # type: ignore[arg-type]
    return list(dict.fromkeys(sources[source] for source in found))


def _receive(worker: _Worker) -> Answer:
    """What a worker sent; None if that it is ready, or that it died, and then its pipe is closed."""
    try:
        answer: Answer = worker.pipe.recv() if worker.pipe.poll() else None
    except (EOFError, OSError):
        worker.pipe.close()
        return None
    if answer is None:
        worker.ready = True
    else:
        worker.job = None
    return answer


def _started() -> _Worker:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs,), daemon=True)
    with _one_thread_each(), _no_interrupt():
        process.start()
    theirs.close()
    return _Worker(process, ours)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that start in here have an environment of one numeric thread."""
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
    """Hold back interrupts, which processes that start in here inherit until they say what they do about them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
