"""The warning of a start that is nearer to an obstacle than poses are exact."""

from __future__ import annotations

from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario
from kraft.trial.warnings import near_start
from kraft_cli.main import main

SCENE = """
name: near
bounds: {{x: [0, 5], y: [0, 4]}}
obstacles: [{{name: shelf, box: {{center: [1.5, {y}], size: [2.2, 0.4]}}}}]
start: {{x: 1.0, y: 1.0, heading_deg: 0}}
goal: {{center: [4.0, 3.0], radius: 0.3}}
"""


def scene(folder: Path, clearance: float) -> Path:
    """Scenario in which a MuSHR, starts at a clearance (m) from a shelf on its left."""
    path = folder / "near.yaml"
    task = load_scenario("turns").task()
    half = 0.5 * vehicle_of_task(task).footprint.width
    path.write_text(SCENE.format(y=1.0 + half + clearance + 0.2), encoding="utf-8")
    return path


@pytest.mark.parametrize(("clearance", "warned"), [(0.01, True), (0.028, True), (0.05, False), (0.1, False)])
def test_a_start_beside_an_obstacle_is_warned_of(
    tmp_path: Path, clearance: float, warned: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scene(tmp_path, clearance)
    task = load_scenario(path).task()
    found = near_start(task, vehicle_of_task(task))
    assert ("cm from 'shelf': " in found) == warned
    assert main(["validate", str(path)]) == 0
    assert ("the start is " in capsys.readouterr().err) == warned


@pytest.mark.parametrize("name", bundled.names("scenario"))
def test_no_bundled_scenario_starts_so_near(name: str) -> None:
    task = load_scenario(name).task()
    assert near_start(task, vehicle_of_task(task)) == ""
