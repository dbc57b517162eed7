"""Atomic writing of files, and checks before the work that a file can be written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from kraft.errors import Code, Diagnostic, InputError

EXPECTED = "expected a place that can be written and has enough space"


def check_writable(path: Path) -> None:
    """Check that a file or a new folder can be written at `path`, by writing to the nearest existing folder.

    Raises:
        InputError: if `path` is a folder, a file stands where a folder is needed, or nothing can be written.
    """
    if path.is_dir():
        raise InputError.of(str(path), "is a folder", "expected the name of a file", Code.UNWRITABLE)
    folder = next(p for p in path.absolute().parents if os.path.lexists(p))
    if not folder.is_dir():
        raise InputError.of(str(path), f"cannot be written: {folder} is not a folder", EXPECTED, Code.UNWRITABLE)
    try:  # permissions are not enough: /proc and read-only mounts refuse in spite of them
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".kraft-"):
            pass
    except OSError as error:
        problem = f"cannot be written: nothing can be made in {folder} ({error.strerror})"
        raise InputError.of(str(path), problem, EXPECTED, Code.UNWRITABLE) from None


def check_all(*checks: Callable[[], object]) -> None:
    """Run every check and raise their problems together.

    Raises:
        InputError: with the problems of all checks.
    """
    problems: list[Diagnostic] = []
    for check in checks:
        try:
            check()
        except InputError as error:
            problems += error.diagnostics
    if problems:
        raise InputError(problems)


def write_whole(path: Path, content: bytes) -> None:
    """Write `content` to `path` in one step; missing folders are made.

    A reader finds the earlier content or all of the new content, even if the machine stops in between.

    Raises:
        InputError: if it cannot be written; the earlier content is still there then.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary file in the folder of `path` that replaces `path` when the block ends; missing folders are made.

    For files that a library writes itself.  The name of the temporary file ends in ``.part`` whatever the format, so
    a library that takes the format from the name needs it as an argument.  The file is there, and empty, when the
    block begins.  If the block raises, the temporary file is removed and `path` stays as it was.

    Raises:
        InputError: instead of an OSError of the block or of the replacement.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _flush(temporary)
            os.chmod(temporary, file_mode())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        problem = f"cannot be written: {error.strerror or error}"
        raise InputError.of(str(path), problem, EXPECTED, Code.UNWRITABLE) from error


def _flush(path: Path) -> None:
    """Force the content of a file to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def file_mode() -> int:
    """Permissions of a new file; mkstemp makes files that only their owner can read."""
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
