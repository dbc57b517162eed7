"""What is wrong with the folder of compiled kernels; a module of its own that loads nothing."""

from __future__ import annotations

from pathlib import Path


class CacheError(OSError):
    """Machine code cannot be kept in `folder`, because of `reason`."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(f"{folder}: the kernel cache cannot be written: {reason}")
        self.folder, self.reason = folder, reason
