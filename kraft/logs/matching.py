"""Match of roles with the columns of one table: what the mapping file names, else the name that fits best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final

import numpy as np

from kraft.config.source import KeyPath
from kraft.errors import Code, Diagnostic
from kraft.logs.mapping import Column, Mapping
from kraft.logs.names import (
    ALLOWED,
    SYNONYMS,
    YAW,
    Quantity,
    Unit,
    parse,
    time_score,
)
from kraft.logs.streams import Channel
from kraft.logs.table import LOG_TIME, STAMP, Table
from kraft.text import nearest, suggestion

Score = Callable[[str], int | None]
TYPO_LENGTH_MIN: Final = 4
"""Least number of letters of a word whose misspellings are recognised."""
TYPO_SIMILARITY_MIN: Final = 0.75
"""Least similarity of a misspelling."""
MAPPING_HINT = "a mapping file can name the column"


@dataclass(frozen=True)
class ColumnMatch:
    """The column for a role with its score, or the reason why there is none: no match, or a problem."""

    channel: Channel | None
    score: int = 0
    problem: Diagnostic | None = None
    missing: str = ""


@dataclass(frozen=True)
class ColumnMatcher:
    """Matches the columns of one table.

    Attributes:
        table: the table.
        mapping: the mapping file.
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
        names += [other for name in names for other in self.table.namesakes(name) if other not in names]
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
        """Match the clock of a family of columns (commands or poses); ``path`` is the key of the family."""
        if (
            self.table.topic and mapped_column is None
        ):  # the choice between the two stamps of a message follows when all streams are chosen
            stamp = STAMP if STAMP in self.table.columns else LOG_TIME
            return ColumnMatch(self.channel("time", stamp, "time"))
        return self.match("time", lambda column: time_score(column, family), "time", (*path, "time"), mapped_column)

    def mapped(self, role: str, mapped_column: Column, quantity: Quantity, path: KeyPath) -> ColumnMatch:
        """The column that the mapping file names."""
        if mapped_column.column not in self.table.columns:
            problem = f"there is no column {mapped_column.column!r} in {self.table.name}"
            diagnostic = self.mapping.source.diagnostic(
                path, problem, suggestion(mapped_column.column, self.table.columns), code=Code.UNKNOWN
            )
            return ColumnMatch(None, problem=diagnostic)
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
        """Channel of a column, with the unit that is given, that its name states, or that is expected."""
        named = unit or parse(name).unit
        allowed = ALLOWED[quantity]
        stated = named in allowed or bool(self.table.topic)  # in ROS messages it is SI (REP 103)
        found = named if named is not None and named in allowed else allowed[0]
        note = ""
        if quantity == "time" and not stated:
            found, note = _clock_unit(self.table.columns[name])
        if quantity == "control" and not stated and role == "steering":
            found = "rad"
        return Channel(role, name, found, stated=stated, note=note)


def written_at(path: KeyPath, mapping: Mapping) -> KeyPath:
    """Key of the name of the column that the mapping file describes at `path`."""
    written = (*path, "column")
    return written if written in mapping.source.values else path


def missing_columns(table: Table, roles: Sequence[str]) -> Diagnostic:
    """Diagnostic for the roles that no column of a table matches."""
    names = list(table.columns)
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    noun = "field" if table.topic else "column"
    problem = f"no {noun} is recognised as {' or as '.join(roles)}; there are {shown}"
    near = [f"{name!r} for {role}" for role in roles if (name := _near_miss(role, names)) is not None]
    expected = f"did you mean {', '.join(near)}? {MAPPING_HINT}" if near else f"expected one; {MAPPING_HINT}"
    return table.diagnostic(problem, expected, code=Code.MISSING)


def _near_miss(role: str, names: Sequence[str]) -> str | None:
    """The column most similar to a role, or with a word similar to a name of the role: cmd_stear for steering."""
    known = [word for word in SYNONYMS.get(role, YAW if role == "yaw" else ()) if len(word) >= TYPO_LENGTH_MIN]
    misspelt = (
        name
        for name in names
        if any(get_close_matches(word, known, 1, TYPO_SIMILARITY_MIN) for word in parse(name).words)
    )
    return nearest(role, names) or next(misspelt, None)


def _clock_unit(values: np.ndarray) -> tuple[Unit, str]:
    """Unit of stamps since 1970, by their magnitude; smaller numbers are seconds."""
    finite = values[np.isfinite(values)]
    size = float(np.median(np.abs(finite))) if len(finite) else 0.0  # a single stamp may be damaged
    for least, unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
        if size > least:
            return unit, "by their size"  # type: ignore[return-value]
    return "s", ""
