"""Folder of matplotlib for users whose home cannot be written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

from kraft import matplotlib_folder
from kraft.matplotlib_folder import provide_folder


@pytest.fixture
def without_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Temporary folder of a user whose home cannot be made."""
    (tmp_path / "file").touch()
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path / f"kraft-{os.getuid()}" / "matplotlib"


def test_it_is_among_the_temporary_files_where_the_home_cannot_be_written(without_home: Path) -> None:
    provide_folder()
    assert os.environ["MPLCONFIGDIR"] == str(without_home)


@pytest.mark.parametrize("name", ["XDG_CONFIG_HOME", "XDG_CACHE_HOME"])
def test_it_needs_both_of_matplotlibs_folders(
    without_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.setenv(name, str(tmp_path / "xdg"))
    provide_folder()
    assert os.environ["MPLCONFIGDIR"] == str(without_home)


def test_the_users_own_stays(without_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLCONFIGDIR", "/mine")
    provide_folder()
    assert os.environ["MPLCONFIGDIR"] == "/mine"


def test_a_home_that_can_be_written_is_matplotlibs_choice(
    without_home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    provide_folder()
    assert "MPLCONFIGDIR" not in os.environ


def test_a_folder_that_another_user_has_made_is_not_used(without_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matplotlib_folder, "is_of_another", lambda root: root == without_home.parent)
    provide_folder()
    assert "MPLCONFIGDIR" not in os.environ


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
@pytest.mark.parametrize("module", ["kraft.plot.style", "kraft.video.overlay"])
def test_matplotlib_says_nothing_without_a_home(tmp_path: Path, module: str) -> None:
    kept = {name: text for name, text in os.environ.items() if name != "MPLCONFIGDIR" and not name.startswith("XDG_")}
    environment = {**kept, "HOME": "/proc/nobody", "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", f"import {module}"], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert [folder.name for folder in tmp_path.iterdir()] == [f"kraft-{os.getuid()}"]
