"""Error of the kernel cache, in a module that imports nothing heavy."""

from __future__ import annotations

from pathlib import Path


class CacheError(OSError):
    """The cache folder `folder` is not writable, because of `reason`."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(f"{folder}: the kernel cache cannot be written: {reason}")
        self.folder, self.reason = folder, reason
