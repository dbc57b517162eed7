"""Write a file whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from kraft.errors import InputError

EXPECTED = "expected a place that can be written, with room for it"


def check_writable(path: Path) -> None:
    """Find out before the work whether a file can be written at `path`.

    Raises:
        InputError: if a file stands where a folder has to be, or the folder is closed to us.
    """
    folder = next(p for p in path.absolute().parents if os.path.lexists(p))
    if not folder.is_dir():
        raise InputError.of(str(path), f"cannot be written: {folder} is not a folder", EXPECTED)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError.of(str(path), f"cannot be written: no permission to write into {folder}", EXPECTED)


def write_whole(path: Path, content: bytes) -> None:
    """Put `content` at `path` in one step; folders on the way are made.

    A reader sees what was there before or all of the new content, even if the machine stops in between.

    Raises:
        InputError: if it cannot be written; what was there before is still there then.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, file_mode())
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise InputError.of(str(path), f"cannot be written: {error.strerror}", EXPECTED) from error


def file_mode() -> int:
    """Permissions of a new file; mkstemp makes files that only their owner can read."""
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
