"""The command line with another trial: ``python -m support.kraft_command TRIAL ARGUMENTS...``."""

from __future__ import annotations

import sys

import pytest

from kraft_cli.entry import main
from support import fake_trials

if __name__ == "__main__":
    with pytest.MonkeyPatch.context() as patch:
        fake_trials.use(patch, getattr(fake_trials, sys.argv[1]))
        patch.setattr(sys, "argv", [sys.argv[0], *sys.argv[2:]])
        status = main()
    sys.exit(status)
