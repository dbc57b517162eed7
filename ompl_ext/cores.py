"""Cores of this machine that a process may use, and the threads of libraries."""

from __future__ import annotations

import os
from typing import Final

ONE_BLAS_THREAD: Final = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)
"""Environment variables that restrict linear algebra to one thread; they are read when its library is loaded.

Its threads wait for each other without sleeping: beside other work a regression takes 30 times as long with two of
them as with one, and on an idle machine about as long.
"""


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
