"""The page on Python names everything that `import kraft` offers, and its code runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.fake_trials import Inline
from support.paths import ROOT
from support.script import imported_by_a_worker, output_of

import kraft
from kraft.evaluation import evaluator

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_every_name_of_the_front_door_is_described() -> None:
    assert [name for name in kraft.__all__ if f"`{name}" not in PAGE] == []


def test_every_name_of_the_front_door_is_there() -> None:
    assert [name for name in kraft.__all__ if not hasattr(kraft, name)] == []


def test_importing_kraft_loads_none_of_the_heavy_packages() -> None:
    program = (
        "import sys, kraft; print(sorted({'numba', 'ompl', 'mujoco', 'gtsam', 'numpy', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def script_of(number: int, folder: Path) -> Path:
    """A block of the page as a script, with fewer trials."""
    script = folder / "block.py"
    script.write_text(
        BLOCKS[number]
        .replace("trials=10", "trials=1")
        .replace("trials=2", "trials=1")
        .replace('["turns", "slip"]', '["slip"]')
    )
    return script


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_code_on_the_page_runs(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the trials of evaluations in this process: test_examples.py starts workers from a script."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluator, "Processes", Inline)
    assert output_of(script_of(number, tmp_path))


def test_a_worker_process_that_imports_code_of_the_page_evaluates_nothing(tmp_path: Path) -> None:
    evaluating = [number for number, block in enumerate(BLOCKS) if "kraft.evaluate(" in block]
    assert len(evaluating) == 2
    for number in evaluating:
        imported_by_a_worker(script_of(number, tmp_path))
