"""The checks that a reader would run by hand, as tests: style, types, import directions."""

from __future__ import annotations

import subprocess
import sys

import pytest
from support.paths import ROOT


@pytest.mark.parametrize(
    "command",
    [
        ["ruff", "check"],
        ["ruff", "format", "--check"],
        ["mypy"],
        ["importlinter.cli", "lint"],
    ],
    ids=["ruff-check", "ruff-format", "mypy-strict", "import-directions"],
)
def test_the_tree_is_clean(command: list[str]) -> None:
    run = _lint_imports() if command[0].startswith("importlinter") else [sys.executable, "-m", *command]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def _lint_imports() -> list[str]:
    return [sys.executable, "-c", "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"]
