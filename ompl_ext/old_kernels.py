"""Folders with kernels of other versions of kraft or other processors: their size, their last use, their removal.

A folder is used when kernels are read from it or written into it (`kernel_cache.note_use`); on a file system that notes
when files are read, that counts too, for versions of kraft that leave no note.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ompl_ext.kernel_cache import cache_folder, check_owner, layers

DAY: Final = 86400.0
"""s"""
NAME: Final = re.compile(r"[0-9a-f]{16}-[0-9a-f]{8}")
"""Name of a folder of kernels: hashes of the sources and of the place of a copy of kraft."""
REMOVED: Final = ".removed-"
"""Begin of the name of a folder that is being removed."""


@dataclass(frozen=True)
class OldKernels:
    """A folder of kernels that this kraft does not use, with its size (bytes) and its last use (s since 1970)."""

    folder: Path
    size: int
    used: float

    def is_unused(self, days: float, now: float | None = None) -> bool:
        """Whether nobody has used it for so many days."""
        return (time.time() if now is None else now) - self.used >= days * DAY


def old_kernels() -> list[OldKernels]:
    """All folders of kernels in this user's cache but the one of this kraft on this processor; it only reads.

    Raises:
        CacheError: there is no cache, or it is one that another user has made.
    """
    own, found = cache_folder().parent, []
    for layer in layers(own):
        check_owner(layer)
        for folder in _folders(layer.parent):
            if folder.name != own.name:
                found.append(OldKernels(folder, *_measured(folder)))
    return found


def remove(kernels: Sequence[OldKernels], days: float) -> list[OldKernels]:
    """Remove those of the folders that are still unused for so many days; return those that are gone.

    A folder gets another name first, in one step: processes that look for kernels find all of them or none, and
    compile.  What another process removes at the same time is gone as well.  A folder that this user may not remove
    stays.
    """
    gone = []
    for old in kernels:
        try:
            if not OldKernels(old.folder, *_measured(old.folder)).is_unused(days):
                continue
            aside = old.folder
            if not aside.name.startswith(REMOVED):
                aside = old.folder.with_name(f"{REMOVED}{old.folder.name}-{os.getpid()}")
                old.folder.rename(aside)
        except FileNotFoundError:  # another process removes it
            continue
        except OSError:
            continue
        shutil.rmtree(aside, ignore_errors=True)
        if not aside.exists():
            gone.append(old)
    return gone


def _folders(parent: Path) -> Iterator[Path]:
    """Folders of kernels, and what an interrupted removal has left; nothing else that lies beside them."""
    try:
        entries = sorted(parent.iterdir())
    except OSError:  # no cache yet, or none that may be listed
        return
    for entry in entries:
        name = entry.name.removeprefix(REMOVED)[:25]
        if NAME.fullmatch(name) and entry.is_dir() and not entry.is_symlink():
            yield entry


def _measured(folder: Path) -> tuple[int, float]:
    """Size of the files in a folder (bytes) and when it was last used (s since 1970).

    Raises:
        FileNotFoundError: the folder is not there.
    """
    size, used = 0, folder.stat().st_mtime
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                status = os.lstat(os.path.join(place, name))
            except FileNotFoundError:  # another process replaces or removes it
                continue
            size, used = size + status.st_size, max(used, status.st_mtime, status.st_atime)
    return size, used
