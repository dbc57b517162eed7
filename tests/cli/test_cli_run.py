"""`kraft run`: one trial, told cycle by cycle and written as a folder."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.evaluation import places
from support.paths import ROOT

from kraft.config import bundled
from kraft.driving.method import load_method
from kraft.errors import InputError
from kraft.evaluation.journal import digest
from kraft.planning.compilation import Needs
from kraft.scenario import load_scenario
from kraft.trial.result import TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main
from kraft_cli.work.run import RunRequest, cycle_line, cycles_text, outside_bounds, run_scenario, run_table
from ompl_ext.vehicle import Vehicle

KEYS = {
    "scenario", "method", "seed", "outcome", "t_ex_s", "cycles", "contingencies", "min_clearance_m", "planning_ms_p50",
    "planning_ms_p99",
}  # fmt: skip
SHORT = """name: short
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {name: pillar, box: {center: [2, 2.5], size: [0.5, 0.5]}}
start: {x: 0.6, y: 1, heading_deg: 0}
goal: {center: [2.4, 1], radius: 0.4}
"""


@pytest.fixture(autouse=True)
def short(folder: Path) -> Path:
    (folder / "short.yaml").write_text(SHORT)
    return folder / "short.yaml"


def test_the_json_object_holds_what_was_promised(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "short.yaml", "--seed", "4", "--json"]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["schema"] == "kraft.run/1"
    assert set(content) >= KEYS
    assert (content["scenario"], content["method"], content["seed"]) == ("short", "kraft", 4)
    assert content["outcome"] == "success"
    assert 1 < content["t_ex_s"] < 20
    assert 0 < content["planning_ms_p50"] <= content["planning_ms_p99"]
    assert content["first_plan_ms"] > 0
    assert content["min_clearance_m"] > 0
    assert content["folder"] is None
    told = [line for line in err.splitlines() if " m/s " in line]
    assert len(told) == content["cycles"]
    assert sum("contingency" in line for line in told) == content["contingencies"]
    assert not [path for path in Path().iterdir() if path.is_dir()]


def test_a_person_gets_a_table_and_quiet_leaves_only_that(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "short.yaml", "-q"]) == 0
    out, err = capsys.readouterr()
    rows = {line.split("  ")[0]: line.split("  ", 1)[1].strip() for line in out.splitlines()}
    assert (rows["scenario"], rows["method"], rows["vehicle"]) == ("short", "KRAFT", "mushr-drive")
    assert re.fullmatch(r"success after \d\.\d\d s", rows["result"])
    assert err == ""


def test_the_table_repeats_a_warning_of_before_the_drive(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "configs" / "vehicles" / "f1tenth.yaml").read_text(encoding="utf-8")
    Path("mine.yaml").write_text("\n".join(line for line in text.splitlines() if not line.startswith("truth:")))
    main(["run", "short.yaml", "--vehicle", "mine.yaml"])
    out, err = capsys.readouterr()
    (told,) = [line.removeprefix("warning: ") for line in err.splitlines() if line.startswith("warning: ")]
    assert re.search(rf"^warning +{re.escape(told)}$", out, re.MULTILINE)
    assert err.index(told) < err.index(" m/s  to goal "), "before the first cycle too"


def test_a_cycle_that_the_trial_ends_before_is_counted_and_said_to_be_not_driven() -> None:
    run = run_scenario(RunRequest("short.yaml"), lambda _: None)
    cycles, ahead = run.result.cycles, replace(run.result, time=run.result.cycles[-1].time - 0.05)
    assert cycles_text(replace(run.result, time=cycles[-1].time)) == f"{len(cycles)}, 0 of them with the contingency"
    assert cycles_text(ahead).startswith(f"{len(cycles)}, ")
    assert cycles_text(ahead).endswith("; 1 decided, but not begun before the end")


def test_the_folder_holds_every_tick_cycle_and_observation(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "short.yaml", "--seed", "1", "--out", "runs/one", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    folder = Path("runs/one")
    assert {path.name for path in folder.iterdir()} == {
        "manifest.json", "steps.csv", "cycles.jsonl", "observations.csv", "result.json",
    }  # fmt: skip
    assert json.loads((folder / "result.json").read_text()) == content
    spec = TrialSpec(load_scenario("short.yaml"), load_method("kraft"), load_vehicle("mushr-drive"), 1)
    result = run_trial(spec)
    steps = list(csv.reader((folder / "steps.csv").read_text().splitlines()))
    assert steps[0] == [
        "time", "x", "y", "theta", "speed", "estimate_x", "estimate_y", "estimate_theta", "estimate_v",
        "command_throttle", "command_steering", "cycle",
    ]  # fmt: skip
    expected = [[s.time, *s.pose, s.speed, *s.estimate, *s.command, s.cycle] for s in result.steps]
    assert [[float(cell) for cell in row] for row in steps[1:]] == expected
    cycles = [json.loads(line) for line in (folder / "cycles.jsonl").read_text().splitlines()]
    assert [cycle["time"] for cycle in cycles] == [cycle.time for cycle in result.cycles]
    assert [cycle["reference"]["states"] for cycle in cycles] == [c.reference.states.tolist() for c in result.cycles]
    seen = list(csv.reader((folder / "observations.csv").read_text().splitlines()))
    assert seen[0] == ["time", "arrival", "x", "y", "theta"]
    assert len(seen) == len(result.observations) + 1
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["schema"], manifest["seed"]) == ("kraft.run-manifest/1", 1)


def test_the_same_seed_drives_the_same_and_another_seed_differently() -> None:
    def driven(seed: int) -> str:
        return digest(run_scenario(RunRequest("short.yaml", seed=seed), lambda _: None).result)

    assert driven(2) == driven(2) != driven(3)


def test_each_cycle_is_reported_when_it_is_committed() -> None:
    told: list[str] = []
    run = run_scenario(
        RunRequest("short.yaml", "oneshot-openloop"), told.append, lambda cycle: told.append(cycle_line(cycle))
    )
    assert told[-len(run.result.cycles) :] == [cycle_line(cycle) for cycle in run.result.cycles]
    assert re.match(r"  0\.00 s   0\.00 m/s  to goal  \d\.\d\d s  clearance \d\.\d{3} m  plan", told[-1])


def test_a_goal_that_is_not_reached_ends_with_1(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short.write_text(SHORT + "trial: {timeout: 1.5, oneshot_timeout: 1.5}\n")
    assert main(["run", "short.yaml", "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert (content["outcome"], content["t_ex_s"]) == ("timeout", pytest.approx(1.5))


def test_a_collision_names_what_was_hit(short: Path) -> None:
    """Blind driving on a floor that steers the car to one side ends at the wall or the box."""
    text = SHORT.replace("center: [2, 2.5]", "center: [1.9, 1.42]")
    short.write_text(text + "truth: {vehicle: {steering_offset_deg: 12}}\n")
    run = run_scenario(RunRequest("short.yaml", "oneshot-openloop"), lambda _: None)
    assert run.result.outcome == "collision"
    assert dict(run_table(run))["result"].startswith("collision with pillar after ")


BENCHMARK = bundled.folder("vehicle") / "benchmark.yaml"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["short.yaml", "--method", "krft"], ["krft"]),
        (["shrt"], ["shrt"]),
        (["short.yaml", "--vehicle", "mushrr"], ["mushrr"]),
        (["short.yaml", "--method", "adaptive-kraft", "--vehicle", "benchmark"], [f"{BENCHMARK}:10:3"]),
        (["short.yaml", "--seed", "-1"], ["--seed"]),
        (["short.yaml", "--method", ""], ["--method"]),
        (["short.yaml", "--out", "."], ["."]),
        (["short.yaml", "--out", "short.yaml/run"], ["short.yaml/run"]),
        (["short.yaml", "--out", "/proc/x"], ["/proc/x"]),
        (["short.yaml", "--video", "/proc/x.mp4", "--plot", "/proc/x.png"], ["/proc/x.mp4", "/proc/x.png"]),
    ],
)
def test_bad_arguments_are_explained_without_driving(
    arguments: list[str], expected: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert places(err) == expected
    assert [path.name for path in Path().iterdir()] == ["short.yaml"]


def test_verbose_tells_with_what_it_drives_and_how_long_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "short.yaml", "-v"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "scenario short: short.yaml"
    assert lines[1].startswith("method kraft: ")
    assert lines[2].startswith("replanning, kinodynamic at ")
    assert lines[3].startswith("vehicle mushr-drive: L ")
    assert re.fullmatch(r"loaded and checked in \d+\.\d{3} s", lines[6])
    assert re.fullmatch(r"\d+\.\d{2} s driven in \d+\.\d{3} s", lines[-1])


def test_a_goal_that_no_path_leads_to_is_reported_before_the_drive(
    short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short.write_text(SHORT.replace("center: [2, 2.5], size: [0.5, 0.5]", "center: [1.5, 2], size: [0.2, 4]"))
    for command in (["run"], ["eval", "--trials", "1", "--methods", "kraft,oneshot-openloop"]):
        assert main([*command, "short.yaml", "--out", "out"]) == 1
        assert capsys.readouterr() == ("", (
            "short.yaml:6:7: goal: the goal is unreachable: no path from the start is wide enough for the footprint; "
            "expected a goal that the vehicle can get to\n"
        ))  # fmt: skip
        assert not Path("out").exists()
        assert main([*command, "short.yaml", "--out", "out", "--json"]) == 1
        content = json.loads(capsys.readouterr().out)
        assert content["schema"] == f"kraft.{command[0]}/1"
        assert content["reason"] == content["problems"][0]["problem"]
        assert (content["problems"][0]["line"], content["problems"][0]["column"]) == (6, 7)


@pytest.mark.parametrize("command", ["run", "eval"])
@pytest.mark.parametrize(
    ("package", "options"),
    [("casadi", ["--method", "nmpc"]), ("cv2", ["--set", "sensing.preset=rendered", "--method", "kraft"])],
)
def test_a_missing_extra_is_told_before_anything_is_compiled(
    command: str, package: str, options: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled before the packages were checked")

    monkeypatch.setitem(sys.modules, package, None)
    for compilation in ("kraft_cli.work.run.ensure_all_compiled", "kraft.evaluation.evaluator.ensure_all_compiled"):
        monkeypatch.setattr(compilation, compiled)
    options = [option.replace("--method", "--methods" if command == "eval" else "--method") for option in options]
    assert main([command, "turns", *options]) == 3
    assert f"[{'mpc' if package == 'casadi' else 'vision'}]" in capsys.readouterr().err


@pytest.mark.parametrize(("method", "poses"), [("kraft", False), ("adaptive-kraft", True)])
@pytest.mark.parametrize("command", ["run", "eval"])
def test_what_the_method_plans_with_is_compiled_before_the_drive(
    command: str, method: str, poses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs: list[Needs] = []

    def compiled(found: Iterable[Needs], _: object) -> None:
        needs.extend(found)
        raise InputError.of("test", "ends here", "expected nothing")

    monkeypatch.setattr("kraft_cli.work.run.ensure_all_compiled", compiled)
    monkeypatch.setattr("kraft.evaluation.evaluator.ensure_all_compiled", compiled)
    assert main([command, "short.yaml", "--method" if command == "run" else "--methods", method]) == 2
    assert [each.poses for each in needs] == [poses]


@pytest.mark.parametrize("command", ["run", "eval"])
def test_what_the_check_of_a_goal_with_limits_compiles_is_told(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(vehicle: Vehicle, report: Callable[[str], None]) -> None:
        report(f"compiling for {vehicle.name}")

    monkeypatch.setattr("kraft.evaluation.experiment.ensure_compiled", compiled)
    limits = ["--set", "goal.limits={v: [9, 10]}"]  # is refused after the check
    assert main([command, "short.yaml", "--vehicle", "mushr-lag", *limits]) == 2
    assert capsys.readouterr().err.startswith("compiling for mushr-lag\n")


def test_every_place_that_is_taken_is_reported_before_the_drive(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("out", "g.png", "g.mp4"):
        Path(name).mkdir()
    assert main(["run", "short.yaml", "--out", "out", "--plot", "g.png", "--video", "g.mp4"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert places(err) == ["g.mp4", "g.png", "out"]


def test_every_option_and_key_of_kraft_run_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "run.md").read_text(encoding="utf-8")
    assert main(["run", "--help"]) == 0
    options = set(re.findall(r"(?<![\w-])--[a-z]+", capsys.readouterr().out)) - {"--help"}
    assert options
    assert options <= set(re.findall(r"--[a-z]+", text))
    content: dict[str, Any] = {}
    main(["run", "short.yaml", "--out", "o", "--json"])
    content = json.loads(capsys.readouterr().out)
    cycle = json.loads(Path("o/cycles.jsonl").read_text().splitlines()[0])
    assert set(content) | set(cycle) <= set(re.findall(r"`(\w+)`", text))


def test_a_car_that_leaves_the_bounds_is_said_to(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario, vehicle = load_scenario(short), load_vehicle("mushr")
    poses = np.array([[1.0, 2.0, 0.0], [3.9, 2.0, 0.5 * math.pi], [3.9, 2.0, 0.0]])
    steps = tuple(SimpleNamespace(pose=pose) for pose in poses)
    half = vehicle.footprint.length / 2 + vehicle.footprint.offset
    for count, outside in ((1, 0.0), (2, vehicle.footprint.width / 2 - 0.1), (3, half - 0.1)):
        result = SimpleNamespace(steps=steps[:count])
        assert outside_bounds(scenario, vehicle.footprint, result) == pytest.approx(outside)  # type: ignore[arg-type]
    assert main(["run", "short.yaml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["outside_m"] == 0.0


def test_a_picture_that_cannot_be_written_does_not_cost_the_results(
    short: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise InputError.of("my.png", "cannot be written: No space left on device", "expected enough space")

    monkeypatch.setattr("kraft_cli.work.trial_outputs.TrialOutputs.finish", full)
    assert main(["run", str(short), "--method", "oneshot-openloop", "--plot", "my.png", "--out", "out"]) == 2
    assert "my.png: cannot be written" in capsys.readouterr().err
    assert json.loads(Path("out/result.json").read_text())["schema"] == "kraft.run/1"
