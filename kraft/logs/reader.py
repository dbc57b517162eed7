"""Reading of logs: from files and folders to parts for system identification."""

from __future__ import annotations

import hashlib
import os
from collections import abc
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from kraft.config.source import KeyPath
from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.cleaning import clean
from kraft.logs.discover import FORMATS, GUARD, LogFiles, discover, unreadable
from kraft.logs.guess import choose, unknown_controls
from kraft.logs.log import Array, Log, LogSet, Part, Source
from kraft.logs.mapping import Column, ControlColumn, Mapping
from kraft.logs.matching import written_at
from kraft.logs.motion import Chords, chords
from kraft.logs.names import SYNONYMS, control_score
from kraft.logs.streams import Choice, in_any_unit, on_one_clock, with_reach
from kraft.logs.table import Table, read_csv
from kraft.logs.units import (
    DegreesError,
    SwappedError,
    assumed_radians,
    shows_axes,
    shows_radians,
    shows_steering_radians,
)
from kraft.text import suggestion
from kraft.vehicles import CAR_CONTROLS

_SHOWN: Final = 3
"""Largest number of tables that a message names."""


class MismatchError(InputError):
    """The mapping file or the vehicle fits none of the logs."""


def read_logs(
    paths: str | Path | Iterable[str | Path],
    controls: Sequence[str] = CAR_CONTROLS,
    mapping: Mapping | None = None,
    *,
    any_command_unit: bool = False,
    limits: abc.Mapping[str, tuple[float, float]] | None = None,
) -> LogSet:
    """Read every log in files and folders; a log that cannot be read is a problem of the set.

    Args:
        paths: files and folders, see ``docs/logs.md`` for what they may hold.
        controls: names of the vehicle's controls.
        mapping: a mapping file (`load_mapping`), where the names of the columns are not sufficient.
        any_command_unit: whether commands may be in any unit, as `kraft.sysid.command_units` finds it; otherwise a
            steering command without a stated unit is in radians, and pulse widths are refused.
        limits: least and largest command of the vehicle by control, for what a message proposes instead of pulse
            widths.

    Raises:
        InputError: if there is no log at all, or if none can be read; with every problem.  It is a `MismatchError`
            where mapping file or controls fit none of the logs.
        TypeError: if paths, controls or mapping are of another type.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    _check_arguments(given, controls, mapping)
    stated = mapping or Mapping()
    candidates, problems = discover([Path(path) for path in given], controls, stated)
    read: list[tuple[Log, Choice]] = []
    degrees: set[tuple[str, str]] = set()
    swapped: set[tuple[str, str]] = set()
    places, tables, unread = tuple(problems), list[Table](), 0
    for candidate in candidates:
        try:
            sources, found = _tables(candidate, stated)
        except InputError as error:
            problems += error.diagnostics
            unread += 1
            continue
        tables += map(heading, found)
        try:
            choice = with_reach(on_one_clock(choose(found, controls, stated)), limits or {})
            choice = in_any_unit(choice) if any_command_unit else choice
            read.append((_log(candidate.name, sources, choice, controls, stated), choice))
        except DegreesError as error:
            degrees |= error.columns
            problems += error.diagnostics
        except SwappedError as error:
            swapped.add(error.columns)
            problems += error.diagnostics
        except InputError as error:
            problems += error.diagnostics
    read, turned = _without_swapped(read, swapped)
    logs, alike = _without_degrees(read, degrees)
    problems += [*turned, *alike]
    if not logs:
        # a log that cannot be read may have the column
        if not unread and tables and (wrong := mapping_mismatch(_common(candidates), tables, controls, stated)):
            raise MismatchError([*places, *wrong])
        raise InputError(problems)
    return LogSet(tuple(logs), tuple(dict.fromkeys(problems)))


def _check_arguments(paths: Sequence[object], controls: object, mapping: object) -> None:
    """Check the types of the arguments of `read_logs`, and that there is something to read.

    Raises:
        InputError, TypeError: as `read_logs`.
    """
    if other := [each for each in paths if not isinstance(each, str | os.PathLike)]:
        raise TypeError(f"paths: expected paths of files and folders, not {type(other[0]).__name__}")
    if isinstance(controls, str) or not controls:
        raise TypeError(f"controls: expected the names of a vehicle's controls, not {controls!r}")
    if not isinstance(mapping, Mapping | None):
        raise TypeError(f"mapping: expected the result of load_mapping, not {type(mapping).__name__}")
    if "" in paths:  # as a path it would be the working directory
        raise InputError.of("logs", "there is an empty name", FORMATS)
    if not paths:
        raise InputError.of("logs", "there are none to read", FORMATS, Code.MISSING)


def _common(candidates: Sequence[LogFiles]) -> str:
    """The common folder of the logs, or the only log."""
    places = [candidate.place for candidate in candidates]
    if len({place.is_absolute() for place in places}) > 1:
        places = [place.absolute() for place in places]
    return os.path.commonpath(places) or "."


def _tables(candidate: LogFiles, mapping: Mapping) -> tuple[list[Source], list[Table]]:
    try:
        if candidate.kind == "bag":
            return _bag(candidate.files[0], mapping)
        # a drive that was killed may leave a file of the guard with its heading alone
        files = [path for path in candidate.files if path.name != GUARD or _has_rows(path)]
        sources, tables = _csv_files(files)
    except OSError as error:
        raise InputError([unreadable(candidate.place, error)]) from error
    return sources, _of_run(tables) if candidate.kind == "run" else tables


def _has_rows(path: Path) -> bool:
    with path.open("rb") as file:
        return bool(file.readline() and file.readline())


def _log(name: str, sources: Sequence[Source], choice: Choice, controls: Sequence[str], mapping: Mapping) -> Log:
    parts, findings = clean(choice, controls, mapping)
    return Log(name, tuple(sources), tuple(controls), parts, findings, str(choice), choice.columns)


def _csv_files(files: Iterable[Path]) -> tuple[list[Source], list[Table]]:
    sources, tables = [], []
    for path in files:
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError([unreadable(path, error)]) from error
        sources.append(Source(str(path), hashlib.sha256(content).hexdigest()))
        tables.append(read_csv(path, content))
    return sources, tables


def _of_run(tables: Sequence[Table]) -> list[Table]:
    """Commands and observations of a run, without the states in its steps; the guard's commands are among them."""
    steps, observations, *guard = tables
    commands = _commands(steps)
    for each in guard:
        commands = _merged(commands, _commands(each))
    return [commands, observations]


