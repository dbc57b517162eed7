"""Why no log at all can be read, where that is the mapping file or the vehicle and not the logs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np

from kraft.config.source import KeyPath
from kraft.errors import Diagnostic, InputError
from kraft.logs.columns import SYNONYMS, control_score
from kraft.logs.guess_commands import unknown_controls
from kraft.logs.mapping import Column, Control, Mapping
from kraft.logs.pick import written_at
from kraft.logs.table import Table
from kraft.text import suggestion

_SHOWN: Final = 3
"""Names of tables in one sentence."""


class UnfitError(InputError):
    """The mapping file or the vehicle does not fit any of the logs, whatever they hold."""


def heading(table: Table) -> Table:
    """A table without its rows."""
    none = np.zeros(0)
    return Table(table.file, table.topic, dict.fromkeys(table.columns, none), none.astype(np.int64))


def unfit(where: str, tables: Sequence[Table], controls: Sequence[str], mapping: Mapping) -> tuple[Diagnostic, ...]:
    """What is wrong with the mapping file for all logs alike, else with the controls, each in one diagnostic.

    Args:
        where: the logs are, none of which could be used.
        tables: all of theirs; their columns are looked at alone.
        controls: of the vehicle.
        mapping: what the mapping file says.
    """
    unknown = unknown_controls(controls, mapping)
    wrong = [*unknown, *(problem for wish in _wishes(mapping) for problem in _missing(*wish, tables, mapping))]
    return tuple(wrong or _foreign(where, controls, mapping, tables))


def _wishes(mapping: Mapping) -> Iterator[tuple[KeyPath, Column | None, KeyPath, str | None]]:
    """Each column that may be named: where, what is said, and the table that its family is in with its place."""
    commands, poses, switch = mapping.commands, mapping.poses, mapping.dead_man
    yield ("commands", "time"), commands.time, ("commands", "table"), commands.table
    for name, column in commands.controls.items():
        yield ("commands", "controls", name), column, ("commands", "table"), commands.table
    for name in ("time", "x", "y", "yaw"):
        yield ("poses", name), getattr(poses, name), ("poses", "table"), poses.table
    for i, name in enumerate(poses.quaternion or ()):
        yield ("poses", "quaternion", i), Column(column=name), ("poses", "table"), poses.table
    if switch is not None:
        yield ("dead_man",), Column(column=switch.column), ("dead_man", "table"), switch.table
        yield ("dead_man", "time"), switch.time, ("dead_man", "table"), switch.table


def _missing(
    path: KeyPath,
    column: Column | None,
    family: KeyPath,
    table: str | None,
    tables: Sequence[Table],
    mapping: Mapping,
) -> Iterator[Diagnostic]:
    """That no log has the table, or that no such table has the column."""
    if isinstance(column, Control) and column.table is not None:
        family, table = (*path, "table"), column.table
    among = [each for each in tables if table is None or table in (each.name, each.file)]
    if not among:
        problem = f"there is no {table!r} in {_some([each.file for each in tables])}"
        yield mapping.source.diagnostic(family, problem, suggestion(str(table), dict.fromkeys(t.name for t in tables)))
    elif column is not None and not any(column.column in each.columns for each in among):
        problem = f"there is no column {column.column!r} in {_some([each.name for each in among])}"
        known = dict.fromkeys(name for each in among for name in each.columns)
        yield mapping.source.diagnostic(written_at(path, mapping), problem, suggestion(column.column, known))


def _foreign(where: str, controls: Sequence[str], mapping: Mapping, tables: Sequence[Table]) -> list[Diagnostic]:
    """That the logs are of a vehicle with other controls, where they show those of a car and no control of this one."""
    columns = list(dict.fromkeys(name for table in tables for name in table.columns))

    def shown(names: Iterable[str]) -> list[str]:
        return [name for name in names if any(control_score(column, name) is not None for column in columns)]

    if mapping.commands.controls or shown(controls) or not shown(SYNONYMS):
        return []
    problem = f"the logs have {', '.join(shown(SYNONYMS))}; the vehicle needs {', '.join(controls)}"
    expected = "expected logs of this vehicle, another vehicle, or a mapping file that says which columns they are"
    return [Diagnostic(where, problem, expected)]


def _some(names: Sequence[str]) -> str:
    """Names for a sentence, not more than a few."""
    each = list(dict.fromkeys(names))
    return ", ".join(each) if len(each) <= _SHOWN else f"{', '.join(each[:_SHOWN])} and {len(each) - _SHOWN} more"
