"""Trials of vehicles that are no MuSHR, on the same code path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.paths import ROOT

from kraft.config.overrides import parse_overrides
from kraft.driving.method import load_method
from kraft.scenario import load_scenario
from kraft.simulation.car import PRESETS
from kraft.trial.planning_vehicle import other_robot, vehicle_reference
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.trial.warnings import uncorrected_slope
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.true_robot import CAR_SIZES
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


def test_a_bundled_model_never_replaces_a_vehicle_of_the_users_own(scene: Path, tmp_path: Path) -> None:
    text = (ROOT / "configs/vehicles/mushr-drive.yaml").read_text(encoding="utf-8")
    mine, theirs = tmp_path / "mine.yaml", tmp_path / "theirs.yaml"
    mine.write_text(text, encoding="utf-8")
    theirs.write_text(text, encoding="utf-8")
    own = load_scenario("turns", {"vehicle": str(mine)})
    assert vehicle_reference(own, load_method("kraft")) == str(mine)
    assert vehicle_reference(own, load_method("adaptive-kraft")) == str(mine)
    method = tmp_path / "method.yaml"
    method.write_text(f"name: mine\ntitle: Mine\nbase: kraft\nplanner: {{vehicle: {theirs}}}\n", encoding="utf-8")
    assert vehicle_reference(own, load_method(method)) == str(theirs)  # both are the user's own
    theirs.write_text(
        text.replace("{length: 0.44, width: 0.28, offset: -0.005}", "{length: 2.6, width: 1.1}"), encoding="utf-8"
    )
    assert vehicle_reference(own, load_method(method)) == str(mine)  # of another robot


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


def test_the_warning_of_the_mushr_says_where_another_robot_can_be_stated(tmp_path: Path) -> None:
    slope, known = load_scenario("slope"), load_vehicle("mushr-drive")
    truck = replace(known, footprint=Footprint(2.0, 0.8), file="", name="truck")
    of_code = other_robot(slope, truck)
    assert "nor truck, which is code and cannot, states another" in of_code
    assert (
        "in a vehicle file whose model is that code or in the scenario, there also with --set 'truth={...}'" in of_code
    )
    own = tmp_path / "truck.yaml"
    own.write_text(Path(known.file).read_text().replace("footprint:", "footprint: {length: 2.0, width: 0.8}  #", 1))
    of_file = other_robot(slope, load_vehicle(own))
    assert "nor the file of mushr-drive states another" in of_file
    assert "in the file of the vehicle or in the scenario, there also with --set 'truth={...}'" in of_file
    robot = of_code.split("such as truth: ")[1].split(", in a vehicle file")[0]
    assert other_robot(load_scenario("slope", parse_overrides([f"truth={robot}"], "set")), truck) == ""


def test_a_true_car_that_reaches_beyond_the_footprint_is_said() -> None:
    van = load_scenario("turns", {"truth.car": {"length": 2.2, "width": 1.2}})
    assert "reaches up to 0.9 m beyond it" in other_robot(van, load_vehicle("mushr"))
    long = load_scenario("turns", {"truth.car": {"length": 0.6}})
    assert "(0.6 m x 0.271 m) is not covered by the footprint of mushr-drive" in other_robot(
        long, load_vehicle("mushr-drive")
    )
    covered = replace(load_vehicle("mushr-drive"), footprint=Footprint(2.2, 1.2), file="", name="van")
    assert other_robot(van, covered) == ""
    for name in ("mushr", "mushr-drive"):
        assert other_robot(load_scenario("turns", {"truth.car": {"mass": 5.0}}), load_vehicle(name)) == ""


def test_the_wheels_of_a_true_car_count_as_its_body_does() -> None:
    long = load_scenario("turns", {"truth.car": {"wheelbase": 0.6}})
    assert "expected footprint: {length: 0.698, width: 0.271}" in other_robot(long, load_vehicle("mushr-drive"))
    wide = load_scenario("turns", {"truth.car": {"track": 0.5}})
    said = other_robot(wide, load_vehicle("mushr-drive"))
    assert "expected footprint: {length: 0.44, width: 0.541, offset: -0.005}" in said
    covered = replace(load_vehicle("mushr-drive"), footprint=Footprint(0.44, 0.541, -0.005), file="", name="wide")
    assert other_robot(wide, covered) == ""


def test_a_true_robot_of_any_kind_that_reaches_beyond_the_footprint_is_said(tmp_path: Path) -> None:
    text = Path(load_vehicle("jackal").file).with_name("jackal.xml").read_text()
    arm = '<geom name="arm" type="box" size="0.2 0.02 0.02" pos="0.4 0 0.02"/>'
    mast = '<geom name="mast" type="cylinder" size="0.02 0.2" pos="-0.5 0 0.7"/>'
    hull = '<geom name="hull"'
    (tmp_path / "arm.xml").write_text(text.replace(hull, arm + hull))
    (tmp_path / "mast.xml").write_text(text.replace(hull, mast + hull))
    jackal = load_vehicle("jackal")
    armed = load_scenario("posts", {"truth.mjcf": str(tmp_path / "arm.xml")})
    assert "expected footprint: {length: 0.856, width: 0.43, offset: 0.173}" in other_robot(armed, jackal)
    mjcf = {"truth.mjcf": str(tmp_path / "arm.xml")}
    assert other_robot(load_scenario("posts", {**mjcf, "truth.geoms": ["hull", "fenders"]}), jackal) == ""
    assert other_robot(load_scenario("posts", {"truth.mjcf": str(tmp_path / "mast.xml")}), jackal) == ""
    small = replace(jackal, footprint=Footprint(0.3, 0.3), file="", name="small")
    model = load_scenario("posts", {"truth.model": "jackal"})
    assert "expected footprint: {length: 0.51, width: 0.43}" in other_robot(model, small)


def test_the_stated_sizes_of_the_presets_are_those_of_their_designs() -> None:
    for preset, size in CAR_SIZES.items():
        outline = PRESETS[preset].outline
        assert (outline.length, outline.width) == pytest.approx(size, abs=0.002)
