"""Cache of compiled kernels: where it is, and what is said when its files are of no use."""

from __future__ import annotations

import errno
import os
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import pytest
from numba import types
from numba.core.caching import IndexDataCacheFile

from ompl_ext import kernel_cache
from ompl_ext.cache_error import CacheError
from ompl_ext.jit import compiled
from ompl_ext.kernel_cache import (
    cache_folder,
    cache_root,
    check_cache,
    check_files,
    check_owner,
    is_marked,
    mark,
    where_kept,
)

NUMBER = types.float64(types.float64)


def double(x: float) -> float:
    """Function to compile."""
    return 2.0 * x


def triple(x: float) -> float:
    """Function that the cache does not have."""
    return 3.0 * x


def with_signature(folder: Path) -> float:
    """Result of a kernel that is compiled at once."""
    return compiled(double, folder=folder, signature=NUMBER)(2.0)


def at_the_first_call(folder: Path) -> float:
    """Result of a kernel that is compiled when it is called."""
    return compiled(double, folder=folder)(2.0)


@pytest.fixture
def without_kraft_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Temporary folder of a user that has named no folder for the cache."""
    for name in ("KRAFT_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path / f"kraft-{os.getuid()}"


def test_a_user_without_a_home_has_the_cache_among_the_temporary_files(
    without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(uid: int) -> None:
        raise KeyError(uid)

    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert cache_root() == without_kraft_folder


def test_a_home_below_a_folder_that_is_closed_to_the_user_has_no_cache(
    without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    closed = tmp_path / "root"
    stat, access = os.stat, os.access

    def refused(path: Any, **options: Any) -> Any:  # the tests may run as root, to whom no folder is closed
        if closed in Path(path).parents:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, **options)

    closed.mkdir()
    monkeypatch.setattr("os.stat", refused)
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != closed and access(path, mode))
    monkeypatch.setenv("HOME", str(closed / "home"))
    assert cache_root() == without_kraft_folder


def test_code_that_another_user_may_have_put_among_the_temporary_files_is_not_run(
    without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "home").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "home" / "of nobody"))
    monkeypatch.setattr(kernel_cache, "may_write", lambda folder: False)
    check_cache(cache_folder())
    lstat = Path.lstat
    monkeypatch.setattr(
        Path, "lstat", lambda p: SimpleNamespace(st_uid=os.getuid() + 1) if p == without_kraft_folder else lstat(p)
    )
    for check in (partial(check_owner, cache_folder()), partial(check_cache, cache_folder())):
        with pytest.raises(CacheError, match=f"^{without_kraft_folder}: .*belongs to another user"):
            check()


@pytest.mark.parametrize("call", [with_signature, at_the_first_call])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"\0" * 100, pickle.dumps("0" * 100)[:50]], ids=["empty", "zeros", "cut off"])
def test_files_that_a_loss_of_power_has_damaged_are_reported_with_the_folder_to_delete(
    tmp_path: Path, call: Callable[[Path], float], suffix: str, content: bytes
) -> None:
    assert call(tmp_path) == 4.0
    for file in tmp_path.rglob(f"*.{suffix}"):
        file.write_bytes(content)
    with pytest.raises(CacheError, match=r"damaged files: .*; delete this folder") as caught:
        call(tmp_path)
    assert caught.value.folder == cache_folder().parent


@pytest.mark.parametrize("call", [with_signature, at_the_first_call])
def test_a_cache_on_a_full_disk_is_named(
    tmp_path: Path, call: Callable[[Path], float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    with pytest.raises(CacheError, match=rf"^{tmp_path}.*No space left on device; .*KRAFT_CACHE_DIR") as caught:
        call(tmp_path)
    assert caught.value.folder.is_relative_to(tmp_path)


@pytest.fixture
def read_only(without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Cache that this user may only read: that of `double` and a marker, as in the image of a container."""
    root = tmp_path / "image"
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(root))
    with_signature(cache_folder())
    mark(cache_folder() / "maps")
    may_write = kernel_cache.may_write
    monkeypatch.setattr(kernel_cache, "may_write", lambda p: not p.is_relative_to(root) and may_write(p))
    return root


