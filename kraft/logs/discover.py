"""Discovery of logs in files and folders: which files form a log, and of which kind it is."""

from __future__ import annotations

import os
import string
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from os.path import realpath
from pathlib import Path
from typing import Final, Literal

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.files import check_all
from kraft.logs.guess import offers
from kraft.logs.mapping import Mapping
from kraft.logs.pairing import pair_across_folders, pair_files, unpaired
from kraft.logs.table import Table, read_heading
from kraft.text import counted, nearest

CSV: Final = (".csv", ".tsv", ".txt")
BAGS: Final = (".bag", ".mcap", ".db3")
COMPRESSED: Final = ".zstd"
"""Suffix of a compressed file in the folder of a bag."""
RECORDED: Final = frozenset({"commands.csv", "poses.csv"})
"""Files of a recorded run: one log, also if the vehicle has other controls than those that are looked for."""
TRUTH: Final = "truth.csv"
"""Ground truth of a recorded run, which is never read."""
GUARD: Final = "guard.csv"
"""Commands that the brake guard of a drive sent instead of the controller."""
FORMATS: Final = (
    "expected CSV files, ROS bags (.bag, .mcap, .db3 or their folders), or folders of kraft record or kraft run"
)
_DEPTH: Final = 6
_HEAD = 65536
"""Number of bytes at the beginning of a file that have its heading."""


@dataclass(frozen=True)
class LogFiles:
    """Files that form one log.

    Attributes:
        name: unique among the logs found together.
        kind: format of the files.
        files: CSV files, or the one file or folder of a bag.
    """

    name: str
    kind: Literal["csv", "run", "bag"]
    files: tuple[Path, ...]

    @property
    def place(self) -> Path:
        """Its file, or the folder that holds its files."""
        return self.files[0] if len(self.files) == 1 else self.files[0].parent

    def content(self) -> frozenset[Path]:
        """Files with its samples, as real paths without links."""
        if self.kind == "bag" and self.files[0].is_dir():
            inside = self.files[0].iterdir()
            return frozenset(Path(realpath(path)) for path in inside if path.suffix in (*BAGS, COMPRESSED))
        return frozenset(Path(realpath(path)) for path in self.files)


def discover(
    paths: Sequence[Path], controls: Sequence[str], mapping: Mapping
) -> tuple[list[LogFiles], list[Diagnostic]]:
    """Find the logs in ``paths``, in the order of their names, and the problems of paths that are no logs.

    A log that is found more than once is returned once, with a problem that reports it.
    """
    found: list[LogFiles] = []
    roots: list[Path] = []
    problems: list[Diagnostic] = []
    loose: dict[tuple[Path, int], list[Path]] = {}
    given: Counter[Path] = Counter()
    for path in paths:
        try:
            if path.is_dir():
                inside, unread = _nonempty(path, controls, mapping)
                found += inside
                roots += [path] * len(inside)
                problems += unread
            else:
                _check_file(path)
                loose.setdefault((path.parent, given[path]), []).append(path)
                given[path] += 1
        except InputError as error:
            problems += error.diagnostics
        except OSError as error:
            problems.append(unreadable(path, error))
    for (folder, _), files in loose.items():  # files of one folder may form a log; one given twice not with itself
        inside = _logs_of(files, folder, controls, mapping, problems)
        found += inside
        roots += [folder] * len(inside)
    found, unpaired_files = _across_folders(found, roots, controls, mapping)
    found, repeated = without_repeated(found)
    return _named_apart(found), problems + unpaired_files + repeated


def check_paths(paths: Sequence[Path]) -> None:
    """Check that there are such files and folders, without reading them.

    Raises:
        InputError: with every path that does not exist, and every file that is no log by its name.
    """
    check_all(*(partial(_check_file, path) for path in paths if not path.is_dir()))


def _check_file(path: Path) -> None:
    if not path.exists():
        siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = nearest(path.name, siblings)
        raise InputError.of(
            str(path),
            "does not exist",
            f"did you mean {str(path.parent / near)!r}?" if near else FORMATS,
            Code.NOT_FOUND,
        )
    if path.name == TRUTH:
        raise InputError.of(
            str(path),
            "is the ground truth of a recorded run, which is never read",
            "expected its folder",
            Code.MISMATCH,
        )
    if path.suffix.lower() not in CSV + BAGS:
        raise InputError.of(str(path), "is not a log that kraft reads", FORMATS, Code.MISMATCH)


