"""Take a column of one table for one role: the one that the mapping file names, else the one whose name fits best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final

import numpy as np

from kraft.config.source import KeyPath
from kraft.errors import Code, Diagnostic
from kraft.logs.choice import Channel
from kraft.logs.mapping import Column, Mapping
from kraft.logs.names import SYNONYMS, YAW, parse, time_score
from kraft.logs.table import LOG_TIME, STAMP, Table
from kraft.logs.units import ALLOWED, Quantity, Unit
from kraft.text import nearest, suggestion

Score = Callable[[str], int | None]
TYPO_LENGTH_MIN: Final = 4
"""Letters that a word must have for another one to be a slip of it."""
TYPO_SIMILARITY_MIN: Final = 0.75
"""How alike the two must be."""
MAPPING_HINT = "a mapping file says which column it is"


@dataclass(frozen=True)
class ColumnMatch:
    """A column and how well it fits, or why there is none: nothing fits the role, or something is wrong."""

    channel: Channel | None
    score: int = 0
    problem: Diagnostic | None = None
    missing: str = ""


@dataclass(frozen=True)
class ColumnMatcher:
    """Picks columns of one table.

    Attributes:
        table: where to look.
        mapping: what the mapping file says.
    """

    table: Table
    mapping: Mapping

    def match(
        self, role: str, score: Score, quantity: Quantity, path: KeyPath, mapped_column: Column | None
    ) -> ColumnMatch:
        """Match the column for a role; ``path`` is the key of the mapping file, ``mapped_column`` its value."""
        if mapped_column is not None:
            return self.mapped(role, mapped_column, quantity, written_at(path, self.mapping))
        scores = {name: fit for name in self.table.columns if (fit := score(name)) is not None}
        if not scores:
            return ColumnMatch(None, missing=role)
        best = max(scores.values())
        names = [name for name, fit in scores.items() if fit == best]
        if len(names) > 1:
            both = ", ".join(repr(name) for name in names)
            return ColumnMatch(
                None,
                problem=self.table.diagnostic(
                    f"{role} could be any of {both}", f"expected one; {MAPPING_HINT}", code=Code.CONFLICT
                ),
            )
        return ColumnMatch(self.channel(role, names[0], quantity), best)

    def clock(self, family: set[str], mapped_column: Column | None, *path: str) -> ColumnMatch:
        """Pick the clock of a family of columns (of commands, or of poses); ``path`` is where the family is mapped."""
        if (
            self.table.topic and mapped_column is None
        ):  # which of a message's two stamps to trust is decided once all are chosen
            stamp = STAMP if STAMP in self.table.columns else LOG_TIME
            return ColumnMatch(self.channel("time", stamp, "time"))
        return self.match("time", lambda column: time_score(column, family), "time", (*path, "time"), mapped_column)

    def mapped(self, role: str, mapped_column: Column, quantity: Quantity, path: KeyPath) -> ColumnMatch:
        """Take the column that the mapping file names."""
        if mapped_column.column not in self.table.columns:
            problem = f"there is no column {mapped_column.column!r} in {self.table.name}"
            said = self.mapping.source.diagnostic(
                path, problem, suggestion(mapped_column.column, self.table.columns), code=Code.UNKNOWN
            )
            return ColumnMatch(None, problem=said)
        channel = self.channel(role, mapped_column.column, quantity, mapped_column.unit)
        place = self.mapping.source.diagnostic(path, "", "")
        full = Channel(
            role,
            channel.column,
            channel.unit,
            mapped_column.zero,
            mapped_column.scale,
            channel.stated,
            place,
            channel.note,
        )
        return ColumnMatch(full, 1000)

    def channel(self, role: str, name: str, quantity: Quantity, unit: Unit | None = None) -> Channel:
        """Make a channel of a column, with the unit that is given, that its name says, or that is expected."""
        said = unit or parse(name).unit
        allowed = ALLOWED[quantity]
        stated = said in allowed or bool(self.table.topic)  # in ROS messages it is SI (REP 103)
        found = said if said is not None and said in allowed else allowed[0]
        note = ""
        if quantity == "time" and not stated:
            found, note = _clock_unit(self.table.columns[name])
        if quantity == "control" and not stated and role == "steering":
            found = "rad"
        return Channel(role, name, found, stated=stated, note=note)


def written_at(path: KeyPath, mapping: Mapping) -> KeyPath:
    """Where the mapping file has the name of the column that it describes at `path`."""
    written = (*path, "column")
    return written if written in mapping.source.values else path


def missing_columns(table: Table, roles: Sequence[str]) -> Diagnostic:
    """Say for which roles nothing fits in a table."""
    names = list(table.columns)
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    noun = "field" if table.topic else "column"
    problem = f"no {noun} is recognised as {' or as '.join(roles)}; there are {shown}"
    near = [f"{name!r} for {role}" for role in roles if (name := _near_miss(role, names)) is not None]
    expected = f"did you mean {', '.join(near)}? {MAPPING_HINT}" if near else f"expected one; {MAPPING_HINT}"
    return table.diagnostic(problem, expected, code=Code.MISSING)


def _near_miss(role: str, names: Sequence[str]) -> str | None:
    """The column most like a role, or one with a word that is much like a name of the role: cmd_stear for steering."""
    known = [word for word in SYNONYMS.get(role, YAW if role == "yaw" else ()) if len(word) >= TYPO_LENGTH_MIN]
    misspelt = (
        name
        for name in names
        if any(get_close_matches(word, known, 1, TYPO_SIMILARITY_MIN) for word in parse(name).words)
    )
    return nearest(role, names) or next(misspelt, None)


def _clock_unit(values: np.ndarray) -> tuple[Unit, str]:
    """Unit of stamps since 1970, told from their size; smaller numbers are seconds."""
    finite = values[np.isfinite(values)]
    size = float(np.max(np.abs(finite))) if len(finite) else 0.0
    for least, unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
        if size > least:
            return unit, "by their size"  # type: ignore[return-value]
    return "s", ""
