"""Bundled scenarios say what the paper's scenes are, and loading gives plain geometry in metres and radians."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import pickle
from pathlib import Path
from typing import Any

import pytest
from support.diagnostics import raised

from kraft.config import bundled
from kraft.errors import Code, InputError
from kraft.scenario import (
    Bounds,
    Box,
    Circle,
    Goal,
    Polygon,
    Scenario,
    Start,
    Task,
    Truth,
    load_scenario,
    parse_scenario,
)
from kraft.scenario.planning import DEFAULT_ITERATIONS, Planning
from kraft.scenario.schema import CAMERA_HEIGHT
from kraft_cli.work import json_schema

PAPER = ("boxes", "boxes-real", "bump", "movable", "slip", "slope", "turns", "turns-real")
TURNS = {((0.5, 1.5), (1.0, 1.0)), ((1.5, 3.5), (1.0, 1.0))}
BOXES = {((x, y), (0.4, 0.3)) for x, y in ((1.0, 1.0), (0.5, 2.5), (1.5, 2.5), (1.0, 4.0))}
INSIDE = {
    "turns": TURNS,
    "turns-real": TURNS,
    "bump": TURNS,
    "slope": TURNS,
    "boxes": BOXES,
    "boxes-real": BOXES,
    "slip": {((1.6, 4.0), (1.0, 1.0)), ((0.4, 1.2), (1.0, 1.0))},
    "movable": {((0.5, 2.0), (1.0, 1.0))},
}


HALLS = ("training", "training-real")
SCENES = (*PAPER, *HALLS, "parking", "posts", "track")


def test_the_scenes_of_the_paper_the_training_halls_parking_and_those_of_fast_robots_are_bundled() -> None:
    assert bundled.names("scenario") == tuple(sorted(SCENES))


@pytest.mark.parametrize("name", PAPER)
def test_a_scene_has_the_papers_geometry(name: str) -> None:
    scene = load_scenario(name)
    boxes = [o for o in scene.obstacles if isinstance(o, Box)]
    walls = [b for b in boxes if b.name is not None and "wall" in b.name]
    assert scene.name == name
    assert {(b.center, b.size) for b in boxes if b not in walls} == INSIDE[name]
    assert {(b.center, min(b.size)) for b in walls} == {
        ((-0.25, 2.5), 0.1),
        ((2.25, 2.5), 0.1),
        ((1.0, -1.0), 0.1),
        ((1.0, 6.0), 0.1),
    }
    assert all(b.height == 0.2 and b.yaw == 0 for b in boxes)
    assert scene.bounds == Bounds(x=(-0.25, 2.25), y=(-1.0, 6.0))
    assert scene.start == Start(1.0, -0.5, math.pi / 2, 0.0)
    assert scene.goal == Goal((1.0, 5.0), 0.25)
    assert (scene.trial.timeout, scene.trial.oneshot_timeout) == (60, 30)
    assert (scene.sensing.preset, scene.sensing.camera, scene.sensing.rate_hz) == (
        "single-tag",
        (1, 3, 5),
        30,
    )


@pytest.mark.parametrize("name", HALLS)
def test_a_training_hall_is_empty_but_for_its_walls_and_the_markers_height_is_known(name: str) -> None:
    scene = load_scenario(name)
    walls = [o for o in scene.obstacles if isinstance(o, Box)]
    assert len(walls) == len(scene.obstacles) == 4
    assert all(max(map(abs, w.center)) == 6 and max(w.size) == 12 for w in walls)
    assert scene.sensing.preset == "planar"


def test_a_camera_whose_place_is_not_given_is_above_the_middle_of_the_bounds() -> None:
    text = """name: room
