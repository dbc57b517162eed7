"""Error of the kernel cache, in a module that imports nothing heavy."""

from __future__ import annotations

from pathlib import Path


class CacheError(OSError):
    """The cache folder `folder` is of no use: `problem` says why, and `expected` what is to be done."""

    def __init__(self, folder: Path, problem: str, expected: str) -> None:
        super().__init__(f"{folder}: the kernel cache {problem}; {expected}")
        self.folder, self.problem, self.expected = folder, problem, expected
