"""Where the process of the `kraft` command begins and ends: quiet if it is interrupted while modules load."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line of this process and return its exit code."""
    try:
        from kraft_cli.main import main as run

        return run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130  # ExitStatus.INTERRUPTED, which may not be loaded yet
