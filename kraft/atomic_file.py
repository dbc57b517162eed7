"""Write a file whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from kraft.errors import InputError


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
            os.chmod(temporary, 0o666 & ~_umask())  # mkstemp makes files that only their owner can read
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        problem = f"cannot be written: {error.strerror}"
        raise InputError.of(str(path), problem, "expected a place that can be written, with room for it") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