bounds: {x: [0, 10], y: [-2, 12]}
start: {x: 1, y: 1, heading_deg: 0}
goal: {center: [8, 8], radius: 0.3}
"""
    for more in ("", "sensing: {rate_hz: 10}"):
        assert parse_scenario(text + more).sensing.camera == (5.0, 5.0, CAMERA_HEIGHT)
    given = parse_scenario(text + "sensing: {camera: [1, 2, 3]}")
    assert given.sensing.camera == (1.0, 2.0, 3.0)


def test_nothing_is_hidden_in_turns_boxes_and_the_training_hall() -> None:
    for name in ("turns", "boxes", "training"):
        assert load_scenario(name).truth == Truth()


def test_the_car_of_the_real_training_hall_is_that_of_the_real_scenes() -> None:
    hall = load_scenario("training-real")
    for name in ("turns-real", "boxes-real"):
        assert load_scenario(name).truth == hall.truth
    plain = load_scenario("training")
    assert (hall.obstacles, hall.bounds, hall.sensing) == (plain.obstacles, plain.bounds, plain.sensing)


def test_each_other_scene_hides_its_own_feature() -> None:
    assert all(0 < b.height <= 0.05 for b in load_scenario("bump").truth.speed_bumps)
    tilt = load_scenario("slope").truth.tilt
    assert tilt is not None
    assert (tilt.slope, tilt.uphill) == (0.125, math.pi / 2)
    (patch,) = load_scenario("slip").truth.friction_patches
    assert (patch.y, patch.friction) == ((0.4, 2.0), 0.08)
    movable = load_scenario("movable").truth.movable_boxes
    assert {b.center for b in movable} == {(1.75, 2.0), (1.25, 2.0), (1.75, 3.5), (1.5, 1.0)}
    assert all(b.size == (0.4, 0.4, 0.2) and b.mass == 1 for b in movable)
    for name in ("turns-real", "boxes-real"):
        scene = load_scenario(name)
        assert scene.truth.vehicle.drive_scale < 1
        assert scene.sensing.communication_delay > 0


def test_the_bumps_leave_no_way_around() -> None:
    scene = load_scenario("bump")
    beside_first, between, beside_second = scene.truth.speed_bumps
    spans = [(b.center[0] - b.size[0] / 2, b.center[0] + b.size[0] / 2) for b in scene.truth.speed_bumps]
    assert spans[0] == pytest.approx((1.0, 2.2))
    assert spans[1] == pytest.approx((-0.2, 2.2))
    assert spans[2] == pytest.approx((-0.2, 1.0))
    assert beside_first.center[1] < between.center[1] < beside_second.center[1]


@pytest.mark.parametrize("name", SCENES)
def test_a_bundled_scene_names_its_schema_for_editors(name: str) -> None:
    path = bundled.folder("scenario") / f"{name}.yaml"
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=scenario.schema.json"


def test_the_committed_schemas_are_up_to_date() -> None:
    for path, model in json_schema.files().items():
        assert path.read_text(encoding="utf-8") == json_schema.text(model), "run python -m kraft_cli.work.json_schema"
        assert json.loads(path.read_text(encoding="utf-8"))["additionalProperties"] is False


def test_every_key_of_the_schema_is_described_in_one_line_for_messages() -> None:
    for path in json_schema.files():
        schema = json.loads(path.read_text(encoding="utf-8"))
        for name, definition in {**schema["$defs"], path.stem: schema}.items():
            for key, content in definition.get("properties", {}).items():
                assert content.get("description"), f"{name}.{key}"
                assert "$ref" in content or "\n" not in content["description"], f"{name}.{key}"


FULL = """
name: full
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {name: crate, box: {center: [1, 1], size: [1, 0.5], yaw_deg: 90, height: 0.3}}
  - circle: {center: [3, 1], radius: 0.5}
  - polygon: {vertices: [[0, 3], [0, 4], [1, 4], [0.4, 3.6]]}
