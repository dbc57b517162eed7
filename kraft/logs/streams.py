"""Streams of a log: the columns chosen for commands, poses and the dead-man switch, and their samples.

A choice has units, and is values and a line of text.  Samples are the rows of a stream's table with numbers, in the
order of time; commands are held until the next one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.log import Array, Findings
from kraft.logs.mapping import DeadMan, Limits
from kraft.logs.names import FACTOR, Unit
from kraft.logs.table import LOG_TIME, STAMP, Flags, Rows, Table

STAMP_TOLERANCE: Final = 1.0
"""Largest difference between the clocks of senders and recorder, s."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One column and its role.

    Attributes:
        role: time, throttle, x, yaw, qw, ...
        column: its name in the table.
        unit: unit of its numbers.
        zero: the number that represents zero, in that unit.
        scale: factor besides that of the unit.
        stated: whether the name or the mapping file states the unit; otherwise it is the expected one.
        place: where the mapping file names it, for errors; None if it was guessed.
        note: remark for the line of text.
        any_unit: whether its numbers may be in a unit that `unit` does not state.
    """

    role: str
    column: str
    unit: Unit
    zero: float = 0.0
    scale: float = 1.0
    stated: bool = False
    place: Diagnostic | None = None
    note: str = ""
    any_unit: bool = False

    def values(self, table: Table) -> Array:
        """Numbers in SI units and radians, shape (n,)."""
        return (table.columns[self.column] - self.zero) * (self.scale * FACTOR[self.unit])

    def __str__(self) -> str:
        factor = FACTOR[self.unit] != 1 or self.scale != 1 or self.zero != 0
        details: list[str] = [self.unit] if self.unit != "1" else []
        details += ["converted"] if factor else []
        details += [self.note] if self.note else []
        return f"{self.role} from {self.column!r}" + (f" ({', '.join(details)})" if details else "")


@dataclass(frozen=True, eq=False)
class Stream:
    """Columns of one table that share a clock.

    Attributes:
        table: table of the columns.
        time: column with the clock.
        channels: the other columns.
    """

    table: Table
    time: Channel
    channels: tuple[Channel, ...]

    @property
    def roles(self) -> tuple[str, ...]:
        """Roles of the columns."""
        return tuple(channel.role for channel in self.channels)

    def times(self) -> Array:
        """Time of each row as in the file, shape (n,), s."""
        return self.time.values(self.table)

    def values(self) -> Array:
        """Numbers in SI units and radians, shape (n, channels)."""
        return np.column_stack([channel.values(self.table) for channel in self.channels])

    def present(self) -> Flags:
        """Rows that hold a sample, shape (n,); a row whose cells are all empty belongs to another stream."""
        blank = [self.table.blank.get(channel.column) for channel in self.channels]
        masks = [mask for mask in blank if mask is not None]
        if len(masks) < len(blank):
            return np.ones(len(self.table), bool)
        empty: Flags = np.all(np.column_stack(masks), axis=1)
        return ~empty

    def __str__(self) -> str:
        if "qw" not in self.roles:
            return ", ".join(map(str, (self.time, *self.channels)))
        turn = ", ".join(channel.column for channel in self.channels[2:])
        common = os.path.commonprefix([channel.column for channel in self.channels[2:]]).rstrip("._")  # noqa: RUF071
        first = ", ".join(map(str, (self.time, *self.channels[:2])))
        return f"{first}, yaw from {common or turn!r} (quaternion, converted)"


@dataclass(frozen=True, eq=False)
class Choice:
    """Streams that a log is read from.

    Attributes:
        commands: streams that together have every control once.
        poses: a stream with x, y and yaw, or with x, y, qx, qy, qz and qw.
        dead_man: stream of the dead-man switch, if there is one.
        unused: tables and columns that could have been taken as well.
    """

    commands: tuple[Stream, ...]
    poses: Stream
    dead_man: Stream | None = None
    unused: tuple[str, ...] = ()

    def streams(self) -> Iterable[tuple[str, Stream]]:
        """Each stream with its name."""
        yield from (("commands", stream) for stream in self.commands)
        yield "poses", self.poses
        if self.dead_man is not None:
            yield "dead man", self.dead_man

    def __str__(self) -> str:
        one = len({id(stream.table) for _, stream in self.streams()}) == 1 and not self.poses.table.topic
        parts = [f"{what}: {'' if one else stream.table.name + ': '}{stream}" for what, stream in self.streams()]
        return "; ".join(parts) + (f"; not used: {', '.join(self.unused)}" if self.unused else "")


def on_one_clock(choice: Choice) -> Choice:
    """Use the stamps of the recorder for all streams if the stamps of the senders are from different clocks.

    Only chosen streams are compared: a latched topic that is not used may be hours old.  A clock that the mapping file
    names is kept.
    """
    streams = [stream for _, stream in choice.streams() if stream.table.topic]
    lags = [_lag(stream) for stream in streams if stream.time.column in (STAMP, LOG_TIME)]
    if not lags or max(lags) - min(lags) <= STAMP_TOLERANCE:
        return choice
    note = f"the stamps in the headers are up to {max(map(abs, lags)):.3g} s off"
    dead_man = choice.dead_man
    return replace(
        choice,
        commands=tuple(_by_recorder(stream, note) for stream in choice.commands),
        poses=_by_recorder(choice.poses, note),
        dead_man=None if dead_man is None else _by_recorder(dead_man, note),
    )


def in_any_unit(choice: Choice) -> Choice:
    """Leave open what the numbers of commands mean, where neither name nor mapping file states it."""
    streams = tuple(
        replace(
            stream,
            channels=tuple(c if c.stated else replace(c, unit="1", any_unit=True) for c in stream.channels),
        )
        for stream in choice.commands
    )
    return replace(choice, commands=streams)


def _lag(stream: Stream) -> float:
    """Difference between the clock of a stream and that of the recorder, s."""
    return float(np.median(stream.times() - stream.table.columns[LOG_TIME]))


def _by_recorder(stream: Stream, note: str) -> Stream:
    if stream.time.place is not None:
        return stream
    return replace(stream, time=replace(stream.time, column=LOG_TIME, note=note))


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
