"""Entry point of the process of `kraft`: no traceback of a signal before the command, and none counts after it.

Linear algebra works in one thread, unless the environment says otherwise: kraft works on all cores itself.
"""

from __future__ import annotations

import os
import signal
import sys

from kraft_cli.closed_streams import open_closed_streams
from kraft_cli.signals import raise_stopped, repeat_ignored_signals, set_handler, status_of, word_of
from ompl_ext.cores import ONE_BLAS_THREAD
from ompl_ext.signals import STOPPING


def main() -> int:
    """Run the command line of this process and return its exit code."""
    open_closed_streams()  # before anything opens a file
    try:
        repeat_ignored_signals()
        set_handler(raise_stopped)
        for name, count in ONE_BLAS_THREAD.items():  # before numpy is loaded
            os.environ.setdefault(name, count)
        from kraft_cli.main import main as run

        status = run()
    except KeyboardInterrupt as error:
        print(word_of(error), file=sys.stderr)
        status = int(status_of(error))
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)  # another signal would replace the exit code while Python ends
    return status
