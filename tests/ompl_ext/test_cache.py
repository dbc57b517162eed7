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

import pytest
from numba import types
from numba.core.caching import IndexDataCacheFile

from ompl_ext import jit
from ompl_ext.cache_error import CacheError
from ompl_ext.jit import cache_folder, cache_root, check_cache, check_owner, compiled

NUMBER = types.float64(types.float64)


def double(x: float) -> float:
    """Function to compile."""
    return 2.0 * x


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
    monkeypatch.setattr(jit, "_may_write", lambda folder: False)
    check_cache(cache_folder())
    lstat = Path.lstat
    monkeypatch.setattr(
        Path, "lstat", lambda p: SimpleNamespace(st_uid=os.getuid() + 1) if p == without_kraft_folder else lstat(p)
    )
    for check in (check_owner, partial(check_cache, cache_folder())):
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
