"""Parts of a log: poses without a gap while commands are in force, with these commands."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.logs.held_commands import (
    GAP_MIN,
    GAP_STEPS,
    HeldCommands,
)
from kraft.logs.log import Array, Part
from kraft.logs.mapping import Limits
from kraft.logs.motion import OUTLIER
from kraft.logs.samples import Samples
from kraft.logs.table import Flags, Rows

HISTORY: Final = 1.0
"""Time before the first pose of a part from which commands are kept, s: they may take effect with a delay."""


def pose_gap(times: Array, limits: Limits) -> float:
    """Longest time without poses within a part, s."""
    return limits.pose_gap or max(GAP_MIN, GAP_STEPS * float(np.median(np.diff(times))))


def segments(poses: Samples, tracks: Rows, held: Rows, commands: HeldCommands, gap: float) -> list[Rows]:
    """Indices of the poses of each part.

    Args:
        poses: all poses.
        tracks: number of the track of each pose, shape (n,).
        held: number of the interval of the dead-man switch of each pose, negative while it is released, shape (n,).
        commands: commands; poses without a command in force are left out.
        gap: longest time without poses within a part, s.
    """
    index = commands.in_force(poses.times)
    run = np.searchsorted(commands.gaps, index, side="left")  # changes at gaps in the commands
    good: Flags = (index >= 0) & (tracks != OUTLIER) & (held >= 0)
    chosen = np.flatnonzero(good)
    if not len(chosen):
        return []
    marks = np.column_stack([tracks, held, run])[chosen]
    breaks = (np.diff(poses.times[chosen]) > gap) | np.any(np.diff(marks, axis=0) != 0, axis=1)
    return np.split(chosen, np.flatnonzero(breaks) + 1)


def make_part(times: Array, poses: Array, commands: HeldCommands, since: float) -> Part:
    """Make a part from its poses, shape (n, 3), and the commands from at most `HISTORY` before them.

    Commands take effect from ``since`` on, s: one that was in force before begins then.
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