def unreadable(path: Path, error: OSError) -> Diagnostic:
    """The problem of a file or folder that cannot be read."""
    return Diagnostic(str(path), f"cannot be read: {error.strerror}", FORMATS, code=Code.UNREADABLE)


def _nonempty(folder: Path, controls: Sequence[str], mapping: Mapping) -> tuple[list[LogFiles], list[Diagnostic]]:
    """Logs of a folder, and the problems of its subfolders that cannot be read."""
    problems: list[Diagnostic] = []
    found = _scan(folder, folder, controls, mapping, 0, problems)
    if not found and not problems:
        names = sorted(path.name for path in folder.iterdir())
        content = (
            f"holds no logs, only {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}" if names else "is empty"
        )
        raise InputError.of(str(folder), content, FORMATS, Code.NOT_FOUND)
    return found, problems


def _scan(
    folder: Path, root: Path, controls: Sequence[str], mapping: Mapping, depth: int, problems: list[Diagnostic]
) -> list[LogFiles]:
    """Logs of a folder and its subfolders; those of these that cannot be read are added to the problems."""
    name = folder.name if folder == root else folder.relative_to(root).as_posix()
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    names = {path.name for path in entries}
    if "metadata.yaml" in names and any(path.suffix in BAGS or path.suffix == COMPRESSED for path in entries):
        return [LogFiles(name, "bag", (folder,))]
    if {"steps.csv", "observations.csv"} <= names:
        tables = ["steps.csv", "observations.csv", *({GUARD} & names)]
        return [LogFiles(name, "run", tuple(folder / table for table in tables))]
    files = [path for path in entries if path.is_file() and path.suffix.lower() in (".csv", ".tsv", *BAGS)]
    found = _logs_of(files, root, controls, mapping, problems)
    if len(found) == 1 and len(found[0].files) > 1:  # the only log of a folder has its name
        found = [LogFiles(name, "csv", found[0].files)]
    for child in entries if depth < _DEPTH else ():
        if child.is_dir():
            try:
                found += _scan(child, root, controls, mapping, depth + 1, problems)
            except OSError as error:
                problems.append(unreadable(child, error))
    return found


def _across_folders(
    found: Sequence[LogFiles], roots: Sequence[Path], controls: Sequence[str], mapping: Mapping
) -> tuple[list[LogFiles], list[Diagnostic]]:
    """The candidates, those of single files joined that are commands and poses of a drive in folders of their own.

    Files of such folders that do not pair are one problem and no candidates.  `roots` are the folders that the names of
    the candidates begin at.
    """
    single: dict[Path, int] = {}  # a file that is found again does not pair
    kinds: tuple[list[Path], list[Path]] = ([], [])
    for i, candidate in enumerate(found):
        if candidate.kind == "csv" and len(candidate.files) == 1 and candidate.files[0] not in single:
            has_commands, has_poses = _offers(candidate.files[0], controls, mapping)
            if has_commands != has_poses:
                kinds[0 if has_commands else 1].append(candidate.files[0])
                single[candidate.files[0]] = i
    pairs, left = pair_across_folders(*kinds)
    used = {single[path] for pair in pairs for path in pair}
    lost = {path for files in left.values() for kind in files for path in kind}
    joined = []
    for pair in pairs:
        first, second = (roots[single[path]] for path in pair)
        joined.append(LogFiles(_shared_name(pair, first if first == second else pair[0].parent.parent), "csv", pair))
    rest = [c for i, c in enumerate(found) if i not in used and not (len(c.files) == 1 and c.files[0] in lost)]
    return [*rest, *joined], [unpaired(folder, *files) for folder, files in left.items()]


