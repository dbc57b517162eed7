"""Streams of a log: the columns chosen for commands, poses and the dead-man switch, with their units."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.errors import Diagnostic
from kraft.logs.log import Array
from kraft.logs.names import FACTOR, Unit
from kraft.logs.table import LOG_TIME, STAMP, Flags, Table

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
        reach: largest command of the vehicle, for messages; None if it is not known.
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
    reach: float | None = None

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
        return self._text([] if one else [stream.table.name for _, stream in self.streams()])

    @property
    def columns(self) -> str:
        """The text without the names of CSV files, which differ between logs whose columns are the same."""
        tables = [(id(stream.table), stream.table.topic) for _, stream in self.streams()]
        first = list(dict.fromkeys(tables))
        return self._text([topic or f"file {first.index((key, topic)) + 1}" for key, topic in tables])

    def _text(self, tables: Sequence[str]) -> str:
        """Streams with the names of their tables, if these are given, and what is not used."""
        names = [f"{name}: " for name in tables] or [""] * len(tuple(self.streams()))
        parts = [f"{what}: {name}{stream}" for name, (what, stream) in zip(names, self.streams(), strict=True)]
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


def with_reach(choice: Choice, limits: Mapping[str, tuple[float, float]]) -> Choice:
    """The same with the largest commands of the vehicle, from the limits of its controls by name."""
    reach = {name: max(map(abs, pair)) for name, pair in limits.items()}
    streams = tuple(
        replace(stream, channels=tuple(replace(c, reach=reach.get(c.role)) for c in stream.channels))
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
