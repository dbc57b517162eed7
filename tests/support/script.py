"""Scripts of users, run in this process: a new one takes seconds to import what they need."""

from __future__ import annotations

import io
import runpy
from contextlib import redirect_stdout
from pathlib import Path

import pytest

import kraft


def output_of(script: Path, *arguments: str) -> str:
    """What a script prints when it is run with these arguments."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setattr("sys.argv", [str(script), *arguments])
        runpy.run_path(str(script), run_name="__main__")
    return out.getvalue()


def imported_by_a_worker(script: Path) -> None:
    """Import a script as a worker process does that an evaluation starts; fail if this evaluates again."""

    def evaluate(*_: object, **__: object) -> None:
        pytest.fail("a worker process would start an evaluation of its own")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kraft, "evaluate", evaluate)
        patch.setattr("sys.argv", [str(script)])
        runpy.run_path(str(script), run_name="__mp_main__")
