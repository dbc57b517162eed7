"""Priority of processes that must keep to the clock, as far as the operating system permits it."""

from __future__ import annotations

import os
from typing import Final

REAL_TIME: Final = 20
"""Priority among real-time processes."""


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


def is_preferred() -> bool:
    """Whether this process runs before all ordinary ones."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) == os.SCHED_FIFO
