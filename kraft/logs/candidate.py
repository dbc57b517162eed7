"""What looks like one log, and that each log counts once however often it is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os.path import realpath
from pathlib import Path
from typing import Final, Literal

from kraft.errors import Diagnostic
from kraft.text import counted

BAGS: Final = (".bag", ".mcap", ".db3")
COMPRESSED: Final = ".zstd"
"""Of a file in the folder of a bag."""


@dataclass(frozen=True)
class Candidate:
    """What looks like one log.

    Attributes:
        name: unique among those found together.
        kind: how to read it.
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
        """Files with its samples, under the one name that each has whatever links lead to it."""
        if self.kind == "bag" and self.files[0].is_dir():
            inside = self.files[0].iterdir()
            return frozenset(Path(realpath(path)) for path in inside if path.suffix in (*BAGS, COMPRESSED))
        return frozenset(Path(realpath(path)) for path in self.files)


def each_once(found: Sequence[Candidate]) -> tuple[list[Candidate], list[Diagnostic]]:
    """Leave out candidates whose files are all in one that is kept, and say so in one diagnostic.

    A log that is fitted twice would count twice, and be held out to test the very fit that it is in.
    """
    owners: dict[Path, set[int]] = {}
    kept: set[int] = set()
    contents = [candidate.content() for candidate in found]
    for i in sorted(range(len(found)), key=lambda i: -len(contents[i])):  # the whole before its parts
        if not set.intersection(*(owners.setdefault(path, set()) for path in contents[i])):
            kept.add(i)
            for path in contents[i]:
                owners[path].add(i)
    again = list(dict.fromkeys(candidate.place for i, candidate in enumerate(found) if i not in kept))
    said = []
    if again:
        others = f", as {'is' if len(again) == 2 else 'are'} {counted(len(again) - 1, 'other log')}"
        problem = "is found more than once" + (others if len(again) > 1 else "")
        said = [Diagnostic(str(again[0]), problem, "each log counts once")]
    return [found[i] for i in sorted(kept)], said
