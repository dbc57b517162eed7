"""Wrong scenario files: each mistake is explained at its line and column."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.diagnostics import located, raised

from kraft.errors import Code, Diagnostic
from kraft.scenario import load_scenario, parse_scenario

BASE = {
    "name": "name: x",
    "bounds": "bounds: {x: [0, 4], y: [0, 4]}",
    "start": "start: {x: 1, y: 1, heading_deg: 0}",
    "goal": "goal: {center: [3, 3], radius: 0.5}",
}


def with_line(line: str) -> str:
    """The smallest scenario with the line of one section replaced or added."""
    return "\n".join({**BASE, line.partition(":")[0]: line}.values())


def problems_of(text: str | bytes) -> tuple[Diagnostic, ...]:
    """Every problem of a file f.yaml in the folder `folder`."""
    return raised(lambda: parse_scenario(text, "f.yaml", Path("folder")))


def test_the_smallest_scenario_is_valid() -> None:
    assert problems_of("\n".join(BASE.values())) == ()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("name: 3", "1:7 name type"),
        ("name: has space", "1:7 name value"),
        ("name:", "1:6 name type"),
        ("description: [1]", "5:14 description type"),
        ("bounds: {x: [4, 0], y: [0, 4]}", "2:13 bounds.x value"),
        ("bounds: {x: [0, 0], y: [0, 4]}", "2:13 bounds.x value"),
        ("bounds: {x: [0, 4]}", "2:1 bounds.y missing"),
        ("bounds: {x: [0, 4], y: [0, 4], z: [0, 1]}", "2:32 bounds.z unknown"),
        ("bounds: {x: [0, 1e9], y: [0, 4]}", "2:17 bounds.x[1] value"),
        ("bounds: [0, 4]", "2:9 bounds type"),
        ("start: {x: 1, y: 1}", "3:1 start.heading_deg missing"),
        ('start: {x: "1", y: 1, heading_deg: 0}', "3:12 start.x type"),
        ("start: {x: true, y: 1, heading_deg: 0}", "3:12 start.x type"),
        ("start: {x: 1, y: .nan, heading_deg: 0}", "3:18 start.y value"),
        ("start: {x: 1, y: 9, heading_deg: 0}", "3:18 start.y geometry"),
        ("start: {x: 1, y: 1, heading: 0, heading_deg: 0}", "3:21 start.heading unknown"),
        ("start: {x: 1, y: 1, heading_deg: 1:30}", "3:34 start.heading_deg type"),
        ("start: {x: 1, y: 1, heading_deg: on}", "3:34 start.heading_deg type"),
        ("start: {x: 1, y: 1, heading_deg: 090}", "3:34 start.heading_deg value"),
        ("start:", "3:7 start type"),
        ("goal: {center: [3, 3], radius: 0}", "4:32 goal.radius value"),
        ("goal: {center: [3, 3], radius: -1}", "4:32 goal.radius value"),
        ("goal: {center: [3], radius: 1}", "4:16 goal.center value"),
        ("goal: {center: [3, 3, 3], radius: 1}", "4:16 goal.center value"),
        ("goal: {center: [9, 3], radius: 1}", "4:16 goal.center geometry"),
        ("goal: {center: {x: 3, y: 3}, radius: 1}", "4:16 goal.center type"),
        ("goal: {center: [3, 3], radius: 1, heading_deg: 90}", "4:48 goal.heading_deg conflict"),
        ("goal: {center: [3, 3], radius: 1, heading_tolerance_deg: 10}", "4:58 goal.heading_tolerance_deg conflict"),
        ("goal: {center: [3, 3], radius: 1, heading_deg: 90, heading_tolerance_deg: 190}", "4:75 goal.heading_tolerance_deg value"),
        ("goal: {center: [3, 3], radius: 1, radius: 2}", "4:35 goal.radius duplicate"),
        ("goal: {center: [3, 3], radius: 1, limits: [0, 1]}", "4:43 goal.limits type"),
        ("goal: {center: [3, 3], radius: 1, limits: {v: 0}}", "4:47 goal.limits.v type"),
        ("goal: {center: [3, 3], radius: 1, limits: {v: [0]}}", "4:47 goal.limits.v value"),
        ("goal: {center: [3, 3], radius: 1, limits: {v: [1, 0]}}", "4:47 goal.limits.v value"),
        ("goal: {center: [3, 3], radius: 1, limits: {v: [0, .inf]}}", "4:51 goal.limits.v[1] value"),
        ("vehicle: mushrr", "5:10 vehicle not-found"),
        ("vehicle: 3", "5:10 vehicle type"),
        ("vehicle: none.yaml", "5:10 vehicle not-found"),
        ('vehicle: "not a module:x"', "5:10 vehicle value"),
        ("obstacles: {box: {}}", "5:12 obstacles type"),
        ("obstacles: [{box: {center: [1, 1], size: [0, 1]}}]", "5:43 obstacles[0].box.size[0] value"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1], yaw: 3}}]", "5:50 obstacles[0].box.yaw unknown"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1], height: 0}}]", "5:58 obstacles[0].box.height value"),
        ("obstacles: [{circle: {center: [1, 1], radius: -0.5}}]", "5:47 obstacles[0].circle.radius value"),
        ("obstacles: [{cirle: {center: [1, 1], radius: 0.5}}]", "5:14 obstacles[0].cirle unknown"),
        ("obstacles: [{}]", "5:13 obstacles[0] missing"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1]}, circle: {center: [1, 1], radius: 1}}]", "5:13 obstacles[0] conflict"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0]]}}]", "5:34 obstacles[0].polygon.vertices value"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 1], [2, 2]]}}]", "5:34 obstacles[0].polygon.vertices geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 1], [1, 0], [0, 1]]}}]", "5:34 obstacles[0].polygon.vertices geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [2, 0], [1, 0], [1, 1]]}}]", "5:34 obstacles[0].polygon.vertices geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 1], [0, 0]]}}]", "5:59 obstacles[0].polygon.vertices[3] geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 0], [1, 1]]}}]", "5:51 obstacles[0].polygon.vertices[2] geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 1.0e-308], [1, 1]]}}]", "5:43 obstacles[0].polygon.vertices[1] geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 0.0009], [0, 1]]}}]", "5:43 obstacles[0].polygon.vertices[1] geometry"),
        ("obstacles: [{polygon: {vertices: [[5000.1, 5000.3], [5000.4, 5000.0], [5000.0, 5000.4]]}}]", "5:34 obstacles[0].polygon.vertices geometry"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [2, 1.0e-8], [4, 0], [2, -1.0e-8]]}}]", "5:34 obstacles[0].polygon.vertices geometry"),
        ("obstacles: [{circle: {center: [1, 1], radius: 1.0e-308}}]", "5:47 obstacles[0].circle.radius value"),
        ("bounds: {x: [0, 1.0e-308], y: [0, 4]}", "2:13 bounds.x value"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1], [1, 1]]}}]", "5:43 obstacles[0].polygon.vertices[1] value"),
        ("obstacles: [{map: {file: none.yaml}}]", "5:26 obstacles[0].map.file not-found"),
        ("obstacles: [7]", "5:13 obstacles[0] type"),
        ("truth: {changes: {time: 1}}", "5:18 truth.changes type"),
        ("truth: {changes: [{floor_friction: 0.1}]}", "5:19 truth.changes[0].time missing"),
        ("truth: {changes: [{time: 0, floor_friction: 0.1}]}", "5:26 truth.changes[0].time value"),
        ("truth: {changes: [{time: 2}]}", "5:19 truth.changes[0] missing"),
        ("truth: {changes: [{time: 2, vehicle: {}}]}", "5:19 truth.changes[0] missing"),
        ("truth: {changes: [{time: 2, vehicle: {mass: 2}}]}", "5:39 truth.changes[0].vehicle.mass unknown"),
        ("truth: {changes: [{time: 2, floor_friction: 0}]}", "5:45 truth.changes[0].floor_friction value"),
        ("truth: {changes: [{time: 2, tilt: 0}]}", "5:29 truth.changes[0].tilt unknown"),
        ("truth: {changes: [{time: 2, floor_friction: 1}, {time: 2, floor_friction: 2}]}", "5:56 truth.changes[1].time value"),
        ("planning: {planner: drt}", "5:21 planning.planner value"),
        ("planning: {planner: prm}", "5:21 planning.planner value"),
        ("planning: {cycle: 0}", "5:19 planning.cycle value"),
        ("planning: {cycles: 1}", "5:12 planning.cycles unknown"),
        ("planning: {blossom: 2.5}", "5:21 planning.blossom type"),
        ("planning: {blossom: 0}", "5:21 planning.blossom value"),
        ("planning: {iterations: 0}", "5:24 planning.iterations value"),
        ("planning: {iterations: -3}", "5:24 planning.iterations value"),
        ("planning: {iterations: 10, time: 1}", "5:34 planning.time conflict"),
        ("planning: {time: 0}", "5:18 planning.time value"),
        ("planning: {edge_duration: [1, 0.5]}", "5:27 planning.edge_duration value"),
        ("planning: {edge_duration: 1}", "5:27 planning.edge_duration type"),
        ("planning: {integration_step: 0.8}", "5:30 planning.integration_step conflict"),
        ("planning: {integration_step: 1e-9}", "5:30 planning.integration_step conflict"),
        ("planning: {integration_step: 1.0e-320}", "5:30 planning.integration_step conflict"),
        ("planning: {goal_bias: 1.5}", "5:23 planning.goal_bias value"),
        ("planning: {pruning: yes}", "5:21 planning.pruning type"),
        ("planning: {safety: {delta: -0.1}}", "5:28 planning.safety.delta value"),
        ("truth: {tilt: {}}", "5:15 truth.tilt missing"),
        ("truth: {tilt: {angle: 0.1, angle_deg: 5}}", "5:15 truth.tilt conflict"),
        ("truth: {tilt: {angle: 2}}", "5:23 truth.tilt.angle value"),
        ("truth: {friction_patches: [{x: [2, 0], y: [0, 1], friction: 0.1}]}", "5:32 truth.friction_patches[0].x value"),
        ("truth: {floor_friction: 0}", "5:25 truth.floor_friction value"),
        ("truth: {speed_bumps: [{center: [1, 1], size: [1, 1], height: 5}]}", "5:62 truth.speed_bumps[0].height value"),
        ("truth: {movable_boxes: [{center: [1, 1], size: [1, 1], mass: 1}]}", "5:48 truth.movable_boxes[0].size value"),
        ("truth: {movable_boxes: [{center: [1, 1], size: [1, 1, 1], mass: 0}]}", "5:65 truth.movable_boxes[0].mass value"),
        ("truth: {movable_boxes: [{center: [1, 1], size: [1, 1, 1], mass: 1.0e-300}]}", "5:65 truth.movable_boxes[0].mass value"),
        ("truth: {car: {mass: 1.0e-20}}", "5:21 truth.car.mass value"),
        ("truth: {car: {wheels: {radius: 0.001, mass: 1.0e-30}}}", "5:45 truth.car.wheels.mass value"),
        ("truth: {vehicle: {mass_scale: 1.0e-20}}", "5:31 truth.vehicle.mass_scale value"),
        ("truth: {changes: [{time: 2, vehicle: {mass_scale: 1.0e-20}}]}", "5:51 truth.changes[0].vehicle.mass_scale value"),
        ("sensing: {preset: single_tag}", "5:19 sensing.preset value"),
        ("sensing: {rate_hz: 0}", "5:20 sensing.rate_hz value"),
        ("sensing: {camera: [1, 3]}", "5:19 sensing.camera value"),
        ("sensing: {camera: [1, 3, -5]}", "5:26 sensing.camera[2] geometry"),
        ("sensing: {camera: [1, 3, 0.2]}", "5:26 sensing.camera[2] geometry"),
        ("sensing: {preset: rendered, camera: [1, 3, 0.1]}", "5:44 sensing.camera[2] geometry"),
        ("sensing: {dropout: 2}", "5:20 sensing.dropout value"),
        ("sensing: {correlation_time: -1}", "5:29 sensing.correlation_time value"),
        ("sensing: {preset: rendered, correlation_time: 0}", "5:47 sensing.correlation_time conflict"),
        ("sensing: {preset: rendered, noise_scale: 2}", "5:42 sensing.noise_scale conflict"),
        ("sensing: {preset: rendered, dropout: 0}", "5:38 sensing.dropout conflict"),
        ("trial: {timeout: -1}", "5:18 trial.timeout value"),
        ("trail: {timeout: 60}", "5:1 trail unknown"),
    ],
)  # fmt: skip
def test_a_mistake_is_explained_where_it_is(line: str, expected: str) -> None:
    assert located(problems_of(with_line(line))) == [expected]


@pytest.mark.parametrize("section", BASE)
def test_a_missing_section_is_named(section: str) -> None:
    lines = (text for key, text in BASE.items() if key != section)
    assert located(problems_of("\n".join(lines))) == [f"1:1 {section} missing"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[]", "1:1 type"),
        ("turns", "1:1 type"),
        ("---\n", "2:1 type"),
        ("", "1:1 syntax"),
    ],
)
def test_a_file_that_is_not_a_mapping_is_said_to_be_what_it_is(text: str, expected: str) -> None:
    assert located(problems_of(text)) == [expected]


def test_every_problem_of_a_file_comes_at_once_in_the_order_of_the_file() -> None:
    text = """name: x
