"""Which CSV files of a folder are a log each, and which are the commands and the poses of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kraft.errors import InputError
from kraft.logs.columns import COMMAND, POSE
from kraft.logs.csv_table import read_heading
from kraft.logs.guess import offers
from kraft.logs.mapping import Mapping
from kraft.logs.names import parse
from kraft.logs.table import Table

_HEAD = 65536  # bytes; a heading is in them


def group(files: Sequence[Path], controls: Sequence[str], mapping: Mapping) -> list[tuple[Path, ...]]:
    """Group files of one folder: each group is a log. What is recognised as nothing is a group of its own."""
    stated = _stated(files, mapping)
    if stated:
        return [stated]
    whole: list[Path] = []
    commands: list[Path] = []
    poses: list[Path] = []
    for path in files:
        has_commands, has_poses = _offers(path, controls, mapping)
        kind = commands if has_commands and not has_poses else poses if has_poses and not has_commands else whole
        kind.append(path)
    pairs = _pairs(commands, poses)
    paired = {path for pair in pairs for path in pair}
    return [*pairs, *((path,) for path in files if path not in paired)]


def _stated(files: Sequence[Path], mapping: Mapping) -> tuple[Path, ...]:
    """Files that the mapping file names, if all of them are here and there are several."""
    tables = [mapping.commands.table, mapping.poses.table, mapping.dead_man.table if mapping.dead_man else None]
    tables += [column.table for column in mapping.commands.controls.values()]
    wanted = {table for table in tables if table is not None}
    found = tuple(path for path in files if path.name in wanted)
    return found if len(wanted) > 1 and len(found) == len(wanted) else ()


def _offers(path: Path, controls: Sequence[str], mapping: Mapping) -> tuple[bool, bool]:
    try:
        with path.open("rb") as file:
            names = read_heading(path, file.read(_HEAD))
    except (InputError, OSError):  # said when the file is read as a log
        return False, False
    none = np.zeros(0)
    return offers(Table(str(path), "", dict.fromkeys(names, none), none.astype(np.int64)), controls, mapping)


def _pairs(commands: Sequence[Path], poses: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Pair files whose names differ only in the words for commands and poses, or the only two there are."""
    if len(commands) == len(poses) == 1:
        return [(commands[0], poses[0])]
    partners: dict[tuple[str, ...], tuple[list[Path], list[Path]]] = {}
    for kind, paths in enumerate((commands, poses)):
        for path in paths:
            partners.setdefault(_key(path), ([], []))[kind].append(path)
    return [(a[0], b[0]) for a, b in partners.values() if len(a) == len(b) == 1]


def _key(path: Path) -> tuple[str, ...]:
    return tuple(word for word in parse(path.stem).words if word not in COMMAND | POSE)
