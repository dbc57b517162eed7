"""A worker process: takes jobs from a pipe and sends rows back, until the pipe closes."""

from __future__ import annotations

import os
import signal
from multiprocessing.connection import Connection
from typing import Final, TypeAlias

from kraft.errors import KraftError
from kraft.evaluation.job import Job, perform
from kraft.evaluation.row import TrialRow

Answer: TypeAlias = TrialRow | KraftError | None
"""a row, an error that concerns every trial, or None: ready"""

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
"""environment in which numeric libraries keep to one thread; they read it when they are loaded"""


def serve(pipe: Connection) -> None:
    """Run jobs until the other end closes, which it also does by dying."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that gave the jobs decides what an interrupt means
    os.dup2(2, 1)  # what a trial prints must not get between the results on stdout
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
