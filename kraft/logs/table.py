"""Tables: the common form of all formats, named columns of numbers with the row of each number; CSV files as tables.

CSV files may have any separator, units, comments and empty cells, but must have a heading.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kraft.errors import Code, Diagnostic, InputError
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

    def namesakes(self, name: str) -> list[str]:
        """Later columns with the same name in the heading and other numbers."""
        later = (f"{name} ({k})" for k in range(2, len(self.columns) + 1))
        numbers = self.columns[name]
        return [
            other
            for other in later
            if other in self.columns and not np.array_equal(numbers, self.columns[other], equal_nan=True)
        ]

    def where(self, index: int) -> str:
        """Row as text: ``line 12 of a.csv``, ``message 3 of /odom``."""
        return f"{'message' if self.topic else 'line'} {self.rows[index]} of {self.name}"

    def diagnostic(self, problem: str, expected: str, index: int | None = None, code: Code = Code.DATA) -> Diagnostic:
        """Make a diagnostic for the whole table, or for one of its rows."""
        line = None if index is None or self.topic else int(self.rows[index])
        return Diagnostic(self.file, problem, expected, line, path=self.topic, code=code)


_SEPARATORS: Final = (",", ";", "\t", " ")
_WORDS: Final = {"true": 1.0, "false": 0.0}
_HEADING: Final = "expected the names of the columns, such as t,throttle,steering,x,y,yaw"
_SECONDS: Final = re.compile(r"(?:^|(?<=[._/ ]))(?:secs?|seconds)$", re.IGNORECASE)
_NANOSECONDS: Final = ("nsecs", "nsec", "nanosec", "nanosecs", "nanoseconds")
"""How ROS tools export a stamp as two columns: `header.stamp.secs` and `header.stamp.nsecs`, `sec` and `nanosec`."""


def read_csv(path: Path, content: bytes) -> Table:
    """Read a table from the bytes of a CSV file.

    Raises:
        InputError: if it is not text, has no heading or no rows.
    """
    (names, separator), lines, above = _heading(str(path), _text(str(path), content))
    if not any(line.strip() for line in lines):
        raise InputError.of(str(path), "has a heading but no rows", "expected a row for each moment", Code.DATA)
    table = _clean_table(str(path), names, separator, lines, above)
    if table is None:
        table = _any_table(str(path), names, separator, lines, above)
    return replace(table, columns=_joined_stamps(table.columns))


def _clean_table(file: str, names: Sequence[str], separator: str, lines: list[str], above: int) -> Table | None:
    """Table of lines that hold only numbers, as in most files; None if there is anything else."""
    try:
        cells = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    if cells.shape != (len(lines), len(names)):  # loadtxt skips empty lines
        return None
    return Table(file, "", dict(zip(names, cells.T, strict=True)), above + 1 + np.arange(len(lines)))


def _any_table(file: str, names: Sequence[str], separator: str, lines: list[str], above: int) -> Table:
    rows: list[list[str]] = []
    numbers: list[int] = []
    broken: list[int] = []
    for number, row in _fields(file, lines, separator, above):
        fields = row
        while len(fields) > len(names) and not fields[-1].strip():
            fields = fields[:-1]
        if not any(text.strip() for text in fields) or fields[0].startswith("#"):
            continue
        if len(fields) == len(names):
            rows.append(fields)
            numbers.append(number)
        else:
            broken.append(number)
    if not rows:
        expected = f"expected {len(names)} fields, as in its heading"
        raise InputError(
            [Diagnostic(file, "no line has as many fields as the heading", expected, above + 1, code=Code.SYNTAX)]
        )
    table: dict[str, Array] = {}
    blank: dict[str, Flags] = {}
    for name, texts in zip(names, zip(*rows, strict=True), strict=True):
        table[name], empty = _numbers(texts, separator)
        if empty.any():
            blank[name] = empty
    return Table(file, "", table, np.array(numbers, np.int64), blank, tuple(broken))


def _fields(file: str, lines: Sequence[str], separator: str, above: int) -> Iterator[tuple[int, list[str]]]:
    """Fields of each row with the number of its last line; ``above`` is how many lines come before.

    Raises:
        InputError: if a quote is opened and not closed, which would include the rows below.
    """
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    while True:
        first = reader.line_num
        try:
            row = next(reader, None)
        except csv.Error as error:
            problem = f"a field is longer than {csv.field_size_limit()} characters"
            raise _misquoted(file, problem, above + first + 1) from error
        if row is None:
            return
        spans = reader.line_num == len(lines) and reader.line_num - first > 1
        if spans and "".join(lines[first:]).count('"') % 2:
            raise _misquoted(file, "a quote is opened and not closed", above + first + 1)
        yield above + reader.line_num, row


def _misquoted(file: str, problem: str, line: int) -> InputError:
    return InputError([Diagnostic(file, problem, 'expected numbers, and " in pairs', line, code=Code.SYNTAX)])


def read_heading(path: Path, content: bytes) -> tuple[str, ...]:
    """Return only the names of the columns.

    Raises:
        InputError: if it is not text or has no heading.
    """
    return _heading(str(path), _text(str(path), content))[0][0]


def _text(file: str, content: bytes) -> list[str]:
    if b"\0" in content[:4096]:
        raise InputError.of(file, "is not a text file", "expected comma-separated values in UTF-8", Code.SYNTAX)
    lines = content.decode("utf-8-sig", errors="replace").splitlines()
    if not any(line.strip() for line in lines):
        raise InputError.of(file, "is empty", _HEADING, Code.SYNTAX)
    return lines


def _heading(file: str, lines: list[str]) -> tuple[tuple[tuple[str, ...], str], list[str], int]:
    """Names and separator, the lines below, and how many lines there are above those.

    A heading may itself be a comment (``# t, x, y``): then it is the last comment before the first number.
    """
    first = next((i for i, line in enumerate(lines) if line.strip() and line.lstrip()[0] != "#"), len(lines))
    at = first
    if first == len(lines) or _is_numeric(lines[first]):
        comments = [i for i in range(first) if lines[i].strip()]
        if not comments:
            raise InputError(
                [Diagnostic(file, "the first line is not a heading", _HEADING, first + 1, code=Code.SYNTAX)]
            )
        at = comments[-1]
    line = lines[at].strip().lstrip("#%").strip()
    separator = max(_SEPARATORS, key=lambda s: (line.count(s) > 0, -_SEPARATORS.index(s)))
    _, fields = next(_fields(file, [line], separator, at))
    return (_unique([text.strip() for text in fields]), separator), lines[at + 1 :], at + 1


def _is_numeric(line: str) -> bool:
    cells = [cell for cell in line.replace(";", " ").replace(",", " ").split() if cell]
    return all(_number(cell) == _number(cell) for cell in cells)


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return tuple(unique)


def _numbers(texts: Sequence[str], separator: str) -> tuple[Array, Flags]:
    try:
        return np.array(texts, dtype=np.float64), np.zeros(len(texts), bool)
    except ValueError:  # some cell is not a number: find out which
        comma = separator != ","
        values = np.array([_number(text.replace(",", ".") if comma else text) for text in texts])
        return values, np.array([not text.strip() for text in texts])


def _number(text: str) -> float:
    word = text.strip().lower()
    if word in _WORDS:
        return _WORDS[word]
    try:
        return float(word)
    except ValueError:
        return float("nan")


def _joined_stamps(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Columns with the nanoseconds of a split time stamp added to its seconds, and without a column of their own."""
    joined = dict(columns)
    for name in columns:
        found = _SECONDS.search(name)
        if found is None:
            continue
        stem = name[: found.start()].lower()
        fractions = [other for other in joined if other.lower() in {stem + last for last in _NANOSECONDS}]
        if len(fractions) == 1 and _are_split(joined[name], joined[fractions[0]]):
            joined[name] = joined[name] + 1e-9 * joined.pop(fractions[0])
    return joined


def _are_split(seconds: Array, nanoseconds: Array) -> bool:
    """Whether two columns are the whole seconds and the rest of the same time stamps, and not two clocks."""
    whole, rest = seconds[np.isfinite(seconds)], nanoseconds[np.isfinite(nanoseconds)]
    return bool((whole == np.floor(whole)).all() and (rest >= 0.0).all() and (rest < 1e9).all())
