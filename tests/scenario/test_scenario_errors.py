"""Wrong scenario files: each mistake is explained at its line and column."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kraft.errors import InputError
from kraft.scenario import parse_scenario

BASE = {
    "name": "name: x",
    "bounds": "bounds: {x: [0, 4], y: [0, 4]}",
    "start": "start: {x: 1, y: 1, heading_deg: 0}",
    "goal": "goal: {center: [3, 3], radius: 0.5}",
}


def with_line(line: str) -> str:
    """The smallest scenario with the line of one section replaced or added."""
    return "\n".join({**BASE, line.partition(":")[0]: line}.values())


def problems_of(text: str | bytes) -> list[str]:
    """Everything kraft says about a file f.yaml in the folder `folder`."""
    try:
        parse_scenario(text, "f.yaml", Path("folder"))
    except InputError as error:
        return str(error).splitlines()
    return []


def test_the_smallest_scenario_is_valid() -> None:
    assert problems_of("\n".join(BASE.values())) == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("name: 3", "1:7: name: is the number 3; expected text (short name of letters, digits, - and _)"),
        ("name: has space", "1:7: name: is the text 'has space'; expected a short name of letters, digits, - and _"),
        ("name:", "1:6: name: is nothing; expected text (short name of letters, digits, - and _)"),
        ("description: [1]", "5:14: description: is a list; expected text (one sentence for `kraft list scenarios`)"),
        ("bounds: {x: [4, 0], y: [0, 4]}", "2:13: bounds.x: the interval [4, 0] is empty or inverted; expected [low, high] with low < high"),
        ("bounds: {x: [0, 0], y: [0, 4]}", "2:13: bounds.x: the interval [0, 0] is empty or inverted; expected [low, high] with low < high"),
        ("bounds: {x: [0, 4]}", "2:1: bounds.y: the key is missing; expected [low, high], m"),
        ("bounds: {x: [0, 4], y: [0, 4], z: [0, 1]}", "2:32: bounds.z: unknown key; expected x or y"),
        ("bounds: {x: [0, 1e9], y: [0, 4]}", "2:17: bounds.x[1]: is the number 1000000000; expected a number of at most 10000 ([low, high], m)"),
        ("bounds: [0, 4]", "2:9: bounds: is a list; expected a mapping (the workspace {x: [low, high], y: [low, high]})"),
        ("start: {x: 1, y: 1}", "3:1: start.heading_deg: the key is missing; expected heading, degrees from +x"),
        ('start: {x: "1", y: 1, heading_deg: 0}', "3:12: start.x: is the text '1'; expected a number (m)"),
        ("start: {x: true, y: 1, heading_deg: 0}", "3:12: start.x: is true; expected a number (m)"),
        ("start: {x: 1, y: .nan, heading_deg: 0}", "3:18: start.y: .nan is not a finite number; expected a finite number"),
        ("start: {x: 1, y: 9, heading_deg: 0}", "3:18: start.y: the start is out of bounds (y = 9); expected y in [0, 4]"),
        ("start: {x: 1, y: 1, heading: 0, heading_deg: 0}", "3:21: start.heading: unknown key; did you mean 'heading_deg'?"),
        ("start: {x: 1, y: 1, heading_deg: 1:30}", "3:34: start.heading_deg: is the text '1:30'; expected a number (heading, degrees from +x)"),
        ("start: {x: 1, y: 1, heading_deg: on}", "3:34: start.heading_deg: is the text 'on'; expected a number (heading, degrees from +x)"),
        ("start: {x: 1, y: 1, heading_deg: 090}", "3:34: start.heading_deg: 090 is octal to some YAML readers and decimal to others; expected 90, or quotes if it is text"),
        ("start:", "3:7: start: is nothing; expected a mapping ({x, y, heading_deg, speed})"),
        ("goal: {center: [3, 3], radius: 0}", "4:32: goal.radius: is the number 0; expected a number greater than 0 (distance from the centre that counts as arrived, m)"),
        ("goal: {center: [3, 3], radius: -1}", "4:32: goal.radius: is the number -1; expected a number greater than 0 (distance from the centre that counts as arrived, m)"),
        ("goal: {center: [3], radius: 1}", "4:16: goal.center: the list is too short; expected 2 items ([x, y] of the centre, m)"),
        ("goal: {center: [3, 3, 3], radius: 1}", "4:16: goal.center: the list is too long; expected 2 items ([x, y] of the centre, m)"),
        ("goal: {center: [9, 3], radius: 1}", "4:16: goal.center: the goal's centre is out of bounds (x = 9); expected x in [0, 4]"),
        ("goal: {center: {x: 3, y: 3}, radius: 1}", "4:16: goal.center: is a mapping; expected a list ([x, y] of the centre, m)"),
        ("goal: {center: [3, 3], radius: 1, heading_deg: 90}", "4:48: goal.heading_deg: is given without heading_tolerance_deg; expected both or none"),
        ("goal: {center: [3, 3], radius: 1, heading_tolerance_deg: 10}", "4:58: goal.heading_tolerance_deg: is given without heading_deg; expected both or none"),
        ("goal: {center: [3, 3], radius: 1, heading_deg: 90, heading_tolerance_deg: 190}", "4:75: goal.heading_tolerance_deg: is the number 190; expected a number of at most 180 (deviation from that heading, to either side, that counts as arrived, degrees)"),
        ("goal: {center: [3, 3], radius: 1, radius: 2}", "4:35: goal.radius: the key is repeated; it is first at line 4, column 24; expected it once"),
        ("vehicle: mushrr", "5:10: vehicle: there is no vehicle 'mushrr'; did you mean 'mushr'?"),
        ("vehicle: 3", "5:10: vehicle: is the number 3; expected text (a vehicle's name, the path of its YAML file, module:attribute or file.py:attribute)"),
        ("vehicle: none.yaml", "5:10: vehicle: there is no file folder/none.yaml; expected the path of a vehicle's YAML file"),
        ('vehicle: "not a module:x"', "5:10: vehicle: 'not a module:x' is not a module and an attribute; expected module:attribute"),
        ("obstacles: {box: {}}", "5:12: obstacles: is a mapping; expected a list (static obstacles, known to the planner)"),
        ("obstacles: [{box: {center: [1, 1], size: [0, 1]}}]", "5:43: obstacles[0].box.size[0]: is the number 0; expected a number greater than 0 ([length, width] before turning by yaw_deg, m)"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1], yaw: 3}}]", "5:50: obstacles[0].box.yaw: unknown key; did you mean 'yaw_deg'?"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1], height: 0}}]", "5:58: obstacles[0].box.height: is the number 0; expected a number greater than 0 (height in the physics world, m)"),
        ("obstacles: [{circle: {center: [1, 1], radius: -0.5}}]", "5:47: obstacles[0].circle.radius: is the number -0.5; expected a number greater than 0 (radius, m)"),
        ("obstacles: [{cirle: {center: [1, 1], radius: 0.5}}]", "5:14: obstacles[0].cirle: unknown key; did you mean 'circle'?"),
        ("obstacles: [{}]", "5:13: obstacles[0]: holds no shape; expected exactly one of box, circle, polygon, map"),
        ("obstacles: [{box: {center: [1, 1], size: [1, 1]}, circle: {center: [1, 1], radius: 1}}]", "5:13: obstacles[0]: holds box and circle; expected exactly one of box, circle, polygon, map"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0]]}}]", "5:34: obstacles[0].polygon.vertices: the list is too short; expected 3 items or more"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 1], [2, 2]]}}]", "5:34: obstacles[0].polygon.vertices: the polygon has no area; expected vertices that are not on one line"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 1], [1, 0], [0, 1]]}}]", "5:34: obstacles[0].polygon.vertices: the polygon meets itself: edge 0 and edge 2; expected a simple polygon (edge i runs from vertex i to the next)"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [2, 0], [1, 0], [1, 1]]}}]", "5:34: obstacles[0].polygon.vertices: the polygon meets itself: edge 0 and edge 1; expected a simple polygon (edge i runs from vertex i to the next)"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 1], [0, 0]]}}]", "5:59: obstacles[0].polygon.vertices[3]: the last vertex repeats the first; expected each vertex once (it closes by itself)"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1, 0], [1, 0], [1, 1]]}}]", "5:51: obstacles[0].polygon.vertices[2]: repeats vertex 1; expected each vertex once"),
        ("obstacles: [{polygon: {vertices: [[0, 0], [1], [1, 1]]}}]", "5:43: obstacles[0].polygon.vertices[1]: the list is too short; expected 2 items"),
        ("obstacles: [{map: {file: none.yaml}}]", "5:26: obstacles[0].map.file: there is no file folder/none.yaml; expected the path of a map's YAML file, relative to this file"),
        ("obstacles: [7]", "5:13: obstacles[0]: is the number 7; expected a mapping"),
        ("planning: {planner: drt}", "5:21: planning.planner: is the text 'drt'; did you mean 'dirt'?"),
        ("planning: {planner: prm}", "5:21: planning.planner: is the text 'prm'; expected one of dirt, rrt, est, kpiece1"),
        ("planning: {cycle: 0}", "5:19: planning.cycle: is the number 0; expected a number greater than 0 (time between two plans while driving, s)"),
        ("planning: {cycles: 1}", "5:12: planning.cycles: unknown key; did you mean 'cycle'?"),
        ("planning: {blossom: 2.5}", "5:21: planning.blossom: is the number 2.5; expected a whole number (candidate edges that are propagated together when a node is expanded; the best of them is added)"),
        ("planning: {blossom: 0}", "5:21: planning.blossom: is the number 0; expected a number of at least 1 (candidate edges that are propagated together when a node is expanded; the best of them is added)"),
        ("planning: {iterations: 0}", "5:24: planning.iterations: is the number 0; expected a number of at least 1 (planning budget in iterations, repeatable; 20000 unless `time` is given)"),
        ("planning: {iterations: -3}", "5:24: planning.iterations: is the number -3; expected a number of at least 1 (planning budget in iterations, repeatable; 20000 unless `time` is given)"),
        ("planning: {iterations: 10, time: 1}", "5:34: planning.time: both `iterations` and `time` are given; expected one of them"),
        ("planning: {time: 0}", "5:18: planning.time: is the number 0; expected a number greater than 0 (planning budget in wall-clock time, not repeatable, s)"),
        ("planning: {edge_duration: [1, 0.5]}", "5:27: planning.edge_duration: the shortest duration 1 is longer than the longest 0.5; expected [shortest, longest]"),
        ("planning: {edge_duration: 1}", "5:27: planning.edge_duration: is the number 1; expected a list (shortest and longest duration of one tree edge, s)"),
        ("planning: {integration_step: 0.8}", "5:30: planning.integration_step: is 0.8, longer than the shortest edge; expected at most 0.5"),
        ("planning: {goal_bias: 1.5}", "5:23: planning.goal_bias: is the number 1.5; expected a number of at most 1 (fraction of the random samples that are drawn from the goal)"),
        ("planning: {pruning: yes}", "5:21: planning.pruning: is the text 'yes'; expected true or false (remove nodes that can no longer improve the solution)"),
        ("planning: {safety: {delta: -0.1}}", "5:28: planning.safety.delta: is the number -0.1; expected a number of at least 0 (clearance at rest, m)"),
        ("truth: {tilt: {}}", "5:15: truth.tilt: needs one of `angle` and `angle_deg`; expected angle in rad or angle_deg in degrees"),
        ("truth: {tilt: {angle: 0.1, angle_deg: 5}}", "5:15: truth.tilt: needs one of `angle` and `angle_deg`; expected angle in rad or angle_deg in degrees"),
        ("truth: {tilt: {angle: 2}}", "5:23: truth.tilt.angle: is the number 2; expected a number of at most 0.7 (angle between the floor and the horizontal, rad)"),
        ("truth: {friction_patches: [{x: [2, 0], y: [0, 1], friction: 0.1}]}", "5:32: truth.friction_patches[0].x: the interval [2, 0] is empty or inverted; expected [low, high] with low < high"),
        ("truth: {floor_friction: 0}", "5:25: truth.floor_friction: is the number 0; expected a number greater than 0 (sliding friction coefficient of the floor)"),
        ("truth: {speed_bumps: [{center: [1, 1], size: [1, 1], height: 5}]}", "5:62: truth.speed_bumps[0].height: is the number 5; expected a number of at most 0.5 (height of the crest, m)"),
        ("truth: {movable_boxes: [{center: [1, 1], size: [1, 1], mass: 1}]}", "5:48: truth.movable_boxes[0].size: the list is too short; expected 3 items ([length, width, height], m)"),
        ("truth: {movable_boxes: [{center: [1, 1], size: [1, 1, 1], mass: 0}]}", "5:65: truth.movable_boxes[0].mass: is the number 0; expected a number greater than 0 (mass, kg)"),
        ("sensing: {preset: single_tag}", "5:19: sensing.preset: is the text 'single_tag'; did you mean 'single-tag'?"),
        ("sensing: {rate_hz: 0}", "5:20: sensing.rate_hz: is the number 0; expected a number greater than 0 (poses per second)"),
        ("sensing: {camera: [1, 3]}", "5:19: sensing.camera: the list is too short; expected 3 items ([x, y, z] of the camera, m)"),
        ("sensing: {dropout: 2}", "5:20: sensing.dropout: is the number 2; expected a number of at most 1 (fraction of poses that never arrive; the preset's own if not given)"),
        ("trial: {timeout: -1}", "5:18: trial.timeout: is the number -1; expected a number greater than 0 (time limit of methods that replan, s)"),
        ("trail: {timeout: 60}", "5:1: trail: unknown key; did you mean 'trial'?"),
    ],
)  # fmt: skip
def test_a_mistake_is_explained_where_it_is(line: str, expected: str) -> None:
    assert problems_of(with_line(line)) == [f"f.yaml:{expected}"]


@pytest.mark.parametrize("section", BASE)
def test_a_missing_section_is_named(section: str) -> None:
    (line,) = problems_of("\n".join(text for key, text in BASE.items() if key != section))
    assert line.startswith(f"f.yaml:1:1: {section}: the key is missing; expected ")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[]", "f.yaml:1:1: is a list; expected a mapping"),
        ("turns", "f.yaml:1:1: is the text 'turns'; expected a mapping"),
        ("---\n", "f.yaml:2:1: is nothing; expected a mapping"),
        ("", "f.yaml:1:1: the file is empty; expected a mapping"),
    ],
)
def test_a_file_that_is_not_a_mapping_is_said_to_be_what_it_is(text: str, expected: str) -> None:
    assert problems_of(text) == [expected]


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
    assert [line.split(";")[0] for line in problems_of(text)] == [
        "f.yaml:3:12: start.x: the start is out of bounds (x = 9)",
        "f.yaml:4:32: goal.radius: is the number 0",
        "f.yaml:4:35: goal.radius: the key is repeated",
        "f.yaml:5:10: vehicle: there is no vehicle 'mushrr'",
        "f.yaml:6:1: colour: unknown key",
        "f.yaml:6:9: colour: 012 is octal to some YAML readers and decimal to others",
        "f.yaml:8:37: obstacles[0].box.size[1]: is the number -1",
        "f.yaml:9:17: obstacles[1].map.file: there is no file folder/none.yaml",
    ]


def test_a_misspelt_key_is_one_problem_not_two() -> None:
    lines = problems_of(with_line("goal: {center: [3, 3], radios: 1}"))
    assert lines == ["f.yaml:4:24: goal.radios: unknown key; did you mean 'radius'?"]


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

    for line in problems_of(with_line(f"{section}: {json.dumps(content)}")):
        line.encode()