start: {x: 2, y: 2, heading_deg: 180, speed: 0.2}
goal: {center: [3, 3], radius: 0.5, heading_deg: 45, heading_tolerance_deg: 10}
vehicle: my_robots.car:CAR
planning: {time: 0.5, safety: {delta: 0.05, delta_per_speed: 0.25}}
"""


def test_a_file_becomes_plain_geometry_in_radians() -> None:
    scene = parse_scenario(FULL)
    box, circle, polygon = scene.obstacles
    assert box == Box((1, 1), (1, 0.5), math.pi / 2, 0.3, "crate")
    assert circle == Circle((3, 1), 0.5)
    assert polygon == Polygon(((0.4, 3.6), (1, 4), (0, 4), (0, 3)))
    assert scene.start == Start(2, 2, math.pi, 0.2)
    assert scene.goal == Goal((3, 3), 0.5, math.radians(45), math.radians(10))
    assert scene.vehicle == "my_robots.car:CAR"


def test_corners_of_a_box_turn_with_it_and_run_counter_clockwise() -> None:
    corners = Box((1, 1), (2, 1), math.pi / 2).corners
    assert [tuple(round(c, 9) for c in q) for q in corners] == [(0.5, 2), (0.5, 0), (1.5, 0), (1.5, 2)]


def test_the_planners_budget_is_iterations_unless_a_time_is_given() -> None:
    assert Planning().iteration_budget == DEFAULT_ITERATIONS
    assert Planning(iterations=7).iteration_budget == 7
    assert parse_scenario(FULL).planning.iteration_budget is None


def test_another_budget_replaces_the_old_one_whichever_it_was() -> None:
    planning = Planning(iterations=7, blossom=3).with_budget(time=0.5)
    assert (planning.iterations, planning.time, planning.blossom) == (None, 0.5, 3)
    assert planning.with_budget(iterations=9) == Planning(iterations=9, blossom=3)


@pytest.mark.parametrize(
    ("budget", "expected"),
    [
        ({"iterations": 0}, ("iterations", Code.VALUE)),
        ({"time": -1.0}, ("time", Code.VALUE)),
        ({"time": math.nan}, ("time", Code.VALUE)),
        ({"time": math.inf}, ("time", Code.VALUE)),
        ({"time": 1.0, "iterations": 1}, ("time", Code.CONFLICT)),
    ],
)
def test_a_budget_that_is_none_is_refused_by_its_argument(budget: dict[str, Any], expected: tuple[str, Code]) -> None:
    (problem,) = raised(lambda: Planning().with_budget(**budget))
    assert (problem.file, problem.code) == expected
    assert problem.argument


def test_a_task_has_no_truth() -> None:
    task = load_scenario("slope").task()
    assert type(task) is Task
    assert not {"truth", "sensing", "trial"} & {f.name for f in dataclasses.fields(task)}
    assert "0.125" not in repr(task)


def test_a_scenario_survives_pickling_and_keeps_its_places() -> None:
    scene = load_scenario("turns")
    again = pickle.loads(pickle.dumps(scene))
    assert again == scene == copy.deepcopy(scene)
    assert again.source.where("goal.center") == scene.source.where("goal.center") is not None


def test_a_scenario_built_in_code_has_no_places_and_says_so_without_failing() -> None:
    scene = Scenario(name="x", bounds=Bounds(x=(0, 1), y=(0, 1)), start=Start(0.5, 0.5, 0), goal=Goal((0.5, 0.5), 0.1))
    diagnostic = scene.source.diagnostic("start", "the start is in collision", "expected free space")
    assert str(diagnostic) == "<built in code>: start: the start is in collision; expected free space"


def test_a_later_check_can_point_into_the_file() -> None:
    scene = load_scenario("turns")
    line = str(scene.source.diagnostic("obstacles[4].box.size", "too large", "expected less"))
    assert line.startswith(f"{bundled.folder('scenario') / 'turns.yaml'}:")
    assert ": obstacles[4].box.size: too large; expected less" in line


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("turnz", "'turns'"),
        ("turns_real", "'turns-real'"),
        ("turn.yaml", "'turns.yaml'"),
        ("slop.yaml", "'slope'"),
        ("no/folder.yaml", "the path of a .yaml file or the name of a scenario"),
        ("a\0.yaml", "the path of a .yaml file or the name of a scenario"),
    ],
)
def test_a_missing_scenario_is_answered_with_the_nearest_one(
    given: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "turns.yaml").write_text(FULL)
    (problem,) = raised(lambda: load_scenario(given))
    assert (problem.file, problem.code) == (given, Code.NOT_FOUND)
    assert expected in problem.expected


def test_a_name_of_a_missing_scenario_too_long_for_a_file_is_still_an_input_error() -> None:
    with pytest.raises(InputError):
        load_scenario("x" * 5000 + ".yaml")


def test_a_bundled_name_wins_over_a_folder_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "turns").mkdir()
    assert load_scenario("turns").name == "turns"


def test_a_vehicle_file_is_found_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "car.yaml").write_text("name: car")
    (tmp_path / "scene.yaml").write_text(FULL.replace("my_robots.car:CAR", "car.yaml"))
    assert load_scenario(tmp_path / "scene.yaml").vehicle == str((tmp_path / "car.yaml").resolve())


def test_a_change_sets_what_it_names_from_then_on() -> None:
    second = {"time": 5, "floor_friction": 0.1, "vehicle": {"mass_scale": 1.5}}
    changes = [{"time": 2.5, "vehicle": {"drive_scale": 0.7, "steering_offset_deg": -4}}, second]
    truth = load_scenario("turns-real", {"truth.changes": changes}).truth
    own, first, last = truth.states
    assert (own.time, own.floor_friction, own.vehicle) == (0.0, truth.floor_friction, truth.vehicle)
    assert first.vehicle == truth.vehicle.model_copy(update={"drive_scale": 0.7, "steering_offset_deg": -4})
    assert (first.time, first.floor_friction) == (2.5, truth.floor_friction)
    assert last.vehicle == first.vehicle.model_copy(update={"mass_scale": 1.5})
    assert (last.time, last.floor_friction) == (5, 0.1)
    assert truth.in_words()[-2:] == (
        "from 2.5 s on a car with drive_scale 0.7, steering_offset_deg -4",
        "from 5 s on a floor with friction 0.1 and a car with mass_scale 1.5",
    )
    assert load_scenario("turns").truth.states == (load_scenario("turns").truth.states[0],)


def test_values_of_changes_are_set_by_their_keys() -> None:
    given = {"truth.changes": [{"time": 4.0, "floor_friction": 0.2}]}
    scene = load_scenario("turns", given)
    assert scene.truth.changes[0].time == 4.0
