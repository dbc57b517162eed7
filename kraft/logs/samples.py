"""Samples of a stream: rows of its table with numbers, in the order of time; commands held until the next one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.choice import Stream
from kraft.logs.log import Array, Findings
from kraft.logs.mapping import DeadMan, Limits
from kraft.logs.table import Flags, Rows

BACKWARD_MAX: Final = 0.2
"""Largest share of rows that run backwards in time; a file with more holds several recordings."""

VALUE_MAX: Final = 1e30
"""Largest plausible value in any unit; larger ones are corrupt bytes."""


GAP_MIN: Final = 0.5

GAP_STEPS: Final = 10.0
"""A gap is longer than `GAP_MIN` s and than this many median steps."""

RATE_STEP_RATIO: Final = 3.0
"""Commands whose steps are rarely longer than this many median steps are periodic; others are logged on change."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows of a stream.

    Attributes:
        what: commands, poses, ...
        stream: stream of the samples.
        times: strictly ascending, shape (n,), s.
        values: SI units and radians, shape (n, channels).
        index: row of each sample in the table, shape (n,).
    """

    what: str
    stream: Stream
    times: Array
    values: Array
    index: Rows

    def __len__(self) -> int:
        return len(self.times)

    def where(self, i: int) -> str:
        """Row of sample ``i``, as text."""
        return self.stream.table.where(int(self.index[i]))

    def keep(self, flags: Flags) -> Samples:
        """Return the flagged samples."""
        return Samples(self.what, self.stream, self.times[flags], self.values[flags], self.index[flags])

    def shifted(self, origin: float) -> Samples:
        """Return the samples with times from ``origin`` on, s."""
        return Samples(self.what, self.stream, self.times - origin, self.values, self.index)

    def diagnostic(self, problem: str, expected: str, i: int | None = None, code: Code = Code.DATA) -> Diagnostic:
        """Make a diagnostic for all of them or for one."""
        return self.stream.table.diagnostic(problem, expected, None if i is None else int(self.index[i]), code)

    def refuse(self, problem: str, expected: str, i: int | None = None, code: Code = Code.DATA) -> InputError:
        """Make an error for all of them or for one."""
        return InputError([self.diagnostic(problem, expected, i, code)])


def read_samples(what: str, stream: Stream, findings: Findings, rows: str = "") -> Samples:
    """Read the samples of a stream; findings about times name them ``rows``, if given, instead of ``what``.

    Raises:
        InputError: if there are no samples, or if time runs backwards too often.
    """
    index = np.flatnonzero(stream.present())
    samples = Samples(what, stream, stream.times()[index], stream.values()[index], index)
    return _forward(_numbers(samples, findings), findings, rows or what)


def _numbers(samples: Samples, findings: Findings) -> Samples:
    cells = np.column_stack([samples.times, samples.values])
    finite = np.abs(cells) < VALUE_MAX  # neither NaN nor infinite, and its square is finite
    good: Flags = np.all(finite, axis=1)
    if not good.any():
        columns = [c.column for c in (samples.stream.time, *samples.stream.channels)]
        empty = [name for name, bad in zip(columns, ~np.any(finite, axis=0), strict=True) if bad]
        problem = f"{samples.what}: no row has numbers in all of {', '.join(columns)}"
        problem += f"; {', '.join(empty)} has none at all" if empty else ""
        raise samples.refuse(problem, "expected numbers", 0 if len(samples) else None)
    if not good.all():
        first, bad = int(np.argmin(good)), int(np.sum(~good))
        text = f"{bad} of {len(good)} {samples.what} are not numbers (NaN), first in {samples.where(first)}; left out"
        findings.add("nan", bad, text)
    return samples.keep(good)


def _forward(samples: Samples, findings: Findings, rows: str) -> Samples:
    times = samples.times
    before = np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]])
    backward, twice = times < before, times == before
    if backward.any():
        first, bad = int(np.argmax(backward)), int(np.sum(backward))
        fact = f"time runs backwards in {bad} of {len(samples)} {rows}"
        if bad > max(1.0, BACKWARD_MAX * len(samples)):
            step = times[first] - times[first - 1]
            raise samples.refuse(
                f"{fact}, first by {-step:.6g} s",
                "expected ascending time stamps; put each recording into a file of its own",
                first,
            )
        findings.add("backward", bad, f"{fact}, first in {samples.where(first)}; left out")
    if twice.any():
        first, bad = int(np.argmax(twice)), int(np.sum(twice))
        fact = f"{bad} of {len(samples)} {rows} have the time stamp of the one before"
        findings.add("duplicate", bad, f"{fact}, first in {samples.where(first)}; left out")
    return samples.keep(~backward & ~twice)


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


def timeout(times: Array, limits: Limits) -> float:
    """Time for which a command of a stream is in force if no other follows, s."""
    if limits.command_gap is not None:
        return limits.command_gap
    if len(times) < 10:
        return float("inf")
    steps = np.diff(times)
    usual = float(np.median(steps))
    if np.mean(steps > RATE_STEP_RATIO * usual) > 0.1:
        return float("inf")
    return max(GAP_MIN, GAP_STEPS * usual)


def merge_commands(streams: Sequence[Samples], controls: Sequence[str], limits: Limits) -> HeldCommands:
    """Controls of all streams on one clock, in the order of ``controls``, from the time on at which all are known."""
    times = np.unique(np.concatenate([samples.times for samples in streams]))
    times = times[times >= max(samples.times[0] for samples in streams)]
    columns = {}
    until = np.full(len(times), np.inf)
    for samples in streams:
        index = np.searchsorted(samples.times, times, side="right") - 1
        until = np.minimum(until, samples.times[index] + timeout(samples.times, limits))
        for role, values in zip(samples.stream.roles, samples.values.T, strict=True):
            columns[role] = values[index]
    return HeldCommands(times, np.column_stack([columns[name] for name in controls]), until)


def masked(commands: HeldCommands, columns: Sequence[int], intervals: Array) -> HeldCommands:
    """Commands whose `columns` are 0 outside of `intervals`, shape (k, 2), s."""
    edges = intervals[(intervals > commands.times[0]) & (intervals <= commands.times[-1])]
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
