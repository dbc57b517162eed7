"""Processes of a drive: how they start, their names, and what keeps them from waiting, as far as it is permitted.

A process that has to keep to the clock runs before all ordinary ones, its memory stays where it is, and garbage is
collected in small parts.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing.context import ForkContext, SpawnContext
from pathlib import Path
from typing import Final

from ompl_ext.signals import STOPPING

REAL_TIME: Final = 20
"""Priority among real-time processes."""
PLANNER: Final = -10
"""Niceness of the planner."""
TOUCHED: Final = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of mlockall(2): pages that were touched once."""


def process_context() -> ForkContext | SpawnContext:
    """How a drive starts its processes: as forks, which have everything imported, where that is safe.

    They are started while this process has a single thread and no transport.
    """
    if sys.platform.startswith("linux"):
        return multiprocessing.get_context("fork")
    return multiprocessing.get_context("spawn")


def name_this_process(name: str) -> None:
    """Give this process a name of up to 15 letters in the lists of the operating system, where it permits it."""
    with contextlib.suppress(OSError):  # only Linux has it, and it is for people alone
        Path("/proc/self/comm").write_text(name, encoding="ascii")


def leave_signals_to_planner() -> None:
    """Ignore the signals that stop a drive: they reach every process of a group, and the planner's tells the others."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


def prefer_this_process() -> bool:
    """Run this process, with the threads that it starts from now on, before all ordinary ones; False if not permitted.

    Linux permits it to root and with the capability CAP_SYS_NICE, or by `rtprio` in /etc/security/limits.conf.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME))
    except PermissionError:
        return False
    return True


def lock_memory() -> bool:
    """Keep the memory that this process has touched from being moved to a disk, programs included; False if it is not.

    Otherwise a process that waited may have to wait for the disk, for seconds if that is busy.  Linux permits it to
    root, with the capability CAP_IPC_LOCK, or by `memlock` in /etc/security/limits.conf.
    """
    if not sys.platform.startswith("linux"):
        return False
    return bool(ctypes.CDLL(None).mlockall(TOUCHED) == 0)


def shorten_collections() -> None:
    """Collect garbage now, and leave what remains out of later collections, which would stop every thread for 0.1 s."""
    gc.collect()
    gc.freeze()


@contextlib.contextmanager
def short_collections() -> Iterator[None]:
    """The same until the end of a context; then all of it can be collected again."""
    shorten_collections()
    try:
        yield
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def preferred_planner() -> Iterator[None]:
    """Run this process before ordinary ones, but not before those that keep to the clock, as far as it is permitted."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(before, PLANNER))
    except PermissionError:  # the check list tells that nothing is preferred
        yield
        return
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


def is_preferred() -> bool:
    """Whether this process runs before all ordinary ones."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) == os.SCHED_FIFO