def _commands(table: Table) -> Table:
    kept = {name: values for name, values in table.columns.items() if name == "time" or name.startswith("command_")}
    return replace(table, columns=kept)


def _merged(commands: Table, guard: Table) -> Table:
    """Rows of both tables by their time; a row of the guard has the line of the command before it."""
    if "time" not in commands.columns or set(commands.columns) != set(guard.columns):
        problem = f"has other columns than {commands.name}: {_listed(list(guard.columns))}"
        raise InputError([guard.diagnostic(problem, f"expected {_listed(list(commands.columns))}")])
    columns = {name: np.concatenate([values, guard.columns[name]]) for name, values in commands.columns.items()}
    order = np.argsort(columns["time"], kind="stable")
    before = np.searchsorted(commands.columns["time"], guard.columns["time"], side="right") - 1
    rows = np.concatenate([commands.rows, commands.rows[np.maximum(before, 0)]])
    blank = {
        name: np.concatenate([commands.blank.get(name, np.zeros(len(commands), bool)),
                              guard.blank.get(name, np.zeros(len(guard), bool))])[order]
        for name in {*commands.blank, *guard.blank} & set(columns)
    }  # fmt: skip
    return Table(commands.file, "", {name: values[order] for name, values in columns.items()}, rows[order], blank,
                 commands.broken)  # fmt: skip


def _bag(path: Path, mapping: Mapping) -> tuple[list[Source], list[Table]]:
    from kraft.logs.bag_tables import read_bag  # takes 0.2 s to import, and most logs are not bags

    named = [mapping.commands.table, mapping.poses.table, mapping.dead_man.table if mapping.dead_man else None]
    named += [column.table for column in mapping.commands.controls.values()]
    tables = read_bag(path, [name for name in named if name is not None])
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return [_hashed(file) for file in files], list(tables)


def _hashed(path: Path) -> Source:
    with path.open("rb") as file:
        return Source(str(path), hashlib.file_digest(file, "sha256").hexdigest())


def _without_swapped(
    read: Sequence[tuple[Log, Choice]], columns: set[tuple[str, str]]
) -> tuple[list[tuple[Log, Choice]], list[Diagnostic]]:
    """Leave out logs whose x and y are swapped in other logs, if they do not show theirs, as a straight drive."""
    kept, problems = [], []
    for log, choice in read:
        x, y = (channel.column for channel in choice.poses.channels[:2])
        if (x, y) in columns and not _shows_axes(log):
            problem = f"{x!r} and {y!r} are swapped in other logs"
            expected = f"write poses: {{x: {y!r}, y: {x!r}}} into a mapping file"
            problems.append(choice.poses.table.diagnostic(problem, expected, code=Code.MISMATCH))
        else:
            kept.append((log, choice))
    return kept, problems


