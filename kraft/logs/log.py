"""A log after reading and cleaning: uninterrupted parts of commands and poses, and findings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kraft.errors import Diagnostic

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """One file that a log was read from.

    Attributes:
        file: its path, as given.
        sha256: of its bytes, in hexadecimal.
    """

    file: str
    sha256: str


@dataclass(frozen=True)
class Finding:
    """An irregularity in a log.

    Attributes:
        kind: a short word to sort by: gap, dropout, duplicate, backward, wrap, teleport, outlier, ...
        count: number of occurrences.
        text: description with the first place (file or topic, row) and what was left out because of it.
    """

    kind: str
    count: int
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass
class Findings:
    """Findings so far, in the order in which they were added."""

    found: list[Finding] = field(default_factory=list)

    def add(self, kind: str, count: int, text: str) -> None:
        """Add a finding unless its count is 0."""
        finding = Finding(kind, int(count), text)
        if count and finding not in self.found:  # commands and poses may share their rows
            self.found.append(finding)

    def as_tuple(self) -> tuple[Finding, ...]:
        """Return all of them."""
        return tuple(self.found)


@dataclass(frozen=True, eq=False)
class Part:
    """An uninterrupted part of a log.

    Both clocks are the same one; its zero is the first stamp of the log. The command in force at the first
    pose is always there, so ``command_times[0] <= pose_times[0]``.

    Attributes:
        command_times: when each command was given, or took effect because the dead-man switch was held, strictly
            ascending, shape (m,), s. The vehicle may respond with a delay. A command is held until the next one, the
            last one until the last pose.
        commands: their values, one column per control, shape (m, nu).
        pose_times: when each pose was measured, strictly ascending, shape (n,), s.
        poses: x and y in m, yaw in rad and continuous (unwrapped), shape (n, 3).
    """

    command_times: Array
    commands: Array
    pose_times: Array
    poses: Array

    @property
    def duration(self) -> float:
        """From the first pose to the last, s."""
        return float(self.pose_times[-1] - self.pose_times[0])


@dataclass(frozen=True, eq=False)
class Log:
    """One drive.

    Attributes:
        name: unique among the logs read together.
        sources: the files it was read from.
        controls: names of the columns of ``Part.commands``.
        parts: in the order of time, at least one.
        findings: irregularities that reading and cleaning found.
        guess: assignment of columns and topics, as one line of text.
        columns: the same without the names of CSV files: equal for logs with the same columns.
    """

    name: str
    sources: tuple[Source, ...]
    controls: tuple[str, ...]
    parts: tuple[Part, ...]
    findings: tuple[Finding, ...] = ()
    guess: str = ""
    columns: str = ""

    @property
    def duration(self) -> float:
        """Duration of all parts together, s."""
        return sum(part.duration for part in self.parts)


@dataclass(frozen=True, eq=False)
class LogSet:
    """Logs that were read together, and the problems of those that could not be read.

    Attributes:
        logs: at least one; those of a folder in the order of their names, its own before those of its folders.
        problems: one or more for each log that was left out.
    """

    logs: tuple[Log, ...]
    problems: tuple[Diagnostic, ...] = ()
