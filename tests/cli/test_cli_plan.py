"""`kraft plan`: what it prints, writes and answers, and that nothing wrong gets past it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT

from kraft.planning import compilation as kernel_cache
from kraft.planning.plan_file import read_plan
from kraft.text import no_messages
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main
from kraft_cli.work.plan import PlanRequest, notes, run_plan, vehicle_text
from ompl_ext.verification import Requirement, Verification, Violation

SCENE = """name: room
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {name: pillar, box: {center: [2, 2], size: [1, 1]}}
start: {x: 0.5, y: 0.5, heading_deg: 0}
goal: {center: [3, 3], radius: 0.3}
planning: {iterations: 500}
"""
KEYS = {
    "scenario", "planner", "seed", "solved", "cost_s", "first_solution_ms", "first_cost_s", "planning_ms", "iterations",
    "edges", "edges_per_s", "nodes", "min_clearance_m", "safe", "plan_file",
}  # fmt: skip
COLLISION = Violation(Requirement.COLLISION, "plan: collides")


@pytest.fixture(autouse=True)
def room(folder: Path) -> Path:
    path = folder / "room.yaml"
    path.write_text(SCENE)
    return path


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict[str, Any]:
    assert main(["plan", *arguments, "--json"]) == status
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_the_json_object_holds_what_was_promised(capsys: pytest.CaptureFixture[str]) -> None:
    content = run_json(capsys, "turns", "--iterations", "2000", "--seed", "5")
    assert content["schema"] == "kraft.plan/1"
    assert set(content) >= KEYS
    assert (content["scenario"], content["planner"], content["seed"]) == ("turns", "dirt", 5)
    assert content["solved"] is content["safe"] is True
    assert content["iterations"] == 2000
    assert content["edges"] == 2000 * 32
    assert content["first_cost_s"] >= content["cost_s"] > 8
    assert 0 < content["first_solution_ms"] <= content["planning_ms"]
    assert content["min_clearance_m"] > 0
    assert content["plan_file"] is None


def test_a_person_gets_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "room.yaml"]) == 0
    out, err = capsys.readouterr()
    rows = {line.split("  ")[0]: line.split("  ", 1)[1].strip() for line in out.splitlines()}
    assert rows["scenario"] == "room"
    parameters = load_vehicle("mushr").parameters
    assert rows["vehicle"] == f"mushr ({', '.join(f'{name} {value:g}' for name, value in parameters.items())})"
    assert rows["result"] == "solved"
    assert rows["clearance"].endswith("m at least, verified with FCL")
    assert {"plan", "first solution", "contingency", "search"} <= set(rows)
    assert err == ""


def test_of_many_parameters_those_that_are_0_are_counted() -> None:
    off = dict.fromkeys(
        ("dead_zone", "back_emf", "friction", "drag", "scrub", "understeer", "slide", "slip", "skid"), 0.0
    )
    vehicle = load_vehicle("car-lag", parameters=off)
    zero = [name for name, value in vehicle.parameters.items() if value == 0.0]
    assert len(zero) >= len(off)
    text = vehicle_text(vehicle)
    assert text.startswith("car-lag (full_throttle 1, ")
    assert text.endswith(f"; {len(zero)} others are 0)")
    assert "skid" not in text


def test_the_plan_file_is_written_where_asked_and_only_then(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_json(capsys, "room.yaml")
    assert {p.name for p in tmp_path.iterdir()} == {"room.yaml"}
    content = run_json(capsys, "room.yaml", "--out", "results/one")
    assert content["plan_file"] == "results/one/plan.json"
    assert read_plan(Path(content["plan_file"])).cost == content["cost_s"]


def test_a_plan_that_replaces_another_one_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    replaced = [run_json(capsys, "room.yaml", "--seed", seed, "--out", "plans")["replaced"] for seed in ("1", "1", "2")]
    assert replaced == [False, False, True]
    assert main(["plan", "room.yaml", "--seed", "3", "--out", "plans"]) == 0
    assert "plans/plan.json, instead of another plan that was there" in capsys.readouterr().out


def test_a_length_beside_the_contingency_is_said_to_be_its_clearance(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "room.yaml"]) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("contingency"))
    assert re.search(r" later, clearance \d\.\d+ m at least$", row)


def test_two_processes_write_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        command = [sys.executable, "-m", "kraft_cli", "plan", "room.yaml", "--seed", "7", "--out", folder, "-q"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(ROOT)])}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "a/plan.json").read_bytes() == (tmp_path / "b/plan.json").read_bytes()


def test_planning_continues_from_a_plan_file(capsys: pytest.CaptureFixture[str]) -> None:
    first = run_json(capsys, "room.yaml", "--out", "first")
    arguments = ("room.yaml", "--from", "first/plan.json", "--after", "1.5", "--iterations", "1")
    second = run_json(capsys, *arguments, "--out", "second")
    assert second["retained"] > 0
    assert second["cost_s"] == pytest.approx(first["cost_s"] - 1.5)
    assert json.loads(Path("second/plan.json").read_text())["from"]["file"] == "first/plan.json"


def test_a_picture_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("kraft.plot")
    assert main(["plan", "room.yaml", "--plot", "picture.svg"]) == 0
    assert "picture.svg" in capsys.readouterr().out
    assert (tmp_path / "picture.svg").read_text().startswith("<?xml")


def test_a_picture_says_what_was_planned_with(monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[dict[str, str]] = []
    monkeypatch.setattr("kraft.plot.plot_plan", lambda *_, notes, cycle: pages.append(notes))
    for more in ((), ("--set", "obstacles=[]", "--planner", "rrt", "--iterations", "1")):
        main(["plan", "room.yaml", "--vehicle", "mushr-lag", "--seed", "3", "--plot", "p.png", *more])
    assert [(page["vehicle"], page["planner"], page["seed"]) for page in pages] == [
        ("mushr-lag", "dirt", "3"), ("mushr-lag", "rrt", "3"),
    ]  # fmt: skip


def test_parameters_replace_those_of_the_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    slow = run_json(capsys, "room.yaml", "--param", "v_delta=0.3", "--param", "L=0.25")
    fast = run_json(capsys, "room.yaml", "--vehicle", "mushr")
    assert slow["cost_s"] > 1.5 * fast["cost_s"]


def test_a_model_that_exceeds_its_stated_top_speed_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    for speed, warned in (("0.6", False), ("0.9", True)):
        assert (
            main(["plan", "room.yaml", "--vehicle", "kraft.vehicles.mushr:MUSHR", "--param", f"v_delta={speed}"]) == 0
        )
        assert ("warning: the model of mushr reaches 0.9 m/s" in capsys.readouterr().err) is warned


def test_a_vehicle_of_ones_own_plans_at_full_speed(capsys: pytest.CaptureFixture[str]) -> None:
    content = run_json(capsys, "turns", "--vehicle", f"{ROOT}/examples/05_vehicle.py:VEHICLE", "--iterations", "3000")
    assert content["solved"] is True
    assert content["vehicle"] == "skid-steer"
    bundled = run_json(capsys, "turns", "--vehicle", "mushr", "--iterations", "3000")
    assert content["edges_per_s"] > 0.1 * bundled["edges_per_s"]  # compiled like a bundled one


def test_the_first_run_says_that_it_compiles_and_a_quiet_one_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kernel_cache, "is_cached", lambda _: False)
    assert main(["plan", "room.yaml"]) == 0
    lines = capsys.readouterr().err.splitlines()
    what = "compiling the checks for mushr for this machine, once"
    assert lines[0] == f"{what}: up to a minute, or some minutes if the machine is busy ..."
    assert lines[1].startswith("compiled in ")
    assert main(["plan", "room.yaml", "-q"]) == 0
    assert capsys.readouterr().err == ""


def test_no_plan_is_an_answer_with_its_reason_and_code_1(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room.write_text(SCENE.replace("size: [1, 1]", "size: [0.5, 4]"))
    content = run_json(capsys, "room.yaml", "--out", "out", status=1)
    assert (content["solved"], content["safe"], content["cost_s"], content["plan_file"]) == (False, False, None, None)
    assert content["iterations"] == 0
    assert not Path("out").exists()
    assert main(["plan", "room.yaml"]) == 1
    out, err = capsys.readouterr()
    assert "no plan" in out
    assert err.startswith("error: ")


def test_a_search_that_ends_too_early_names_the_options_of_a_longer_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "turns", "--iterations", "2"]) == 1
    assert capsys.readouterr().err.rstrip().endswith("; a longer search (--iterations, --time) may reach it")


def test_the_page_without_a_plan_says_why_and_not_how_long_that_took(room: Path) -> None:
    room.write_text(SCENE.replace("size: [1, 1]", "size: [0.5, 4]"))
    outcome = run_plan(PlanRequest("room.yaml"), no_messages)
    task, vehicle, result = outcome.task, outcome.vehicle, outcome.result
    assert result.plan is None
    assert notes(task, vehicle, result)["why there is no plan"] == result.reason
    slow = replace(result, reason="no edge after 3 iterations (7 s)", progress=replace(result.progress, seconds=7.0))
    assert notes(task, vehicle, slow)["why there is no plan"] == "no edge after 3 iterations"


def test_the_plan_that_ends_nearest_is_written_and_said_not_to_arrive(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "turns", "--iterations", "3", "--out", "out"]) == 1
    out, err = capsys.readouterr()
    assert "not solved; the plan ends nearest to the goal" in out
    assert err.startswith("error: ")
    assert read_plan(Path("out/plan.json")).reaches_goal is False


def test_a_plan_that_fails_verification_is_a_defect_and_not_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        import_module("kraft.planning.plan"), "verify", lambda *_: Verification(-1.0, None, (COLLISION,))
    )
    assert main(["plan", "room.yaml", "--out", "out"]) == 70
    out, err = capsys.readouterr()
    assert out == ""
    assert "plan: collides" in err
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "error: Missing argument 'SCENARIO'"),
        (["turn"], "turn: "),
        (["none.yaml"], "none.yaml: "),
        (["turns", "--iterations", "0"], "--iterations: "),
        (["turns", "--iterations", "-3"], "--iterations: "),
        (["turns", "--iterations", "1.5"], "--iterations: is '1.5'; "),
        (["turns", "--iterations", "1e5"], "--iterations: is '1e5'; "),
        (["turns", "--time", "0"], "--time: "),
        (["turns", "--time", "-1"], "--time: "),
        (["turns", "--time", "nan"], "--time: "),
        (["turns", "--time", "inf"], "--time: "),
        (["turns", "--time", "1", "--iterations", "5"], "--time: "),
        (["turns", "--seed", "-1"], "--seed: is -1; "),
        (["turns", "--threads", "65"], "--threads: is 65; "),
        (["turns", "--threads", "0"], "--threads: is 0; "),
        (["turns", "--planner", "dirty"], "--planner: "),
        (["turns", "--vehicle", "mushrr"], "mushrr: "),
        (["turns", "--param", "L"], "--param: "),
        (["turns", "--param", "L=nan"], "--param: "),
        (["turns", "--param", "L=0.3", "--param", "L=0.4"], "--param: "),
        (["turns", "--param", "L=-1"], "--param L: "),
        (["turns", "--vehicle", "mushr-lag", "--param", "L=-1"], "--param L: "),
        (["turns", "--param", "q=1", "--param", "L=-1"], "--param L: "),
        (["turns", "--param", "l=0.3"], "--param l: "),
        (["turns", "--plot", "picture.doc"], "picture.doc: "),
        (["turns", "--plot", "room.yaml/p.png"], "room.yaml/p.png: "),
        (["turns", "--out", "room.yaml"], "room.yaml/plan.json: "),
        (["turns", "--out", "/proc/x"], "/proc/x/plan.json: "),
        (["turns", "--plot", "/proc/x.png"], "/proc/x.png: "),
        (["turns", "--from", "none.json"], "none.json: "),
        (["turns", "--from", "room.yaml"], "room.yaml:1:1: "),
        (["turns", "--after", "1"], "--after: "),
        (["turns", "--threads", "2", "--planner", "rrt"], "--threads: "),
    ],
)  # fmt: skip
def test_bad_arguments_are_explained_without_planning(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["plan", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(expected)
    assert "Traceback" not in err
    assert {p.name for p in tmp_path.iterdir()} == {"room.yaml"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["room.yaml", "--from", "p/plan.json", "--after", "100"], "p/plan.json: the plan is over after "),
        (["room.yaml", "--from", "p/plan.json", "--vehicle", "jackal"], "p/plan.json: the plan has "),
        (["room.yaml", "--from", "p/plan.json", "--planner", "rrt"], "--planner: is 'rrt', which cannot keep "),
        (["room.yaml", "--set", "start.x=2", "--set", "start.y=2"], "room.yaml:5:8: start: "),
    ],
)  # fmt: skip
def test_what_needs_no_kernel_is_checked_before_anything_is_compiled(
    arguments: list[str], expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled before the request was checked")

    assert main(["plan", "room.yaml", "--out", "p"]) == 0
    capsys.readouterr()
    monkeypatch.setattr("kraft_cli.work.plan.ensure_all_compiled", compiled)
    assert main(["plan", *arguments]) == 2
    assert capsys.readouterr().err.startswith(expected)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_long_search_tells_what_it_has_done_and_its_plan_is_the_same(
    threads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["plan", "room.yaml", "--iterations", "3000", "--threads", threads, "--out"]
    assert main([*arguments, "a"]) == 0
    assert " iterations, " not in capsys.readouterr().err
    monkeypatch.setattr("kraft_cli.work.plan.PROGRESS_INTERVAL", 0.0)
    assert main([*arguments, "b"]) == 0
    lines = capsys.readouterr().err.splitlines()
    told = r"  0 s: [\d,]+ iterations?, [\d,]+ nodes?, (a plan of \d+\.\d\d s|no plan to the goal yet)"
    assert len(lines) > 1
    assert all(re.fullmatch(told, line) for line in lines)
    assert "a plan of" in lines[-1]
    assert main([*arguments, "c", "-q"]) == 0
    assert capsys.readouterr().err == ""
    assert len({(tmp_path / name / "plan.json").read_bytes() for name in "abc"}) == 1


def test_two_threads_share_the_iterations_and_write_the_same_plan_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = run_json(capsys, "room.yaml", "--threads", "2", "--iterations", "1501", "--out", "a")
    assert (content["threads"], content["iterations"], content["edges"]) == (2, 1501, 1501 * 32)
    run_json(capsys, "room.yaml", "--threads", "2", "--iterations", "1501", "--out", "b")
    texts = [(tmp_path / name / "plan.json").read_bytes() for name in "ab"]
    assert texts[0] == texts[1]
    assert json.loads(texts[0])["threads"] == 2


def test_a_map_larger_than_memory_is_refused_at_its_place_before_anything_runs(
    room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (room.parent / "m.pgm").write_bytes(b"P5 40 40 255\n" + bytes([254]) * 1600)
    (room.parent / "m.yaml").write_text("{image: m.pgm, resolution: 0.1, origin: [0, 0, 0]}\n")
    room.write_text(SCENE.replace("  - {name: pillar", "  - map: {file: m.yaml}\n  - {name: pillar"))
    monkeypatch.setattr("ompl_ext.memory.available_memory", lambda: 1_000_000)
    assert main(["plan", "room.yaml"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("room.yaml:4:")
    assert "obstacles[0].map" in err
    assert "memory" in err


def test_the_memory_of_the_maps_is_said_before_it_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "room.yaml", "-v"]) == 0
    said = capsys.readouterr().err
    assert said.index("the maps need at most") < said.index("planned, with maps")


def test_a_plan_of_another_scenario_is_noted(capsys: pytest.CaptureFixture[str]) -> None:
    run_json(capsys, "room.yaml", "--out", "out")
    assert main(["plan", "room.yaml", "--from", "out/plan.json"]) == 0
    assert "note:" not in capsys.readouterr().err
    text = Path("out/plan.json").read_text()
    Path("other.json").write_text(text.replace('"name": "room"', '"name": "hall"'))
    assert main(["plan", "room.yaml", "--from", "other.json"]) == 0
    err = capsys.readouterr().err
    assert all(name in err for name in ("note: ", "other.json", "hall", "room"))


def test_verbose_tells_with_what_it_plans_and_how_long_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "room.yaml", "--param", "L=0.3", "--iterations", "500", "--out", "out", "-v"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "scenario room: room.yaml"
    assert lines[1].startswith("vehicle mushr: L 0.3, ")
    assert any(re.match(r"kernels (read from|compiled into) .*kernels", line) for line in lines)
    assert "planner dirt: 500 iterations, seed 0" in lines
    stages = [line for line in lines if re.search(r" in \d+\.\d{3} s$", line)]
    assert [line.split(" in ")[0] for line in stages] == [
        "loaded and checked", "planned, with maps and verification,", "written and drawn",
    ]  # fmt: skip
    assert main(["plan", "room.yaml"]) == 0
    assert capsys.readouterr().err == ""


def test_every_place_that_is_taken_is_told_before_planning(capsys: pytest.CaptureFixture[str]) -> None:
    Path("g.png").mkdir()
    Path("out/plan.json").mkdir(parents=True)
    assert main(["plan", "room.yaml", "--plot", "g.png", "--out", "out"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert [line.split(":")[0] for line in err.splitlines()] == ["g.png", "out/plan.json"]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("x: 0.5, y: 0.5", "x: 2, y: 2", "room.yaml:5:8: start: "),
        ("x: 0.5, y: 0.5", "x: 9, y: 2", "room.yaml:5:12: start.x: "),
        ("x: 0.5, y: 0.5", "x: .nan, y: 2", "room.yaml:5:12: start.x: "),
        ("center: [3, 3]", "center: [2, 2]", "room.yaml:6:16: goal.center: "),
        ("center: [3, 3]", "center: [3, 9]", "room.yaml:6:16: goal.center: "),
        ("size: [1, 1]", "size: [1, 0]", "room.yaml:4:52: obstacles[0].box.size[1]: "),
        ("x: [0, 4]", "x: [4, 0]", "room.yaml:2:13: bounds.x: "),
        ("iterations: 500", "iterations: 0", "room.yaml:7:24: planning.iterations: "),
        ("planning:", "planing:", "room.yaml:7:1: planing: "),
        ("radius: 0.3", "radius: wide", "room.yaml:6:32: goal.radius: "),
        ("iterations: 500}", "iterations: 500}\nvehicle: none.py:CAR", "room.yaml:8:10: vehicle: "),
        ("box: {center: [2, 2], size: [1, 1]}", "map: {file: floor.yaml}", "room.yaml:4:32: obstacles[0].map.file: "),
    ],
)  # fmt: skip
def test_a_bad_scenario_is_explained_at_its_place(
    old: str, new: str, expected: str, room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert old in SCENE
    room.write_text(SCENE.replace(old, new, 1))
    assert main(["plan", "room.yaml", "--out", "out"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(expected)
    assert not Path("out").exists()


def test_validate_finds_what_planning_would(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room.write_text(SCENE.replace("x: 0.5, y: 0.5", "x: 2, y: 2"))
    assert main(["validate", "room.yaml"]) == 2
    assert "room.yaml:5:8: start: " in capsys.readouterr().err
    boxes = [((3, 3.9), (1.2, 0.1)), ((3, 2.7), (1.2, 0.1)), ((2.4, 3.3), (0.1, 1.3)), ((3.6, 3.3), (0.1, 1.3))]
    ring = ", ".join(f"{{box: {{center: {list(center)}, size: {list(size)}}}}}" for center, size in boxes)
    enclosed = (
        "name: a\nbounds: {x: [0, 5], y: [0, 5]}\nobstacles: [" + ring + "]\nstart: {x: 1, y: 1, heading_deg: 90}\n"
    )
    room.write_text(enclosed + "goal: {center: [3, 3.3], radius: 0.2}\nvehicle: mushr\n")
    assert main(["validate", "room.yaml"]) == 2
    assert "room.yaml:5:7: goal: " in capsys.readouterr().err
    (room.parent / "car.yaml").write_text(
        "name: a\nmodel: none.py:CAR\nfootprint: {length: 1, width: 1}\ntop_speed: 1\n"
    )
    assert main(["validate", "car.yaml"]) == 2
    assert "car.yaml:2:8: model: " in capsys.readouterr().err


def test_a_file_that_is_no_plan_is_not_overwritten(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/plan.json").write_text("{}")
    assert main(["plan", "room.yaml", "--out", "out"]) == 2
    assert "out/plan.json: " in capsys.readouterr().err
    assert Path("out/plan.json").read_text() == "{}"
