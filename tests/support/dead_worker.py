"""Workers that end before they are ready; alone here, so that the process which starts it loads nothing else."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection


def ends(pipe: Connection) -> None:
    """Entry of the worker process."""
    os._exit(9)


def raises(pipe: Connection) -> None:
    """Entry of a worker process with an exception, as on the import of a script that starts processes."""
    raise RuntimeError("not started")
