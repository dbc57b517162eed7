"""Entry point of the process of `kraft`; an interrupt during the import of modules prints no traceback."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line of this process and return its exit code."""
    try:
        from kraft_cli.main import main as run

        return run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130  # ExitStatus.INTERRUPTED, which may not be imported yet