bounds: {x: [0, 4], y: [0, 4]}
start: {x: 9, y: 1, heading_deg: 0}
goal: {center: [3, 3], radius: 0, radius: 1}
vehicle: mushrr
colour: 012
obstacles:
  - box: {center: [1, 1], size: [1, -1]}
  - map: {file: none.yaml}
"""
    assert located(problems_of(text)) == [
        "3:12 start.x geometry",
        "4:32 goal.radius value",
        "4:35 goal.radius duplicate",
        "5:10 vehicle not-found",
        "6:1 colour unknown",
        "6:9 colour value",
        "8:37 obstacles[0].box.size[1] value",
        "9:17 obstacles[1].map.file not-found",
    ]


def test_a_misspelt_key_is_one_problem_not_two() -> None:
    (problem,) = problems_of(with_line("goal: {center: [3, 3], radios: 1}"))
    assert located([problem]) == ["4:24 goal.radios unknown"]
    assert "'radius'" in problem.expected


def test_a_value_that_cannot_be_read_is_reported_once() -> None:
    assert len(problems_of(with_line("goal: {center: [.nan, 3], radius: 0x1}"))) == 2


@given(st.binary(max_size=300))
def test_no_bytes_raise_anything_but_an_input_error(content: bytes) -> None:
    problems_of(content)


scalars = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5))
keys = st.sampled_from(["name", "bounds", "x", "y", "start", "goal", "center", "radius", "obstacles", "box", "size"])
values = st.recursive(scalars, lambda v: st.lists(v, max_size=3) | st.dictionaries(keys, v, max_size=4), max_leaves=12)
sections = st.sampled_from(["name", "bounds", "obstacles", "start", "goal", "vehicle", "planning", "truth", "sensing"])


@given(sections, values)
def test_no_content_of_a_section_raises_anything_but_an_input_error(section: str, content: object) -> None:
    import json

    for problem in problems_of(with_line(f"{section}: {json.dumps(content)}")):
        str(problem).encode()


def test_every_change_of_the_truth_that_is_out_of_order_is_reported_with_all_other_problems() -> None:
    changes = ["time: 3, floor_friction: 1", "time: 1, floor_friction: 1", "time: x, floor_friction: 1"]
    changes += ["time: 2, floor_friction: -1", "time: 4, floor_friction: 1", "time: 4, vehicle: {drive_scale: 1}"]
    text = "truth: {changes: [" + ", ".join(f"{{{each}}}" for each in changes) + "]}"
    found = {(each.path, str(each.code)) for each in problems_of(with_line(text))}
    times = {(f"truth.changes[{k}].time", "value") for k in (1, 3, 5)}
    assert found == {*times, ("truth.changes[2].time", "type"), ("truth.changes[3].floor_friction", "value")}


def test_two_angles_of_a_tilt_are_told_apart_from_none() -> None:
    (none,) = problems_of(with_line("truth: {tilt: {}}"))
    (two,) = problems_of(with_line("truth: {tilt: {angle: 0.1, angle_deg: 5}}"))
    assert none.problem == "needs one of `angle` and `angle_deg`"
    assert two.problem == "both `angle` and `angle_deg` are given"


def test_another_word_for_a_shape_is_understood(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(
        "name: a\nbounds: {x: [0, 4], y: [0, 4]}\nobstacles:\n  - {disc: {center: [2, 2], radius: 0.3}}\n"
        "start: {x: 1, y: 1, heading_deg: 0}\ngoal: {center: [3, 3], radius: 0.3}\n"
        "truth: {tilt: {angle_deg: 90}}\n"
    )
    shape, tilt = raised(lambda: load_scenario(tmp_path / "scene.yaml"))
    assert (shape.line, shape.path, shape.code) == (4, "obstacles[0].disc", Code.UNKNOWN)
    assert "'circle'" in shape.expected
    assert (tilt.line, tilt.path) == (7, "truth.tilt.angle_deg")
    assert "angle between" in tilt.expected
