"""The page on Python names everything that `import kraft` offers, and its code runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

import kraft

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


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_code_on_the_page_runs(number: int, tmp_path: Path) -> None:
    script = tmp_path / "block.py"
    script.write_text(
        BLOCKS[number]
        .replace("trials=10", "trials=1")
        .replace("trials=2", "trials=1")
        .replace('["turns", "slip"]', '["slip"]')
    )
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