def files_in(folder: Path) -> list[str]:
    return sorted(file.name.split("-")[0] for file in folder.rglob("*") if file.is_file())


def test_a_complete_cache_that_cannot_be_written_is_read_and_nothing_is_made(
    read_only: Path, without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IndexDataCacheFile, "save", lambda *_: pytest.fail("compiled"))
    assert with_signature(cache_folder()) == 4.0
    assert is_marked(cache_folder() / "maps")
    assert not without_kraft_folder.exists()


def test_without_a_place_for_temporary_files_too_it_is_read_and_a_compilation_names_it(
    read_only: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(**_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(kernel_cache, "temporary_root", lambda: None)
    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    assert with_signature(cache_folder()) == 4.0
    with pytest.raises(CacheError, match=rf"^{read_only}.*cannot be written: Read-only file system; .*KRAFT_CACHE_DIR"):
        compiled(triple, folder=cache_folder(), signature=NUMBER)


def test_what_is_missing_in_a_cache_that_cannot_be_written_is_kept_among_the_temporary_files(
    read_only: Path, without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files_in(read_only)
    assert compiled(triple, folder=cache_folder(), signature=NUMBER)(2.0) == 6.0
    mark(cache_folder() / "heading")
    assert files_in(read_only) == before
    assert files_in(without_kraft_folder) == ["heading", "test_cache.triple", "test_cache.triple"]
    assert is_marked(cache_folder() / "heading")
    assert where_kept() == f"{without_kraft_folder}, because {read_only} cannot be written"
    monkeypatch.setattr(IndexDataCacheFile, "save", lambda *_: pytest.fail("compiled"))
    assert compiled(triple, folder=cache_folder(), signature=NUMBER)(2.0) == 6.0
    assert check_files() == 4


def test_the_folder_of_what_is_compiled_is_named_alone_where_it_is_the_cache(without_kraft_folder: Path) -> None:
    assert where_kept() == str(cache_root())


@pytest.mark.parametrize(("owner", "trusted"), [(0, True), (os.getuid(), True), (os.getuid() + 1, False)])
def test_the_cache_of_a_home_that_cannot_be_written_is_read_if_it_is_the_users_or_roots(
    without_kraft_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, owner: int, trusted: bool
) -> None:
    kraft = tmp_path / "cache" / "kraft"
    kraft.mkdir(parents=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(kraft.parent))
    monkeypatch.setattr(kernel_cache, "may_write", lambda folder: False)
    stat = Path.stat
    monkeypatch.setattr(Path, "stat", lambda p, **o: SimpleNamespace(st_uid=owner) if p == kraft else stat(p, **o))
    assert cache_root() == (kraft if trusted else without_kraft_folder)


def test_a_file_that_this_user_may_not_read_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(IndexDataCacheFile, "load", refused)
    with pytest.raises(CacheError, match=rf"^{tmp_path}: the kernel cache cannot be read: Permission denied; "):
        with_signature(tmp_path)


def test_every_kind_of_processor_has_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def folder() -> Path:
        kernel_cache.source_hash.cache_clear()
        return cache_folder()

    here = folder()
    monkeypatch.setattr(numba.config, "CPU_NAME", "another")
    other = folder()
    monkeypatch.undo()
    assert other != here == folder()


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"\0" * 100, "cut off"], ids=["empty", "zeros", "cut off"])
def test_damaged_files_are_found_without_a_kernel_that_needs_them(
    read_only: Path, suffix: str, content: bytes | str
) -> None:
    assert check_files() == 2
    (file,) = read_only.rglob(f"*.{suffix}")
    file.write_bytes(content if isinstance(content, bytes) else file.read_bytes()[:-20])
    with pytest.raises(CacheError, match=r"damaged files: test_cache\.double-.*; delete this folder") as caught:
        check_files()
    assert caught.value.folder == cache_folder().parent
