"""Write a file whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kraft.errors import Code, Diagnostic, InputError

EXPECTED = "expected a place that can be written, with room for it"


def check_writable(path: Path) -> None:
    """Find out before the work whether a file or a new folder can be put at `path`, by trying to in the nearest folder.

    Raises:
        InputError: if a folder stands there, a file stands where a folder has to be, or nothing can be made there.
    """
    if path.is_dir():
        raise InputError.of(str(path), "is a folder", "expected the name of a file", Code.UNWRITABLE)
    folder = next(p for p in path.absolute().parents if os.path.lexists(p))
    if not folder.is_dir():
        raise InputError.of(str(path), f"cannot be written: {folder} is not a folder", EXPECTED, Code.UNWRITABLE)
    try:  # permissions do not tell: think of /proc, and of what is mounted read-only
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".kraft-"):
            pass
    except OSError as error:
        problem = f"cannot be written: nothing can be made in {folder} ({error.strerror})"
        raise InputError.of(str(path), problem, EXPECTED, Code.UNWRITABLE) from None


def check_all(*checks: Callable[[], object]) -> None:
    """Make every check, and raise what all of them found.

    Raises:
        InputError: with the problems of every check that raises one.
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
    """Have the content of a file on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def file_mode() -> int:
    """Permissions of a new file; mkstemp makes files that only their owner can read."""
    return 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Temporary folder beside `path` that becomes `path` when the block ends; missing folders above it are made.

    If the block raises, the temporary folder is removed.

    Raises:
        InputError: instead of an OSError of the block or of the renaming.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
        try:
            yield temporary
            os.chmod(temporary, 0o777 & ~_umask())
            os.rename(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)  # there only if something went wrong
    except OSError as error:
        problem = f"cannot be written: {error.strerror or error}"
        raise InputError.of(str(path), problem, EXPECTED, Code.UNWRITABLE) from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write one JSON object; NaN and infinities are refused, they are not JSON.

    Raises:
        InputError: if it cannot be written.
    """
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(path, f"{text}\n".encode())


def write_csv(path: Path, heading: Sequence[str], rows: Iterable[Iterable[float]]) -> None:
    """Write a table of numbers so that reading gives back the same doubles.

    Raises:
        InputError: if it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heading)
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())
