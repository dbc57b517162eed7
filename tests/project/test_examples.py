"""Every example runs as its first lines say, and prints what it is for."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.fake_trials import Inline
from support.paths import ROOT
from support.recorded import recorded_logs
from support.script import imported_by_a_worker, output_of

from kraft.evaluation import evaluator
from kraft_cli.main import main

EXAMPLES = {
    "01_plan.py": "exact",
    "02_drive.py": "success after",
    "04_identify.py": "plan with it",
    "06_ompl.py": "RRT",
    "08_equal_terms.py": "KRAFT, mushr-drive",
}


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_runs(
    example: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = []
    if example == "04_identify.py":
        arguments = [str(recorded_logs(tmp_path_factory))]
    if example == "08_equal_terms.py":
        monkeypatch.setattr(evaluator, "Processes", Inline)
        text = (ROOT / "scenarios" / "slip.yaml").read_text(encoding="utf-8")
        assert text.count("timeout: 60, oneshot_timeout: 30") == 1
        Path("slip.yaml").write_text(text.replace("timeout: 60, oneshot_timeout: 30", "timeout: 1, oneshot_timeout: 1"))
        arguments = ["slip.yaml", "--trials", "1"]
    assert EXAMPLES[example] in output_of(ROOT / "examples" / example, *arguments)


@pytest.mark.parametrize(
    ("example", "trials", "printed"),
    [("03_compare.py", 3, "| KRAFT |"), ("09_controller.py", 2, "pure-pursuit: 1 of 1 in ")],
)
def test_an_example_that_evaluates_runs_in_a_process_of_its_own_with_a_worker(
    example: str, trials: int, printed: str, tmp_path: Path
) -> None:
    text = (ROOT / "examples" / example).read_text(encoding="utf-8")
    assert text.count(f"trials={trials}") == 1
    (tmp_path / "compare.py").write_text(text.replace(f"trials={trials}", "trials=1, jobs=1"))
    done = subprocess.run([sys.executable, "compare.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout


@pytest.mark.parametrize("example", ["03_compare.py", "08_equal_terms.py", "09_controller.py"])
def test_a_worker_process_that_imports_an_example_evaluates_nothing(example: str) -> None:
    imported_by_a_worker(ROOT / "examples" / example)


def test_the_vehicle_of_the_example_plans(capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = f"{ROOT / 'examples' / '05_vehicle.py'}:VEHICLE"
    assert main(["plan", "turns", "--vehicle", vehicle, "--iterations", "2000"]) == 0
    assert "skid-steer" in capsys.readouterr().out


def test_the_vehicle_of_the_example_says_how_it_is_used() -> None:
    assert "kraft plan turns --vehicle " in output_of(ROOT / "examples" / "05_vehicle.py")


def test_a_bag_that_does_not_exist_is_one_line() -> None:
    command = [sys.executable, str(ROOT / "examples" / "draw_bag.py"), "nothere.mcap", "x.png", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"expected a bag that exists, .*\n", done.stderr)


def test_every_numbered_example_is_run() -> None:
    numbered = {path.name for path in (ROOT / "examples").glob("[0-9]*.py")}
    others = {
        "03_compare.py",
        "05_vehicle.py",
        "07_bundled_vehicles.py",
        "09_controller.py",
    }  # the last: test_example_identify.py
    assert numbered == {*EXAMPLES, *others}
