"""Common form of all formats: named columns of numbers, with the row of each number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kraft.errors import Code, Diagnostic
from kraft.logs.log import Array

Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]

LOG_TIME: Final = "log_time"
"""Column of a topic: when the recorder received the message, s."""
STAMP: Final = "header.stamp"
"""Column of a topic: time stamp of the sender, s."""


@dataclass(frozen=True, eq=False)
class Table:
    """A CSV file, or the messages of one topic.

    Attributes:
        file: the file, for errors.
        topic: the topic of a bag, empty for a CSV file.
        columns: numbers of each column, NaN where there is none, each of shape (n,).
        rows: the line in the file, or the number of the message on its topic from 1, shape (n,).
        blank: whether a cell was empty rather than not a number, for columns with such cells, each of shape (n,).
        broken: lines with too few or too many fields, which are not rows.
    """

    file: str
    topic: str
    columns: Mapping[str, Array]
    rows: Rows
    blank: Mapping[str, Flags] = field(default_factory=dict)
    broken: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def name(self) -> str:
        """Name for messages: the topic, or the name of the file."""
        return self.topic or self.file.replace("\\", "/").rsplit("/", 1)[-1]

    def where(self, index: int) -> str:
        """Row as text: ``line 12 of a.csv``, ``message 3 of /odom``."""
        return f"{'message' if self.topic else 'line'} {self.rows[index]} of {self.name}"

    def diagnostic(self, problem: str, expected: str, index: int | None = None, code: Code = Code.DATA) -> Diagnostic:
        """Make a diagnostic for the whole table, or for one of its rows."""
        line = None if index is None or self.topic else int(self.rows[index])
        return Diagnostic(self.file, problem, expected, line, path=self.topic, code=code)
