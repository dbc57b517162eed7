"""The plan file: what is written is read back exactly, nothing wrong is read, nothing is written half."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.diagnostics import located, raised

from kraft.errors import InputError
from kraft.planning.plan import PlanResult, plan_task
from kraft.planning.plan_file import (
    SCHEMA,
    Origin,
    dumps,
    plan_text,
    read_plan,
    read_plan_file,
    task_hash,
    vehicle_content,
    write_plan,
)
from kraft.planning.search import Budget, Previous
from kraft.provenance import plain_hash
from kraft.scenario import Task, load_scenario, parse_scenario
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR
from ompl_ext.vehicle import Footprint, Vehicle

ORIGIN = Origin("turns", "mushr")
SMALL = {
    "schema": SCHEMA, "seed": 0, "goal": {"reached": True}, "cost": 1.0, "cost_to_go": 0.0, "durations": [1.0],
    "controls": [[0.5]], "states": [[0.0, 0.0], [0.5, 0.0]], "times": [0.0, 1.0],
    "trajectory": [[0.0, 0.0], [0.5, 0.0]], "contingency": None,
}  # fmt: skip
"""Plan of one edge of a vehicle with two components and one control."""


@pytest.fixture(scope="module")
def task() -> Task:
    return load_scenario("turns").task()


@pytest.fixture(scope="module")
def mushr() -> Vehicle:
    return load_vehicle("mushr")


@pytest.fixture(scope="module")
def result(task: Task, mushr: Vehicle) -> PlanResult:
    return plan_task(task, mushr, Budget(iterations=1000))


@pytest.fixture(scope="module")
def text(task: Task, mushr: Vehicle, result: PlanResult) -> str:
    return plan_text(task, mushr, result, ORIGIN)


def test_what_is_written_is_read_back_to_the_last_bit(
    tmp_path: Path, task: Task, mushr: Vehicle, result: PlanResult
) -> None:
    write_plan(tmp_path / "new" / "plan.json", task, mushr, result, ORIGIN)
    plan, read = result.plan, read_plan(tmp_path / "new" / "plan.json")
    assert plan is not None
    for name in ("states", "controls", "durations", "times", "trajectory"):
        assert np.array_equal(getattr(read, name), getattr(plan, name)), name
    assert (read.cost, read.cost_to_go, read.reaches_goal) == (plan.cost, plan.cost_to_go, plan.reaches_goal)
    assert plan.contingency is not None
    assert read.contingency is not None
    assert read.contingency.manoeuvre == plan.contingency.manoeuvre
    assert read.contingency.slack == plan.contingency.slack
    assert np.array_equal(read.contingency.states, plan.contingency.states)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["plan.json"]


def test_it_names_the_state_and_the_controls_of_its_vehicle(tmp_path: Path, text: str, mushr: Vehicle) -> None:
    (tmp_path / "plan.json").write_text(text)
    assert read_plan_file(tmp_path / "plan.json").names == (mushr.state, tuple(mushr.controls))
    (tmp_path / "plan.json").write_text(changed(text, vehicle={}))
    assert read_plan_file(tmp_path / "plan.json").names is None


def test_a_plan_that_begins_in_the_goal_is_written_and_read(tmp_path: Path, task: Task, mushr: Vehicle) -> None:
    there = dataclasses.replace(task, goal=dataclasses.replace(task.goal, center=(task.start.x, task.start.y)))
    result = plan_task(there, mushr, Budget(iterations=10))
    write_plan(tmp_path / "plan.json", there, mushr, result, ORIGIN)
    read = read_plan(tmp_path / "plan.json")
    assert (len(read.durations), len(read.controls), len(read.states), read.cost) == (0, 0, 1, 0.0)
    (problem,) = raised(
        lambda: plan_task(there, mushr, Budget(iterations=10), previous=Previous(read, 0.0, "plan.json"))
    )
    assert (problem.file, problem.problem) == ("plan.json", "the plan has no edges: it began in the goal")


def test_it_says_everything_that_planning_again_needs(text: str, task: Task) -> None:
    content = json.loads(text)
    assert content["schema"] == "kraft.plan-file/1"
    assert content["scenario"] == {"name": "turns", "reference": "turns", "sha256": task_hash(task)}
    assert content["vehicle"]["parameters"] == dict(load_vehicle("mushr").parameters)
    assert (content["planner"], content["seed"], content["iterations"]) == ("dirt", 0, 1000)
    assert content["settings"]["steps"] == 10
    assert set(content["versions"]) == {"kraft", "numba", "numpy", "ompl", "python"}
    assert content["goal"] == {"center": [1.0, 5.0], "radius": 0.25, "reached": True}
    assert content["from"] is None


def test_a_person_can_read_it_one_state_a_line(text: str, result: PlanResult) -> None:
    assert result.plan is not None
    lines = [line for line in text.splitlines() if line.startswith("    [")]
    assert len(lines) >= len(result.plan.trajectory)
    assert max(map(len, text.splitlines())) < 4000


def test_nothing_in_it_depends_on_the_clock(task: Task, mushr: Vehicle, text: str) -> None:
    again = plan_task(task, mushr, Budget(iterations=1000))
    assert plan_text(task, mushr, again, ORIGIN) == text


def test_an_earlier_plan_is_recorded(task: Task, mushr: Vehicle, result: PlanResult) -> None:
    assert result.plan is not None
    origin = Origin("turns", "mushr", Previous(result.plan, 1.0, "a/plan.json"))
    recorded = json.loads(plan_text(task, mushr, result, origin))["from"]
    assert (recorded["file"], recorded["after"], len(recorded["sha256"])) == ("a/plan.json", 1.0, 64)


def test_the_hash_of_a_task_sees_what_the_planner_is_told_and_nothing_else(task: Task) -> None:
    source = Path(task.source.file).read_text()
    assert task_hash(parse_scenario("# a comment\n" + source).task()) == task_hash(task)
    assert task_hash(parse_scenario(source.replace("center: [0.5, 1.5]", "center: [0.5, 1.6]")).task()) != task_hash(
        task
    )
    assert task_hash(parse_scenario(source + "planning: {blossom: 31}\n").task()) != task_hash(task)


def wrong(tmp_path: Path, content: str | bytes) -> list[str]:
    path = tmp_path / "plan.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return located(raised(lambda: read_plan(path)))


def keys_and_codes(problems: list[str]) -> list[str]:
    return [problem.partition(" ")[2] for problem in problems]


def changed(text: str, **changes: Any) -> str:
    content = json.loads(text)
    for dotted, value in changes.items():
        *parents, key = dotted.split("__")
        place = content
        for parent in parents:
            place = place[parent]
        if value is ...:
            del place[key]
        else:
            place[key] = value
    return json.dumps(content)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "1:1 syntax"),
        ("{", "1:2 syntax"),
        ("[1]", "mismatch"),
        ('{"a": NaN}', "1:7 syntax"),
        ("[" * 100_000, "1:51 syntax"),
        (b"\xff\xfe", "1:1 syntax"),
        ("{}", "1:1 schema mismatch"),
        ('{"schema": "kraft.plan/1"}', "1:12 schema mismatch"),
        ('{"\\ud800": 1}', "1:2 syntax"),
    ],
)
def test_what_is_not_a_plan_file_is_refused(content: str | bytes, expected: str, tmp_path: Path) -> None:
    assert wrong(tmp_path, content) == [expected]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"controls": ...}, ["controls missing"]),
        ({"durations": "long"}, ["durations type"]),
        ({"durations": []}, ["cost mismatch", "controls mismatch", "states mismatch", "times mismatch"]),
        ({"controls": []}, ["controls value"]),
        ({"states": [[1, 2, 3, 4], [1, 2]]}, ["states mismatch", "states[1] mismatch"]),
        ({"states": [[1, 2, 3, True]]}, ["states mismatch", "states[0][3] type"]),
        ({"states": [[1, 2, 3, "4"]]}, ["states mismatch", "states[0][3] type"]),
        ({"trajectory": [[0, 0, 0, 0]]}, ["trajectory mismatch"]),
        ({"cost": -1}, ["cost value", "cost mismatch"]),
        ({"cost": True}, ["cost type"]),
        ({"cost": 1.0}, ["cost mismatch"]),
        ({"goal": {}}, ["goal.reached missing"]),
        ({"goal__reached": 1}, ["goal.reached type"]),
        ({"contingency__states": [[0, 0, 0]]}, ["contingency.states mismatch", "contingency.states mismatch"]),
        ({"contingency__manoeuvre": 3}, ["contingency.manoeuvre type"]),
    ],
)
def test_a_wrong_entry_is_named_by_its_path(
    changes: dict[str, Any], expected: list[str], text: str, tmp_path: Path
) -> None:
    assert keys_and_codes(wrong(tmp_path, changed(text, **changes))) == expected


def test_a_problem_of_a_plan_file_has_line_and_column(text: str, tmp_path: Path) -> None:
    line = next(i for i, line in enumerate(text.splitlines(), 1) if line.startswith('  "states": ['))
    damaged = text.replace('"cost": ', '"cosst": ', 1).splitlines()
    damaged[line] = damaged[line].replace("[", "[true, ", 1)
    problems = wrong(tmp_path, "\n".join(damaged))
    assert f"{line + 1}:6 states[0][0] type" in problems
    assert any(problem.endswith(":3 cosst unknown") for problem in problems)


def test_the_numbers_of_a_vehicle_in_code_may_be_those_of_numpy() -> None:
    numbers: dict[str, Any] = {
        "controls": {"throttle": (np.int64(0), np.float32(1.0)), "steering": np.array([-0.5, 0.5])},
        "parameters": {**MUSHR.parameters, "L": np.float32(0.25)},
        "footprint": Footprint(np.float32(0.5), np.float64(0.25)),
        "top_speed": np.float32(0.5),
        "delay": (np.float32(0.25), np.int64(1)),
    }
    vehicle = dataclasses.replace(MUSHR, **numbers)
    read = json.loads(dumps(vehicle_content(vehicle, "my.py")))
    assert read["controls"] == {"throttle": [0, 1.0], "steering": [-0.5, 0.5]}
    assert read["parameters"] == {**MUSHR.parameters, "L": 0.25}
    assert read["footprint"] == {"length": 0.5, "width": 0.25, "offset": 0.0}
    assert read["top_speed"] == 0.5
    assert plain_hash(vehicle.delay) == plain_hash((0.25, 1))


def test_a_repeated_key_is_a_problem(text: str, tmp_path: Path) -> None:
    assert wrong(tmp_path, text.replace('  "seed": 0,', '  "seed": 0, "seed": 1,')) == ["29:14 seed duplicate"]


def test_every_problem_comes_at_once(text: str, tmp_path: Path) -> None:
    problems = wrong(tmp_path, changed(text, controls=..., cost="x", goal=3))
    assert keys_and_codes(problems) == ["controls missing", "goal type", "cost type"]


def test_numbers_too_large_for_a_double_are_refused(text: str, tmp_path: Path) -> None:
    start = text.index('"durations": [') + len('"durations": [')
    for number in ("1e999", "1" + "0" * 400):
        problems = wrong(tmp_path, text[:start] + f"{number}, " + text[start:])
        assert "durations[0] value" in keys_and_codes(problems)


def test_a_plan_of_any_seed_is_read(tmp_path: Path) -> None:
    seed = 2**128
    (tmp_path / "plan.json").write_text(json.dumps({**SMALL, "seed": seed}))
    assert read_plan_file(tmp_path / "plan.json").seed == seed


def test_durations_whose_sum_is_too_large_for_a_double_are_refused(tmp_path: Path) -> None:
    twice = {"durations": [1e308, 1e308], "controls": [[0.5]] * 2, "states": [[0.0, 0.0]] * 3}
    problems = keys_and_codes(wrong(tmp_path, json.dumps({**SMALL, **twice})))
    assert problems == ["cost mismatch", "durations[0] value", "durations[1] value", "times mismatch"]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1), what=st.binary(max_size=6), cut=st.integers(0, 6))
def test_a_damaged_file_is_read_as_a_plan_or_refused_never_anything_else(
    place: float, what: bytes, cut: int, text: str, tmp_path: Path
) -> None:
    content = text.encode()
    at = int(place * len(content))
    path = tmp_path / "damaged.json"
    path.write_bytes(content[:at] + what + content[at + cut :])
    try:
        plan = read_plan(path)
    except InputError:
        return
    assert np.all(np.isfinite(plan.trajectory))
    assert plan.trajectory.shape == (len(plan.times), plan.states.shape[1])
    assert len(plan.states) == len(plan.durations) + 1 == len(plan.controls) + 1


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(keep=st.floats(0, 0.999))
def test_a_truncated_file_is_refused(keep: float, text: str, tmp_path: Path) -> None:
    assert wrong(tmp_path, text.encode()[: int(keep * (len(text) - 2))])


def test_a_plan_replaces_a_plan_and_nothing_else(
    tmp_path: Path, task: Task, mushr: Vehicle, result: PlanResult, text: str
) -> None:
    path = tmp_path / "plan.json"
    write_plan(path, task, mushr, result, ORIGIN)
    write_plan(path, task, mushr, result, ORIGIN)
    assert path.read_text() == text
    path.write_text('{"recipe": "soup"}')
    assert located(raised(lambda: write_plan(path, task, mushr, result, ORIGIN))) == ["exists"]
    assert path.read_text() == '{"recipe": "soup"}'
    assert located(raised(lambda: write_plan(tmp_path, task, mushr, result, ORIGIN))) == ["unwritable"]
