"""Atomic writing of files, files of lines, and checks before the work that a file can be written."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from kraft.errors import Code, Diagnostic, InputError

EXPECTED = "expected a place that can be written and has enough space"


def path_from(folder: Path, reference: str) -> Path:
    """Path that a file in `folder` states, without folders that a ``..`` leaves again, unless they are links.

    So messages are about `floor.yaml` and not about `maps/../floor.yaml`, which `maps/lab.yaml` may call it.
    """
    path = folder / reference
    short = Path(os.path.normpath(path))
    with suppress(ValueError, OSError):  # a text that is no path is reported by who opens it
        if os.path.realpath(short) == os.path.realpath(path):
            return short
    return path


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


def check_new_folder(path: Path, expected: str = "expected a new folder") -> None:
    """Check that a folder can be made at `path`, and that nothing is there; `expected` is what the message asks for.

    Raises:
        InputError: if something is there, or nothing can be written.
    """
    if os.path.lexists(path):
        raise InputError.of(str(path), "is there already", expected, Code.EXISTS)
    check_writable(path)


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
    """Put `content` at `path` in one step; folders on the way are made.

    A reader sees what was there before or all of the new content, even if the machine stops in between.

    Raises:
        InputError: if it cannot be written; what was there before is still there then.
    """
    with Replacement(path) as new:
        try:
            with new.temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise unwritable(path, error) from error
        new.commit()


class Replacement:
    """A temporary file beside `path` that `commit` puts in its place; a context manager that removes it otherwise.

    For content that a library writes by itself; `write_whole` is for content at hand.
    """

    def __init__(self, path: Path) -> None:
        """Make the temporary file, and the folders on the way.

        Raises:
            InputError: if they cannot be made.
        """
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
            os.close(handle)
        except OSError as error:
            raise unwritable(path, error) from error
        self.temporary = Path(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.discard()

    def commit(self) -> None:
        """Put the file in its place, in one step.

        Raises:
            InputError: if that is not possible.
        """
        try:
            os.chmod(self.temporary, file_mode())
            os.replace(self.temporary, self._path)
        except OSError as error:
            raise unwritable(self._path, error) from error

    def discard(self) -> None:
        """Remove the temporary file; does nothing after `commit`."""
        self.temporary.unlink(missing_ok=True)


class LineFile:
    """Open file to which whole lines are appended; after one that cannot be written it ends with the one before."""

    def __init__(self, path: Path, file: int | None = None, end: int = 0) -> None:
        """Append to an open `file` after its first `end` bytes; by default make a new one at `path`.

        Raises:
            InputError: if it cannot be made.
        """
        self.path, self._end = path, end
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o666) if file is None else file
        except OSError as error:
            raise unwritable(path, error) from error

    def append(self, line: bytes, *, sync: bool = False) -> None:
        """Write a line, and with `sync` wait until it is on the disk.

        Raises:
            InputError: if it cannot be written; the lines before stay.
        """
        line += b"\n"
        try:
            left = memoryview(line)
            while left:
                left = left[os.write(self._file, left) :]
            if sync:
                os.fsync(self._file)
        except OSError as error:
            self._truncate()
            raise unwritable(self.path, error) from error
        self._end += len(line)

    def sync(self) -> None:
        """Wait until all lines are on the disk.

        Raises:
            InputError: if that is not possible.
        """
        try:
            os.fsync(self._file)
        except OSError as error:
            raise unwritable(self.path, error) from error

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _truncate(self) -> None:
        with suppress(OSError):  # the line stays incomplete, which reading allows
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)


def unwritable(path: Path, error: OSError) -> InputError:
    """The error for a file that cannot be written."""
    return InputError.of(str(path), f"cannot be written: {error.strerror}", EXPECTED, Code.UNWRITABLE)


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
        except InputError as error:  # of a file in it: the temporary folder is gone when the message is read
            named = str(temporary), str(path)
            raise InputError(replace(d, file=d.file.replace(*named)) for d in error.diagnostics) from error
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
