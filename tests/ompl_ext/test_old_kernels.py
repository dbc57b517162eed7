"""Kernels of other versions of kraft or other processors: what is found, and what is removed."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path

import pytest

from ompl_ext.kernel_cache import cache_folder, note_use
from ompl_ext.old_kernels import DAY, REMOVED, old_kernels, remove

OLD, RECENT = f"{'a' * 16}-{'0' * 8}", f"{'b' * 16}-{'0' * 8}"


def kernels(parent: Path, name: str, days: float) -> Path:
    """A folder of kernels with one file of 1000 bytes that was last used so many days ago."""
    folder = parent / name
    (folder / "core").mkdir(parents=True)
    (folder / "core" / "tree.nbc").write_bytes(bytes(1000))
    for path in (folder / "core" / "tree.nbc", folder / "core", folder):
        os.utime(path, (time.time() - days * DAY,) * 2)
    return folder


@pytest.fixture
def parent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Folder of a cache with the kernels of this version, of two others, and what is none of kraft's business."""
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(tmp_path))
    own = cache_folder().parent
    kernels(own.parent, own.name, 100)
    kernels(own.parent, OLD, 40)
    kernels(own.parent, RECENT, 10)
    kernels(own.parent, "notes", 100)
    (own.parent / f"{'c' * 16}-{'0' * 8}").symlink_to(tmp_path)
    return own.parent


def test_kernels_of_other_versions_are_found_with_their_size_and_last_use(parent: Path) -> None:
    found = old_kernels()
    assert [(each.folder.name, each.size) for each in found] == [(OLD, 1000), (RECENT, 1000)]
    assert [each.is_unused(30) for each in found] == [True, False]
    assert found[0].is_unused(39)
    assert not found[0].is_unused(41)


def test_unused_kernels_are_removed_and_nothing_else(parent: Path) -> None:
    before = {path.name for path in parent.iterdir()}
    assert [each.folder.name for each in remove(old_kernels(), 30)] == [OLD]
    assert {path.name for path in parent.iterdir()} == before - {OLD}
    assert (cache_folder() / "tree.nbc").is_file()


def test_kernels_that_are_used_meanwhile_stay(parent: Path) -> None:
    found = old_kernels()
    note_use(parent / OLD)
    assert remove(found, 30) == []
    assert (parent / OLD / "core" / "tree.nbc").is_file()


def test_two_processes_may_remove_the_same_kernels(parent: Path) -> None:
    found = old_kernels()
    assert len(remove(found, 30)) == 1
    assert remove(found, 30) == []


def test_what_an_interrupted_removal_left_is_removed(parent: Path) -> None:
    left = kernels(parent, f"{REMOVED}{OLD}-17", 40)
    assert left in [each.folder for each in remove(old_kernels(), 30)]
    assert not left.exists()


def test_a_cache_that_is_not_there_has_no_old_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(tmp_path / "new"))
    assert old_kernels() == []
    assert list(tmp_path.iterdir()) == []


def test_a_cache_that_may_only_be_read_stays_as_it_is(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Path, _: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "rename", refused)
    assert remove(old_kernels(), 30) == []
    assert (parent / OLD / "core" / "tree.nbc").is_file()
