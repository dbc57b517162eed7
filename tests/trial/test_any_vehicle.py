"""Trials of vehicles that are no MuSHR, on the same code path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from kraft.driving.method import load_method
from kraft.scenario import load_scenario
from kraft.trial.planning_vehicle import other_robot, uncorrected_slope, vehicle_reference
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main
from ompl_ext.vehicle import Footprint

SCENE = """name: short
bounds: {x: [0, 7], y: [0, 5]}
obstacles:
  - {name: pillar, box: {center: [3, 2.6], size: [0.5, 0.5]}}
start: {x: 1, y: 1.2, heading_deg: 0}
goal: {center: [5.5, 1.2], radius: 0.5}
sensing: {preset: planar, camera: [3, 2, 6]}
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "short.yaml").write_text(SCENE)
    return tmp_path / "short.yaml"


@pytest.mark.parametrize("method", ["adaptive-kraft", "filtered-kraft", "kraft", "oracle", "oneshot-geometric"])
def test_a_robot_with_accelerations_as_controls_reaches_the_goal_with_any_estimator(scene: Path, method: str) -> None:
    result = run_trial(TrialSpec.load(scene, method, "unicycle2", 1))
    assert result.outcome is Outcome.SUCCESS
    assert result.min_clearance > 0.05
    assert result.measures.deviation_quantiles((0.9,))[-1][1] < 0.12


@pytest.mark.parametrize("vehicle", ["jackal", "f1tenth"])
def test_the_bundled_fast_robots_reach_the_goal(scene: Path, vehicle: str) -> None:
    result = run_trial(TrialSpec.load(scene, "filtered-kraft", vehicle, 0))
    assert result.outcome is Outcome.SUCCESS
    assert max(step.speed for step in result.steps) > 1.0


def test_a_trial_of_a_noisy_model_repeats_and_depends_on_the_seed(scene: Path) -> None:
    settings = {"truth.process_noise": {"theta": 0.05, "v": 0.05}, "truth.parameters": {"a_max": 0.8}}
    first, again, other = (
        run_trial(TrialSpec.load(scene, "filtered-kraft", "unicycle2", seed, settings)) for seed in (2, 2, 3)
    )
    assert [step.pose for step in first.steps] == [step.pose for step in again.steps]
    assert [step.pose for step in first.steps] != [step.pose for step in other.steps]


def test_a_method_plans_with_its_own_model_if_that_is_one_of_the_scenes_robot() -> None:
    kraft = load_method("kraft")
    found = {name: vehicle_reference(load_scenario(name), kraft) for name in ("turns", "track", "posts")}
    assert found == {"turns": "mushr-drive", "track": "f1tenth", "posts": "jackal"}
    assert vehicle_reference(load_scenario("track"), kraft, "mushr") == "mushr"


def test_the_result_says_which_controller_drove(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(scene), "--vehicle", "unicycle2", "--method", "kraft"]) == 0
    assert "lqr, because kinodynamic is a law for cars" in " ".join(capsys.readouterr().out.split())
    assert main(["run", str(scene), "--method", "kraft"]) == 0
    assert "lqr" not in capsys.readouterr().out


def test_a_drawing_of_a_run_has_the_vehicles_own_controls(scene: Path, tmp_path: Path) -> None:
    picture = tmp_path / "run.svg"
    assert main(["run", str(scene), "--vehicle", "unicycle2", "--plot", str(picture)]) == 0
    assert picture.stat().st_size > 10_000


def test_a_vehicle_without_a_speed_is_refused_before_anything_is_compiled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "turns", "--vehicle", "kraft.vehicles.dynobench:UNICYCLE1_V0", "--method", "kraft"]) == 2
    assert "expected a state with x, y, theta and a speed" in capsys.readouterr().err


def test_what_cannot_be_true_of_a_row_is_said() -> None:
    method, slope = load_method("adaptive-kraft"), load_scenario("slope")
    assert uncorrected_slope(slope, method, load_vehicle("mushr-force")) == ""
    assert "gravity_share" in uncorrected_slope(slope, method, load_vehicle("mushr-drive"))
    assert uncorrected_slope(slope, load_method("kraft"), load_vehicle("mushr-drive")) == ""
    assert uncorrected_slope(load_scenario("turns"), method, load_vehicle("mushr-drive")) == ""
    truck = replace(load_vehicle("mushr-drive"), footprint=Footprint(2.0, 0.8), file="", name="truck")
    assert "the true robot is the MuSHR" in other_robot(slope, truck)
    fast = replace(load_vehicle("mushr-drive"), top_speed=3.0, file="", name="fast")
    assert "top speed 0.71 m/s" in other_robot(slope, fast)
    for name in ("mushr", "mushr-drive", "f1tenth", "jackal", "unicycle2"):
        assert other_robot(slope, load_vehicle(name)) == ""


def test_a_true_car_that_reaches_beyond_the_footprint_is_said() -> None:
    van = load_scenario("turns", {"truth.car": {"length": 2.2, "width": 1.2}})
    assert "reaches up to 0.9 m beyond it" in other_robot(van, load_vehicle("mushr"))
    long = load_scenario("turns", {"truth.car": {"length": 0.6}})
    assert "(0.6 m x 0.27 m) is not covered by the footprint of mushr-drive" in other_robot(
        long, load_vehicle("mushr-drive")
    )
    covered = replace(load_vehicle("mushr-drive"), footprint=Footprint(2.2, 1.2), file="", name="van")
    assert other_robot(van, covered) == ""
    for name in ("mushr", "mushr-drive"):
        assert other_robot(load_scenario("turns", {"truth.car": {"mass": 5.0}}), load_vehicle(name)) == ""
