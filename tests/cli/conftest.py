"""Commands run in an empty working folder of their own; identifications that several tests look at."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path
from typing import Any

import pytest
from support.recorded import IDENTIFY, recorded_logs

from kraft_cli.main import main
from kraft_cli.terminal import Terminal


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_logs(tmp_path_factory)


@pytest.fixture
def logs(folder: Path, recorded: Path) -> None:
    """Copy of the recorded logs in the working folder."""
    shutil.copytree(recorded, folder / "logs")


@pytest.fixture(scope="session")
def plain(recorded: Path) -> dict[str, Any]:
    """What `IDENTIFY` prints with `--json`."""
    content: dict[str, Any] = json.loads(printed(recorded, (*IDENTIFY, "--json"))[0])
    return content


@pytest.fixture(scope="session")
def with_extras(recorded: Path) -> dict[str, Any]:
    """What `kraft sysid logs --json` prints."""
    content: dict[str, Any] = json.loads(printed(recorded, ("sysid", "logs", "--model", "mushr-lag", "--json"))[0])
    return content


@pytest.fixture(scope="session")
def tables(recorded: Path) -> tuple[str, str]:
    """Tables and messages of an identification without extra parameters."""
    return printed(recorded, IDENTIFY)


def printed(recorded: Path, arguments: Sequence[str]) -> tuple[str, str]:
    """What a command prints on stdout and stderr beside the recorded logs."""
    out, err = io.StringIO(), io.StringIO()
    with chdir(recorded.parent):
        assert main(arguments, Terminal(out, err)) == 0
    return out.getvalue(), err.getvalue()
