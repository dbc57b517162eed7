"""Find the logs in files and folders: which files belong together, and of which kind they are."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from kraft.errors import Diagnostic, InputError
from kraft.logs.candidate import BAGS, COMPRESSED, Candidate, each_once
from kraft.logs.grouping import group
from kraft.logs.mapping import Mapping
from kraft.text import nearest

CSV: Final = (".csv", ".tsv", ".txt")
TRUTH: Final = "truth.csv"
"""Of a recorded run, for people who want to compare: never opened."""
FORMATS: Final = (
    "expected CSV files, ROS bags (.bag, .mcap, .db3 or their folders), or folders of kraft record or kraft run"
)
_DEPTH: Final = 6


def discover(
    paths: Sequence[Path], controls: Sequence[str], mapping: Mapping
) -> tuple[list[Candidate], list[Diagnostic]]:
    """Find the logs in ``paths``, in the order of their names, and what is wrong with paths that are none.

    A log that is found more than once is returned once, and that is said.
    """
    found: list[Candidate] = []
    problems: list[Diagnostic] = []
    loose: dict[tuple[Path, int], list[Path]] = {}
    given: Counter[Path] = Counter()
    for path in paths:
        try:
            if path.is_dir():
                found += _nonempty(path, controls, mapping)
            else:
                _check_file(path)
                loose.setdefault((path.parent, given[path]), []).append(path)
                given[path] += 1
        except InputError as error:
            problems += error.diagnostics
        except OSError as error:
            problems.append(Diagnostic(str(path), f"cannot be read: {error.strerror}", FORMATS))
    for (folder, _), files in loose.items():  # files of one folder may belong together, but none to itself
        found += _logs_of(files, folder, controls, mapping)
    found, repeated = each_once(found)
    return _named_apart(found), problems + repeated


def _check_file(path: Path) -> None:
    if not path.exists():
        siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = nearest(path.name, siblings)
        raise InputError.of(
            str(path), "is not there", f"did you mean {str(path.parent / near)!r}?" if near else FORMATS
        )
    if path.name == TRUTH:
        raise InputError.of(
            str(path), "is the truth of a recorded run, which is never opened", "expected the folder that it is in"
        )
    if path.suffix.lower() not in CSV + BAGS:
        raise InputError.of(str(path), "is no log that kraft reads", FORMATS)


def _nonempty(folder: Path, controls: Sequence[str], mapping: Mapping) -> list[Candidate]:
    found = _scan(folder, folder, controls, mapping, 0)
    if not found:
        names = sorted(path.name for path in folder.iterdir())
        content = (
            f"holds no logs, only {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}" if names else "is empty"
        )
        raise InputError.of(str(folder), content, FORMATS)
    return found


def _scan(folder: Path, root: Path, controls: Sequence[str], mapping: Mapping, depth: int) -> list[Candidate]:
    name = folder.name if folder == root else folder.relative_to(root).as_posix()
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    names = {path.name for path in entries}
    if "metadata.yaml" in names and any(path.suffix in BAGS or path.suffix == COMPRESSED for path in entries):
        return [Candidate(name, "bag", (folder,))]
    if {"steps.csv", "observations.csv"} <= names:
        return [Candidate(name, "run", (folder / "steps.csv", folder / "observations.csv"))]
    files = [path for path in entries if path.is_file() and path.suffix.lower() in (".csv", ".tsv", *BAGS)]
    found = _logs_of(files, root, controls, mapping)
    if len(found) == 1 and len(found[0].files) > 1:  # one log per folder: the folder's name is the log's
        found = [Candidate(name, "csv", found[0].files)]
    for child in entries if depth < _DEPTH else ():
        if child.is_dir():
            found += _scan(child, root, controls, mapping, depth + 1)
    return found


def _logs_of(files: Sequence[Path], root: Path, controls: Sequence[str], mapping: Mapping) -> list[Candidate]:
    bags = [path for path in files if path.suffix.lower() in BAGS]
    tables = [path for path in files if path not in bags and path.name != TRUTH]
    found = [Candidate(_name(path, root), "bag", (path,)) for path in bags]
    found += [Candidate(_shared_name(paths, root), "csv", paths) for paths in group(tables, controls, mapping)]
    return sorted(found, key=lambda candidate: candidate.name)


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).with_suffix("").as_posix()


def _shared_name(paths: Sequence[Path], root: Path) -> str:
    """What the names of the files begin with: ``run1`` for ``run1_commands.csv`` and ``run1_poses.csv``."""
    names = [_name(path, root) for path in paths]
    return os.path.commonprefix(names).rstrip("_-. /") or names[0]  # noqa: RUF071 - characters are meant


def _named_apart(found: Sequence[Candidate]) -> list[Candidate]:
    """Give candidates of the same name (from different folders) the names of their files."""
    count = Counter(candidate.name for candidate in found)
    return [c if count[c.name] == 1 else Candidate(str(c.files[0]), c.kind, c.files) for c in found]
