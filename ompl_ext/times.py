"""Comparison of times."""

from __future__ import annotations

from typing import Final

SAME_TIME: Final = 1e-9
"""Difference up to which two times are the same, s.

The times of a drive are sums of periods and of durations, whose rounding errors are smaller; messages of robots have
them in whole nanoseconds.
"""
