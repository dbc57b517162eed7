"""What the documentation shows about vehicles and plans is what there is."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.paths import ROOT

from kraft.config import bundled
from kraft.planning.plan import plan_task
from kraft.planning.plan_file import Origin, plan_text
from kraft.planning.search import Budget
from kraft.scenario import load_scenario
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main

OMPL = (ROOT / "docs" / "ompl.md").read_text(encoding="utf-8")
VEHICLES = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
PLAN = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")


def test_the_vehicle_shown_is_the_example() -> None:
    block = VEHICLES.split("```python\n")[1].split("```")[0]
    vehicle, _, _ = (ROOT / "examples" / "05_vehicle.py").read_text().partition("\nif __name__ == ")
    assert vehicle.endswith(block)


@pytest.mark.parametrize("block", re.findall(r"```python\n(.*?)```", VEHICLES + OMPL, re.DOTALL))
def test_each_block_of_code_runs_by_itself(block: str) -> None:
    exec(block, {"__name__": "block"})


def test_the_vehicle_file_shown_is_that_of_mushr(tmp_path: Path) -> None:
    path = tmp_path / "mushr.yaml"
    path.write_text(VEHICLES.split("```yaml\n")[1].split("```")[0])
    shown, bundled = load_vehicle_config(path), load_vehicle_config("mushr")
    assert shown.values == pytest.approx(bundled.values, abs=1e-4)
    assert (shown.model, shown.footprint, shown.top_speed) == (bundled.model, bundled.footprint, bundled.top_speed)


def test_every_bundled_vehicle_is_described() -> None:
    for name in bundled.names("vehicle"):
        vehicle = load_vehicle(name)
        rows = [line for line in VEHICLES.splitlines() if line.startswith(f"| `{name}` |")]
        assert any(", ".join(vehicle.state) in row for row in rows)


def test_every_key_of_the_plan_file_is_described() -> None:
    task, vehicle = load_scenario("turns").task(), load_vehicle("mushr")
    result = plan_task(task, vehicle, Budget(iterations=200))
    content = json.loads(plan_text(task, vehicle, result, Origin("turns", "mushr")))
    described = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", PLAN, re.MULTILINE))))
    assert set(content) <= described


def test_every_option_of_kraft_plan_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--help"]) == 0
    options = set(re.findall(r"(?<![\w-])--[a-z]+", capsys.readouterr().out)) - {"--help"}
    assert options
    assert options <= set(re.findall(r"--[a-z]+", PLAN))


def test_the_result_shown_of_kraft_plan_has_the_rows_that_it_prints(capsys: pytest.CaptureFixture[str]) -> None:
    shown = PLAN.split("```console\n$ kraft plan turns\n")[1].split("```")[0]
    assert main(["plan", "turns", "--iterations", "200"]) == 0
    printed = capsys.readouterr().out
    assert re.findall(r"^[a-z ]+?(?=  )", shown, re.MULTILINE) == re.findall(r"^[a-z ]+?(?=  )", printed, re.MULTILINE)
