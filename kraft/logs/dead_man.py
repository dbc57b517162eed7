"""When the dead-man switch is held."""

from __future__ import annotations

import numpy as np

from kraft.logs.log import Array
from kraft.logs.mapping import DeadMan
from kraft.logs.samples import Samples
from kraft.logs.table import Flags, Rows


def held_intervals(switch: Samples, rule: DeadMan | None) -> Array:
    """Intervals during which the switch is held, shape (k, 2), s; the last may have no end."""
    held: Flags = switch.values[:, 0] > (0.5 if rule is None else rule.above)
    if rule is not None and rule.inverted:
        held = ~held
    edges = np.diff(np.concatenate([[False], held, [False]]).astype(np.int64))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    after = np.append(switch.times, np.inf)
    return np.column_stack([switch.times[starts], after[ends]])


def interval_of(times: Array, intervals: Array) -> Rows:
    """Number of the interval that each time is in, -1 for none. Shape as ``times``."""
    if not len(intervals):
        return np.full(len(times), -1, np.int64)
    index = np.searchsorted(intervals[:, 0], times, side="right") - 1
    inside = (index >= 0) & (times < intervals[np.maximum(index, 0), 1])
    return np.where(inside, index, -1)
