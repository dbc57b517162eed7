"""Every example runs as its first lines say, and prints what it is for."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT
from support.recorded import recorded_logs

from kraft_cli.main import main

EXAMPLES = {
    "01_plan.py": "exact",
    "02_drive.py": "success after",
    "03_compare.py": "| KRAFT |",
    "04_identify.py": "plan with it",
    "06_ompl.py": "RRT",
    "08_equal_terms.py": "KRAFT, mushr-drive",
}


def run(example: str, folder: Path, *arguments: str) -> str:
    command = [sys.executable, str(ROOT / "examples" / example), *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_runs(example: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    arguments = []
    if example == "04_identify.py":
        shutil.copytree(recorded_logs(tmp_path_factory), tmp_path / "logs")
        arguments = ["logs"]
    if example == "08_equal_terms.py":
        arguments = ["slip", "--trials", "1"]
    assert EXAMPLES[example] in run(example, tmp_path, *arguments)


def test_the_vehicle_of_the_example_plans(capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = f"{ROOT / 'examples' / '05_vehicle.py'}:VEHICLE"
    assert main(["plan", "turns", "--vehicle", vehicle, "--iterations", "2000"]) == 0
    assert "skid-steer" in capsys.readouterr().out


def test_every_numbered_example_is_run() -> None:
    numbered = {path.name for path in (ROOT / "examples").glob("[0-9]*.py")}
    assert numbered == {*EXAMPLES, "05_vehicle.py", "07_bundled_vehicles.py"}  # the last: test_example_identify.py
