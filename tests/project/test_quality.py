"""The checks that a reader would run by hand, as tests: style, types, import directions."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise

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


def _loose_strings(tree: ast.Module) -> Iterator[int]:
    """Lines of strings that follow no name which they could describe."""
    for parent in ast.walk(tree):
        body = getattr(parent, "body", None)
        for before, node in pairwise(body) if isinstance(body, list) else ():
            value = node.value if isinstance(node, ast.Expr) else None
            is_string = isinstance(value, ast.Constant) and isinstance(value.value, str)
            if is_string and not isinstance(before, ast.Assign | ast.AnnAssign):
                yield node.lineno


def test_every_string_below_a_name_describes_one() -> None:
    files = [path for room in ("kraft", "kraft_cli", "ompl_ext") for path in (ROOT / room).rglob("*.py")]
    loose = [
        f"{path.relative_to(ROOT)}:{line}" for path in files for line in _loose_strings(ast.parse(path.read_text()))
    ]
    assert loose == []
