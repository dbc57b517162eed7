"""Commands that hold until the next one, and the intervals of a dead-man switch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.logs.log import Array
from kraft.logs.mapping import DeadMan, Limits
from kraft.logs.samples import Samples
from kraft.logs.table import Flags, Rows

GAP_MIN: Final = 0.5
GAP_STEPS: Final = 10.0
"""A gap is longer than `GAP_MIN` s and than this many median steps.

A few commands that are late or lost are no gap: neither at a high rate, where ten steps take less than half a second,
nor at a low one, where that is a single step.
"""
RATE_STEP_RATIO: Final = 3.0
"""Commands whose steps are rarely longer than this many median steps are periodic; others are logged on change."""
REPEATED_SHARE: Final = 0.01
"""Share of commands that are the same as the one before, below which a recorder may write changes alone."""
HOLDS_MIN: Final = 3
"""Number of long steps that shows it, where commands also change at a rate, as while the wheel is turned."""


@dataclass(frozen=True, eq=False)
class HeldCommands:
    """Commands, each held until the next one.

    Attributes:
        times: strictly ascending, shape (m,), s.
        values: shape (m, nu).
        until: time until which each is in force if no other follows, shape (m,), s; infinite if commands are logged on
            change.
    """

    times: Array
    values: Array
    until: Array

    @property
    def gaps(self) -> Rows:
        """Indices of commands that end before the next one begins."""
        return np.flatnonzero(self.until[:-1] < self.times[1:])

    def in_force(self, times: Array) -> Rows:
        """Index of the command in force at each time, -1 where there is none. Shape as ``times``."""
        index = np.searchsorted(self.times, times, side="right") - 1
        return np.where((index >= 0) & (times <= self.until[index]), index, -1)


def timeout(samples: Samples, limits: Limits) -> float:
    """Time for which a command of a stream is in force if no other follows, s."""
    if limits.command_gap is not None:
        return limits.command_gap
    times = samples.times
    if len(times) < 10:
        return float("inf")
    steps = np.diff(times)
    usual = float(np.median(steps))
    if np.mean(steps > RATE_STEP_RATIO * usual) > 0.1:
        return float("inf")
    longest = max(GAP_MIN, GAP_STEPS * usual)
    same = np.all(np.diff(samples.values, axis=0) == 0.0, axis=1)
    on_change = np.mean(same) < REPEATED_SHARE and np.sum(steps > longest) >= HOLDS_MIN
    return float("inf") if on_change else longest


def merge_commands(streams: Sequence[Samples], controls: Sequence[str], limits: Limits) -> HeldCommands:
    """Controls of all streams on one clock, in the order of ``controls``, from the time on at which all are known."""
    times = np.unique(np.concatenate([samples.times for samples in streams]))
    times = times[times >= max(samples.times[0] for samples in streams)]
    columns = {}
    until = np.full(len(times), np.inf)
    for samples in streams:
        index = np.searchsorted(samples.times, times, side="right") - 1
        until = np.minimum(until, samples.times[index] + timeout(samples, limits))
        for role, values in zip(samples.stream.roles, samples.values.T, strict=True):
            columns[role] = values[index]
    return HeldCommands(times, np.column_stack([columns[name] for name in controls]), until)


def masked(commands: HeldCommands, columns: Sequence[int], intervals: Array) -> HeldCommands:
    """Commands whose `columns` are 0 outside of `intervals`, shape (k, 2), s."""
    edges = intervals[(intervals > commands.times[0]) & np.isfinite(intervals)]
    times = np.union1d(commands.times, edges)
    index = np.searchsorted(commands.times, times, side="right") - 1
    values, until = commands.values[index].copy(), commands.until[index]
    known = times <= until  # in a gap of the commands nothing is in force
    released = interval_of(times, intervals) < 0
    for k in columns:
        values[released, k] = 0.0
    return HeldCommands(times[known], values[known], until[known])


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
