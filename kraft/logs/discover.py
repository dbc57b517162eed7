"""Find the logs in files and folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kraft.errors import Diagnostic


@dataclass(frozen=True)
class Candidate:
    """What looks like one log."""

    name: str
    files: tuple[Path, ...]


def discover(paths: Sequence[Path], controls: Sequence[str]) -> tuple[list[Candidate], list[Diagnostic]]:
    """Find them."""
    found = []
    for path in paths:
        found += (
            [Candidate(f.stem, (f,)) for f in sorted(path.glob("*.csv"))]
            if path.is_dir()
            else [Candidate(path.stem, (path,))]
        )
    return found, []
