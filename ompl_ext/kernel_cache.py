"""Folders of machine code: a cache that cannot become stale, and that a user who may only read it can use.

*Staleness.*  numba's key of a cached kernel is its own source file; a change of an inlined function goes unnoticed.
Here the cache folder's name is a hash over the sources of the whole package (and, for a vehicle's kernels, over the
vehicle's source): after any edit a new folder is used, and a stale kernel is impossible.  numba looks up a kernel by
the path of its source file, so every copy of the package has folders of its own, and every kind of processor too: its
machine code is another.

*Reading.*  A cache that this user may not write, as in the image of a container, is read.  What is missing there is
kept among the user's temporary files, in the folder of the same name.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import os
import pickle
import pickletools
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final, Self

import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
)
from numba.core.compiler_lock import global_compiler_lock

from ompl_ext.cache_error import CacheError
from ompl_ext.processor import processor
from ompl_ext.user_folders import below_home, is_of_another, may_write, temporary_root

_config: Any = numba.config  # numba's stubs lack it
_compiler_lock: Any = global_compiler_lock

WRITABLE: Final = "expected a writable folder with enough space in KRAFT_CACHE_DIR"
READABLE: Final = "expected files that this user may read, or another folder in KRAFT_CACHE_DIR"
REMOVE: Final = "delete this folder, and kraft compiles again"
DAMAGED: Final = (EOFError, pickle.UnpicklingError)
"""Errors of cached files that are empty, cut off or full of zeros, as after a loss of power."""


def cache_root() -> Path:
    """Folder that holds all compiled kernels: `$KRAFT_CACHE_DIR`, else the user's cache folder.

    If no home folder is writable (containers with a read-only home, services without one, `sudo` with the home of
    another user) and none has kernels that can be trusted, it is a folder of the user under the system's temporary
    directory, so that kernels are still compiled only once per machine.

    Raises:
        CacheError: there is none of these folders.
    """
    explicit = os.environ.get("KRAFT_CACHE_DIR")
    if explicit:
        return Path(explicit)
    base = below_home("XDG_CACHE_HOME", ".cache")
    if base is not None and (may_write(base / "kraft") or _is_trusted(base / "kraft")):
        return base / "kraft"
    temporary = temporary_root()
    if temporary is None:
        raise CacheError(base or Path("~/.cache"), "has no writable folder, nor one for temporary files", WRITABLE)
    return temporary


def _is_trusted(folder: Path) -> bool:
    """Whether a folder that this user may only read is root's or this user's: its code would be run."""
    return os.access(folder, os.R_OK | os.X_OK) and folder.stat().st_uid in (0, os.getuid())


@cache
def source_hash() -> str:
    """Hash over every source file of this package, the versions of numba and Python, and the processor."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]} {processor()}".encode())
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(vehicle_hash: str = "") -> Path:
    """Cache folder of the package's kernels, or of a vehicle's kernels if its hash is passed."""
    location = hashlib.sha256(str(Path(__file__).parent).encode()).hexdigest()[:8]
    return cache_root() / "kernels" / f"{source_hash()}-{location}" / (vehicle_hash or "core")


def layers(folder: Path) -> tuple[Path, ...]:
    """Folders where what is kept in `folder` is looked up; the last one takes what is compiled now.

    It is `folder` itself, and behind one that this user may only read its counterpart among the temporary files.
    """
    root = cache_root()
    if not folder.is_relative_to(root) or not os.path.isdir(root) or may_write(folder):
        return (folder,)
    temporary = temporary_root()
    return (folder,) if temporary in (None, root) else (folder, temporary / folder.relative_to(root))


@cache
def note_use(folder: Path) -> None:
    """Note, once in a process, that a folder of kernels is used, so that nobody takes it for an old one.

    A folder that this user may only read stays as it is: this user cannot remove it either.
    """
    with suppress(OSError):
        os.utime(folder)


def is_marked(marker: Path) -> bool:
    """Whether `mark` was called, in this process or another."""
    return any((layer / marker.name).exists() for layer in layers(marker.parent))


def mark(marker: Path) -> None:
    """Make an empty file that says that something is compiled, unless it is there."""
    if not is_marked(marker):
        folder = layers(marker.parent)[-1]
        check_cache(folder)
        (folder / marker.name).touch()


def where_kept() -> str:
    """Folder that takes what is compiled now; if it is not the one of all kernels, with the reason."""
    first, last = (layer.parents[2] for layer in (cache_folder(), layers(cache_folder())[-1]))
    return str(last) if last == first else f"{last}, because {first} cannot be written"


