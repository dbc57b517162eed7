"""Cut a log into uninterrupted parts: where poses and commands are both known, and the dead-man switch is held."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.logs.commands import GAP_LEAST, GAP_STEPS, Commands
from kraft.logs.log import Array, Part
from kraft.logs.mapping import Limits
from kraft.logs.samples import Samples
from kraft.logs.table import Flags, Rows
from kraft.logs.teleports import OUTLIER

HISTORY: Final = 1.0
"""How long before a part's first pose its commands begin, if they do, s: the vehicle may obey them late."""
POSES_MIN: Final = 3


def pose_gap(times: Array, limits: Limits) -> float:
    """How long poses may be missing within a part, s."""
    return limits.pose_gap or max(GAP_LEAST, GAP_STEPS * float(np.median(np.diff(times))))


def stretches(poses: Samples, tracks: Rows, held: Rows, commands: Commands, gap: float) -> list[Rows]:
    """Indices of the poses of each part.

    Args:
        poses: all of them.
        tracks: number of each one's track, shape (n,).
        held: number of each one's interval of the dead-man switch, negative while it is released, shape (n,).
        commands: to leave out what is driven without.
        gap: longest time without poses within a part, s.
    """
    index = commands.in_force(poses.times)
    run = np.searchsorted(commands.gaps, index, side="left")  # changes where the commands had a gap
    good: Flags = (index >= 0) & (tracks != OUTLIER) & (held >= 0)
    chosen = np.flatnonzero(good)
    if not len(chosen):
        return []
    marks = np.column_stack([tracks, held, run])[chosen]
    breaks = (np.diff(poses.times[chosen]) > gap) | np.any(np.diff(marks, axis=0) != 0, axis=1)
    return np.split(chosen, np.flatnonzero(breaks) + 1)


def make_part(times: Array, poses: Array, commands: Commands, since: float) -> Part:
    """Make a part of its poses, shape (n, 3), and of the commands from at most `HISTORY` before them.

    ``since`` is when commands began to be obeyed, s: one that was in force before then counts from then.
    """
    begin = max(since, times[0] - HISTORY)
    first = max(0, int(np.searchsorted(commands.times, begin, side="right")) - 1)
    started = int(commands.in_force(times[:1])[0])
    gaps = commands.gaps
    before = gaps[(gaps >= first) & (gaps < started)]
    if len(before):
        first = int(before[-1]) + 1
    last = int(np.searchsorted(commands.times, times[-1], side="right"))
    command_times = np.maximum(commands.times[first:last], since)
    whole = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    return Part(command_times, commands.values[first:last].copy(), times.copy(), whole)
