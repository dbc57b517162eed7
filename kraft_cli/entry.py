"""Entry point of the process of `kraft`: no traceback of an interrupt before the command, and none counts after it."""

from __future__ import annotations

import signal
import sys


def main() -> int:
    """Run the command line of this process and return its exit code."""
    try:
        from kraft_cli.main import main as run

        status = run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 130  # ExitStatus.INTERRUPTED, which may not be imported yet
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second interrupt would replace the exit code while Python ends
    return status