def check_cache(folder: Path) -> None:
    """Make a cache folder and check that it is writable, and that nobody else has made the one for temporary files.

    Raises:
        CacheError: the folder is not writable, or another user could put code into it.
    """
    check_owner(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from None


def check_owner(folder: Path) -> None:
    """Check that a folder of the cache is this user's where every user may make files, among the temporary ones.

    Raises:
        CacheError: another user has made its folder, and could put code into it.
    """
    root = temporary_root()
    if root is not None and folder.is_relative_to(root) and is_of_another(root):
        raise CacheError(root, "belongs to another user, whose code would be run", WRITABLE)


def check_files() -> int:
    """Number of files with kernels of this package, in all layers, each of which is whole.

    Raises:
        CacheError: a file is empty, cut off or full of zeros, cannot be read, or is of another user.
    """
    count = 0
    for layer in layers(cache_folder().parent):
        check_owner(layer)
        for file in sorted(path for suffix in ("nbi", "nbc") for path in layer.rglob(f"*.{suffix}")):
            try:
                _check_whole(file.read_bytes())
            except FileNotFoundError:  # another process has just removed it
                continue
            except OSError as error:
                raise CacheError(file, f"cannot be read: {error.strerror or error}", READABLE) from error
            except DAMAGED as error:
                raise CacheError(layer, f"has damaged files: {file.name}: {error}", REMOVE) from error
            count += 1
    return count


def _check_whole(content: bytes) -> None:
    """Check that pickles end with their content, without making what is in them: a file has one or two."""
    stream = io.BytesIO(content)
    try:
        while True:
            for _ in pickletools.genops(stream):
                pass
            if stream.tell() == len(content):
                return
    except ValueError as error:
        raise pickle.UnpicklingError(str(error)) from error


class KernelCache(FunctionCache):
    """Machine code of one function, kept in `folder` for each signature."""

    folder: Path

    @classmethod
    def of(cls, function: Callable[..., object], folder: Path) -> Self:
        """Cache of a function in `folder`, which is made when something is compiled."""
        with _compiler_lock:  # other threads wait
            before = _config.CACHE_DIR
            _config.CACHE_DIR = str(folder)  # read once, by the constructor
            try:
                cached = cls(function)
            finally:
                _config.CACHE_DIR = before
        files: Any = _Files(function, folder, cached._impl)
        cached.folder, cached._cache_file = folder, files
        return cached


class _Locator(UserProvidedCacheLocator):
    """Place of the machine code of a function."""

    def ensure_cache_path(self) -> None:
        """Make nothing: a cache that is only read need not be writable."""


class _Contents(CompileResultCacheImpl):
    """Content of the files, for numba's machine code."""


_Contents._locator_classes = [_Locator]
KernelCache._impl_class = _Contents
_subfolder: Any = _Locator.get_suitable_cache_subpath  # numba's stubs have no types of these
_files: Any = IndexDataCacheFile


class _Files:
    """Files of one function in all layers of a folder, in place of numba's, which are in one folder."""

    def __init__(self, function: Callable[..., object], folder: Path, contents: CompileResultCacheImpl) -> None:
        self._folder = folder
        self._subfolder = _subfolder(inspect.getfile(function))
        self._name, self._stamp = contents.filename_base, contents.locator.get_source_stamp()

    def load(self, key: object) -> Any:
        """Content for a key; None if it is to be compiled, and can be kept then.

        Raises:
            CacheError: files are damaged, cannot be read, or the content that is to be compiled cannot be kept.
        """
        for layer in layers(self._folder):
            check_owner(layer)
            try:
                content = self._in(layer).load(key)
                if content is not None:
                    note_use(layer.parent)
            except DAMAGED as error:
                raise _damaged(layer, self._folder, error) from error
            except OSError as error:
                raise CacheError(layer, f"cannot be read: {error.strerror or error}", READABLE) from error
            if content is not None:
                return content
        check_cache(layers(self._folder)[-1])
        return None

    def save(self, key: object, content: Any) -> None:
        """Keep the content for a key.

        Raises:
            CacheError: it cannot be written.
        """
        layer = layers(self._folder)[-1]
        try:
            (layer / self._subfolder).mkdir(parents=True, exist_ok=True)
            self._in(layer).save(key, content)
        except OSError as error:
            raise _unwritable(layer, error) from error

    def _in(self, layer: Path) -> Any:
        return _files(str(layer / self._subfolder), self._name, self._stamp)


def _damaged(layer: Path, folder: Path, error: Exception) -> CacheError:
    core = layers(cache_folder())[-1] if layer != folder else cache_folder()
    return CacheError(core.parent, f"has damaged files: {error}", REMOVE)


def _unwritable(folder: Path, error: OSError) -> CacheError:
    return CacheError(folder, f"cannot be written: {error.strerror or error}", WRITABLE)