def _logs_of(
    files: Sequence[Path], root: Path, controls: Sequence[str], mapping: Mapping, problems: list[Diagnostic]
) -> list[LogFiles]:
    """Logs of files of one folder; that some do not pair is added to the problems."""
    bags = [path for path in files if path.suffix.lower() in BAGS]
    tables = [path for path in files if path not in bags and path.name != TRUTH]
    found = [LogFiles(_name(path, root), "bag", (path,)) for path in bags]
    groups, unread = group_files(tables, controls, mapping)
    problems += unread
    found += [LogFiles(_shared_name(paths, root), "csv", paths) for paths in groups]
    return sorted(found, key=lambda candidate: candidate.name)


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).with_suffix("").as_posix()


def _shared_name(paths: Sequence[Path], root: Path) -> str:
    """Common prefix of the names of files, by folder: ``run1`` for ``run1_commands.csv`` and ``run1_poses.csv``."""
    names = [_name(path, root).split("/") for path in paths]
    shared = "/".join(filter(None, map(_common_prefix, zip(*names, strict=False))))
    return shared or "/".join(names[0])


def _common_prefix(words: Sequence[str]) -> str:
    """Common prefix of some names that ends with a word of each."""
    common = os.path.commonprefix(list(words))  # noqa: RUF071 - characters are meant
    if any(word[len(common) :][:1].islower() for word in words):  # within a word: run1_p of run1_pwm and run1_poses
        common = common.rstrip(string.ascii_letters)
    return common.rstrip("_-. ")


def _named_apart(found: Sequence[LogFiles]) -> list[LogFiles]:
    """Candidates with unique names: those that share a name (from different folders) get the paths of their files."""
    count = Counter(candidate.name for candidate in found)
    return [c if count[c.name] == 1 else LogFiles(str(c.files[0]), c.kind, c.files) for c in found]


def without_repeated(found: Sequence[LogFiles]) -> tuple[list[LogFiles], list[Diagnostic]]:
    """Leave out candidates whose files are all in one that is kept, and report them in one diagnostic.

    A log that is used twice would count twice, and could be fitted and held out at once.
    """
    owners: dict[Path, set[int]] = {}
    kept: set[int] = set()
    contents = [candidate.content() for candidate in found]
    for i in sorted(range(len(found)), key=lambda i: -len(contents[i])):  # a whole bag before its files
        if not set.intersection(*(owners.setdefault(path, set()) for path in contents[i])):
            kept.add(i)
            for path in contents[i]:
                owners[path].add(i)
    again = list(dict.fromkeys(candidate.place for i, candidate in enumerate(found) if i not in kept))
    repeated = []
    if again:
        others = f", as {'is' if len(again) == 2 else 'are'} {counted(len(again) - 1, 'other log')}"
        problem = "is found more than once" + (others if len(again) > 1 else "")
        repeated = [Diagnostic(str(again[0]), problem, "each log counts once", code=Code.DUPLICATE)]
    return [found[i] for i in sorted(kept)], repeated


def group_files(
    files: Sequence[Path], controls: Sequence[str], mapping: Mapping
) -> tuple[list[tuple[Path, ...]], list[Diagnostic]]:
    """Groups of files of one folder, each of which is a log, and the problem that files do not pair, if so.

    A file that is not recognised is a group of its own.
    """
    stated = _stated(files, mapping) or _recorded(files)
    if stated:
        return [stated], []
    whole: list[Path] = []
    commands: list[Path] = []
    poses: list[Path] = []
    for path in files:
        has_commands, has_poses = _offers(path, controls, mapping)
        kind = commands if has_commands and not has_poses else poses if has_poses and not has_commands else whole
        kind.append(path)
    pairs = pair_files(commands, poses)
    used = {path for pair in pairs for path in pair}
    problems = []
    left = [[path for path in kind if path not in used] for kind in (commands, poses)]
    if all(left):
        problems.append(unpaired(files[0].parent, *left))
        used.update(*left)
    return [*pairs, *((path,) for path in files if path not in used)], problems


def _recorded(files: Sequence[Path]) -> tuple[Path, ...]:
    """Files that are the run of kraft record, of whichever vehicle; none if they are something else."""
    return tuple(sorted(files)) if {path.name for path in files} == RECORDED else ()


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
    except (InputError, OSError):  # reported when the file is read as a log
        return False, False
    none = np.zeros(0)
    return offers(Table(str(path), "", dict.fromkeys(names, none), none.astype(np.int64)), controls, mapping)
