"""Overrides: keys of a file that are set elsewhere, with problems reported where they were set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.diagnostics import located, raised
from support.paths import ROOT

from kraft.config.overrides import Override, overridden, overrides_of, parse_overrides, parse_sweeps, value_text
from kraft.config.source import Place, Position
from kraft.config.yaml_reader import parse_document
from kraft.errors import Code
from kraft.scenario import Scenario, load_scenario
from kraft.scenario.loader import scenario_from


def with_settings(*texts: str, scenario: str = "movable") -> Scenario:
    return load_scenario(scenario, parse_overrides(texts, "set"))


def test_values_replace_those_of_the_file_and_missing_mappings_are_added() -> None:
    scene = with_settings(
        "sensing.noise_scale=2.5", "truth.vehicle.drive_scale=0.8", "truth.movable_boxes[1].mass=2",
        "truth.movable_boxes.2.mass=3", "goal={center: [1, 4], radius: 0.3}",
    )  # fmt: skip
    assert scene.sensing.noise_scale == 2.5
    assert scene.truth.vehicle.drive_scale == 0.8
    assert [box.mass for box in scene.truth.movable_boxes] == [1.0, 2.0, 3.0, 1.0]
    assert (scene.goal.center, scene.goal.radius) == ((1.0, 4.0), 0.3)
    assert load_scenario("movable").sensing.noise_scale == 1.0


def test_of_a_section_that_cannot_be_read_its_own_problem_alone_is_reported() -> None:
    text = (ROOT / "scenarios" / "turns.yaml").read_text(encoding="utf-8").replace("sensing: ", "sensing: !mine ")
    document = overridden(parse_document(text, "scene.yaml"), parse_overrides(["sensing.noise_scale=2"], "set"))
    line = text[: text.index("sensing: !mine")].count("\n") + 1
    assert located(raised(lambda: scenario_from(document, Path("scenarios")))) == [f"{line}:10 sensing syntax"]


def test_changes_of_the_truth_are_set_and_swept(tmp_path: Path) -> None:
    set_to = "truth.changes=[{time: 4, floor_friction: 0.1}, {time: 5, vehicle: {mass_scale: 2}}]"
    assert [change.time for change in with_settings(set_to).truth.changes] == [4, 5]
    ((none, one),) = parse_sweeps(["truth.changes=[],[{time: 4, floor_friction: 0.1}]"], "vary")
    assert [len(load_scenario("turns", [each]).truth.changes) for each in (none, one)] == [0, 1]
    path = tmp_path / "ice.yaml"
    text = (ROOT / "scenarios" / "turns.yaml").read_text(encoding="utf-8")
    path.write_text(f"{text}\ntruth: {{changes: [{{time: 3, floor_friction: 0.1}}]}}\n", encoding="utf-8")
    (times,) = parse_sweeps(["truth.changes[0].time=2,4.5"], "vary")
    assert [load_scenario(path, [time]).truth.changes[0].time for time in times] == [2, 4.5]


def test_python_values_do_the_same() -> None:
    settings = {"sensing.camera": [1, 2, 6], "truth.floor_friction": 0.3}
    scene = load_scenario("turns", settings)
    assert (scene.sensing.camera, scene.truth.floor_friction) == ((1.0, 2.0, 6.0), 0.3)


def test_values_of_numpy_do_the_same() -> None:
    settings = {"goal.center": np.array([1.0, 4.5]), "goal.radius": np.float64(0.3), "planning.blossom": np.int64(8)}
    scene = load_scenario("turns", {**settings, "planning.pruning": np.bool_(True), "start.x": np.array(1.1)})
    assert (scene.goal.center, scene.goal.radius, scene.planning.blossom) == ((1.0, 4.5), 0.3, 8)
    assert (scene.planning.pruning, scene.start.x) == (True, 1.1)


def test_a_value_of_another_type_is_named_by_its_type() -> None:
    (problem,) = raised(lambda: load_scenario("turns", {"goal.center": {1.0, 4.5}}))
    assert (problem.code, problem.problem) == (Code.TYPE, "is a value of type set")


def test_a_key_within_a_section_that_another_override_adds_has_its_own_place(tmp_path: Path) -> None:
    text = (ROOT / "scenarios" / "turns.yaml").read_text(encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(text.partition("truth:")[0], encoding="utf-8")
    folder = tmp_path / "suites"
    folder.mkdir()
    (tmp_path / "robot.xml").write_text("")
    suite = Place(str(folder / "a.yaml"), Position(3, 7), folder=folder)
    first, second = Override("truth.floor_friction", 0.5, suite), replace(suite, folder=tmp_path)
    scene = load_scenario(tmp_path / "scene.yaml", [first, Override("truth.mjcf", "robot.xml", second)])
    assert scene.truth.mjcf == str(tmp_path / "robot.xml")
    given = [first, *parse_overrides(["truth.mjcf=none.xml"], "set")]
    (problem,) = raised(lambda: load_scenario(tmp_path / "scene.yaml", given))
    assert (problem.file, problem.path, problem.line) == ("set", "truth.mjcf", None)


def test_a_section_that_is_replaced_again_has_the_later_place() -> None:
    document = parse_document("a: {b: 1}", "f.yaml")
    inner, outer = (Override(key, value, Place(key)) for key, value in (("a.b", 2), ("a", {"b": 3})))
    source = overridden(overridden(document, [inner]), [outer]).source
    assert source.replacement(("a", "b")) == outer.place


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sensing.noise_scal=2", "sensing.noise_scal unknown"),
        ("sensing.rate_hz=x", "sensing.rate_hz type"),
        ("sensing.rate_hz=", "sensing.rate_hz type"),
        ("sensing.dropout=1.5", "sensing.dropout value"),
        ("sensing.message_loss=1.01", "sensing.message_loss value"),
        ("sensing.camera=[1, 2", "sensing.camera syntax"),
        ("sensing.camera=[1, 2]", "sensing.camera value"),
        ("name.x=3", "name.x unknown"),
        ("nothing.x=3", "nothing unknown"),
        ("goal.heading_deg=90", "goal.heading_deg conflict"),
        ("start.x=99", "start.x geometry"),
        ("truth.movable_boxes[9].mass=1", "truth.movable_boxes[9].mass unknown"),
        ("truth.changes[0].time=abc", "truth.changes[0].time unknown"),
        ("truth.movable_boxes.mass=1", "truth.movable_boxes.mass value"),
        ("vehicle=mushrr", "vehicle not-found"),
        ("sensing", "syntax"),
        ("=3", "syntax"),
        ("a..b=3", "syntax"),
        ("a[x]=3", "syntax"),
    ],
)
def test_problems_are_reported_at_the_argument(text: str, expected: str) -> None:
    problems = raised(lambda: with_settings(text))
    assert located(problems) == [expected]
    assert [(d.file, d.argument) for d in problems] == [("set", True)]


def test_an_unknown_key_suggests_the_similar_one() -> None:
    (problem,) = raised(lambda: with_settings("sensing.noise_scal=2"))
    assert "'noise_scale'" in problem.expected


def test_every_problem_at_once() -> None:
    problems = raised(lambda: with_settings("sensing.noise_scal=2", "sensing.rate_hz=x", "start.x=99"))
    assert sorted(located(problems)) == ["sensing.noise_scal unknown", "sensing.rate_hz type", "start.x geometry"]


@pytest.mark.parametrize("second", ["sensing.rate_hz=5", "sensing={preset: planar}", "sensing.rate_hz=30"])
def test_a_key_is_set_once(second: str) -> None:
    problems = raised(lambda: with_settings("sensing.rate_hz=30", second))
    assert [d.code for d in problems] == [Code.DUPLICATE]


def test_problems_of_the_file_stay_at_the_file(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text("name: a\nbounds: {x: [0, 3], y: [0, 3]}\nstart: {x: 1, y: 1, heading_deg: 0}\ngoal: {radius: 1}\n")
    problems = raised(lambda: load_scenario(file, {"sensing.rate_hz": -1}))
    assert sorted(located(problems)) == ["4:1 goal.center missing", "sensing.rate_hz value"]
    assert {d.file for d in problems} == {str(file), "settings"}


def test_a_relative_path_begins_at_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "car.yaml").write_text("")
    assert load_scenario("turns", {"vehicle": "car.yaml"}).vehicle == str(tmp_path / "car.yaml")


def test_a_sweep_has_the_values_of_a_list() -> None:
    ((first, second), cameras) = parse_sweeps(["sensing.rate_hz=5, 30", "sensing.camera=[1,3,5],[1,3,6]"], "vary")
    assert (first.key, first.value, second.value) == ("sensing.rate_hz", 5, 30)
    assert [each.value for each in cameras] == [(1, 3, 5), (1, 3, 6)]
    ((third, fourth),) = parse_sweeps(["sensing.flag=true,1"], "vary")  # which are equal in Python
    assert (third.value, fourth.value) == (True, 1)


@pytest.mark.parametrize(
    ("texts", "codes"),
    [
        (["sensing.rate_hz="], [Code.MISSING]),
        (["sensing.rate_hz=5,5"], [Code.DUPLICATE]),
        (["sensing.rate_hz=5", "sensing.rate_hz=6"], [Code.DUPLICATE]),
        (["sensing.rate_hz=[5"], [Code.SYNTAX]),
        (["rate"], [Code.SYNTAX]),
    ],
)
def test_a_wrong_sweep_is_refused(texts: list[str], codes: list[Code]) -> None:
    assert [d.code for d in raised(lambda: parse_sweeps(texts, "vary"))] == codes


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        0.1,
        "word",
        "true",
        "12",
        "a: b",
        "a, b",
        "1:30",
        ".5",
        "-",
        "é",
        "😀",
        0.1234567890123456,
        1e22,
        1e-7,
        [1, [2.5, "x"]],
        {"a": {"b": [False]}},
        {"a: b": 1, "": 2, "null": 3, "#": 4},
        "\x07\x7f\u2028\ufeff\U000e0001😀",
    ],
)
def test_the_text_of_a_value_is_read_as_that_value(value: Any) -> None:
    (override,) = overrides_of({"key": value})
    assert parse_overrides([f"key={value_text(override.value)}"], "set") == (override,)
    assert isinstance(override, Override)