def _without_degrees(
    read: Sequence[tuple[Log, Choice]], columns: set[tuple[str, str]]
) -> tuple[list[Log], list[Diagnostic]]:
    """Leave out logs whose columns hold degrees in other logs, if they do not show radians, as a straight drive."""
    logs, problems = [], []
    for log, choice in read:
        channels = [
            (s.table, channel) for _, s in choice.streams() for channel in s.channels if assumed_radians(channel)
        ]
        alike = [
            (table, channel)
            for table, channel in channels
            if (channel.role, channel.column) in columns and not _shows_radians(log, channel.role)
        ]
        for table, channel in alike:
            problem = f"{channel.column!r} is in degrees in other logs, so that radians are not assumed here"
            problems.append(table.diagnostic(problem, "expected radians, or the unit in a mapping file"))
        if not alike:
            logs.append(log)
    return logs, problems


def _shows_axes(log: Log) -> bool:
    return any(shows_axes(*_path(part)) for part in log.parts)


def _shows_radians(log: Log, role: str) -> bool:
    """Whether a yaw or a steering command of a log is evidently in radians."""
    if role not in log.controls:
        return any(shows_radians(*_path(part)) for part in log.parts)
    k = log.controls.index(role)
    return any(shows_steering_radians(*_path(part), part.commands[:, k]) for part in log.parts)


def _path(part: Part) -> tuple[Chords, Array]:
    """Path and yaw of the poses of a part."""
    return chords(part.pose_times, part.poses[:, :2]), part.poses[:, 2]


def heading(table: Table) -> Table:
    """A table without its rows."""
    none = np.zeros(0)
    return Table(table.file, table.topic, dict.fromkeys(table.columns, none), none.astype(np.int64))


def mapping_mismatch(
    where: str, tables: Sequence[Table], controls: Sequence[str], mapping: Mapping
) -> tuple[Diagnostic, ...]:
    """Problems of the mapping file with all logs, else of the controls, each in one diagnostic.

    Args:
        where: folder of the logs, none of which could be used.
        tables: tables of all logs; only their columns are used.
        controls: names of the vehicle's controls.
        mapping: the mapping file.
    """
    unknown = unknown_controls(controls, mapping)
    wrong = [
        *unknown,
        *(
            problem
            for mapped_column in _mapped_columns(mapping)
            for problem in _missing(*mapped_column, tables, mapping)
        ),
    ]
    return tuple(wrong or _other_vehicle(where, controls, mapping, tables))


def _mapped_columns(mapping: Mapping) -> Iterator[tuple[KeyPath, Column | None, KeyPath, str | None]]:
    """Each column that a mapping file may name: its key, its value, and key and name of the table of its family."""
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
    """The problem that no log has the table, or that no such table has the column."""
    if isinstance(column, ControlColumn) and column.table is not None:
        family, table = (*path, "table"), column.table
    among = [each for each in tables if table is None or table in (each.name, each.file)]
    if not among:
        problem = f"there is no {table!r} in {_listed([each.file for each in tables])}"
        yield mapping.source.diagnostic(
            family, problem, suggestion(str(table), dict.fromkeys(t.name for t in tables)), code=Code.UNKNOWN
        )
    elif column is not None and not any(column.column in each.columns for each in among):
        problem = f"there is no column {column.column!r} in {_listed([each.name for each in among])}"
        known = dict.fromkeys(name for each in among for name in each.columns)
        yield mapping.source.diagnostic(
            written_at(path, mapping), problem, suggestion(column.column, known), code=Code.UNKNOWN
        )


def _other_vehicle(where: str, controls: Sequence[str], mapping: Mapping, tables: Sequence[Table]) -> list[Diagnostic]:
    """The problem that the logs are of a car, and the vehicle has other controls, if so."""
    columns = list(dict.fromkeys(name for table in tables for name in table.columns))

    def shown(names: Iterable[str]) -> list[str]:
        return [name for name in names if any(control_score(column, name) is not None for column in columns)]

    if mapping.commands.controls or shown(controls) or not shown(SYNONYMS):
        return []
    problem = f"the logs have {', '.join(shown(SYNONYMS))}; the vehicle needs {', '.join(controls)}"
    expected = "expected logs of this vehicle, another vehicle, or a mapping file that names the columns"
    return [Diagnostic(where, problem, expected, code=Code.MISMATCH)]


def _listed(names: Sequence[str]) -> str:
    """At most `_SHOWN` names for a message."""
    each = list(dict.fromkeys(names))
    return ", ".join(each) if len(each) <= _SHOWN else f"{', '.join(each[:_SHOWN])} and {len(each) - _SHOWN} more"
