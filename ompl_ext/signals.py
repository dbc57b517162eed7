"""Signals that ask a process to end."""

from __future__ import annotations

import signal
from typing import Final

STOPPING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the end of a service or of a time limit, the end of a terminal or of a session."""
