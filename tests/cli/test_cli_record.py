"""`kraft record`: logs that appear whole, repeat bit for bit, and are never written over."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from support.evaluation import places
from support.paths import ROOT
from support.recorded import contents

from kraft.config import bundled
from kraft.driving.car_model import model_of
from kraft.recording import experiment, recorder
from kraft.recording.recorder import Recorder, Recording
from kraft.scenario import load_scenario
from kraft.sysid.information import known_before
from kraft.sysid.interface import Noise
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main
from kraft_cli.work import record as request
from kraft_cli.work.next_drives import load_prior
from ompl_ext.vehicle import Vehicle

FILES = {"commands.csv", "poses.csv", "truth.csv", "manifest.json"}


def test_each_run_is_a_folder_with_what_was_driven(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "2", "--seed", "4", "--json"]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert (content["schema"], content["scenario"], content["seed"], content["folder"]) == (
        "kraft.record/1", "training", 4, "logs",
    )  # fmt: skip
    assert [run["folder"] for run in content["runs"]] == ["logs/run_01", "logs/run_02"]
    assert [line for line in err.splitlines() if "/2  " in line] == [
        "1/2  logs/run_01: straight, 20.0 s, 601 poses",
        "2/2  logs/run_02: left, 20.0 s, 601 poses",
    ]
    assert {path.name for path in Path("logs").iterdir()} == {"run_01", "run_02"}
    run = Recorder(load_scenario("training"), load_vehicle("mushr"), 4).record(2)
    expected = {"commands": run.commands, "poses": run.poses, "truth": run.truth}
    headings = {"commands": "t,throttle,steering", "poses": "t,x,y,yaw", "truth": "t,x,y,yaw,speed"}
    assert {path.name for path in Path("logs/run_02").iterdir()} == FILES
    for name, rows in expected.items():
        heading, *lines = csv.reader(Path(f"logs/run_02/{name}.csv").read_text().splitlines())
        assert ",".join(heading) == headings[name]
        assert [[float(cell) for cell in line] for line in lines] == rows.tolist()
    manifest = json.loads(Path("logs/run_02/manifest.json").read_text())
    assert (manifest["schema"], manifest["run"], manifest["manoeuvre"]) == ("kraft.record/1", 2, "left")
    assert manifest["arguments"] == {"scenario": "training", "runs": 2, "seed": 4}


def test_the_same_seed_writes_the_same_bytes_and_more_runs_keep_the_first(folder: Path) -> None:
    assert main(["record", "--runs", "1", "--out", "a", "-q"]) == 0
    assert main(["record", "--runs", "1", "--out", "b", "-q"]) == 0
    assert main(["record", "--runs", "2", "--out", "c", "-q"]) == 0
    assert contents(folder / "a") == contents(folder / "b")
    first, second = contents(folder / "a" / "run_01"), contents(folder / "c" / "run_01")
    assert first.keys() == second.keys() == FILES
    assert all(first[name] == second[name] for name in FILES - {"manifest.json"})


@pytest.mark.parametrize(("vehicle", "model"), [("jackal", ""), ("mushr-lag", ""), ("unicycle2", " --model unicycle2")])
def test_the_command_that_identifies_the_vehicle_names_it_if_its_commands_do_not_tell(
    vehicle: str, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--runs", "1", "--vehicle", vehicle, "-q"]) == 0
    assert capsys.readouterr().out == f"1 log in logs; kraft sysid logs{model} identifies the vehicle from them\n"


def test_logs_are_never_written_over(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "1"]) == 0
    before = contents(folder)
    capsys.readouterr()
    assert main(["record", "--runs", "1", "--seed", "1"]) == 2
    assert places(capsys.readouterr().err) == ["logs"]
    assert contents(folder) == before


def test_an_interrupt_keeps_the_finished_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = Recorder.record

    def interrupted(self: Recorder, number: int) -> object:
        if number == 2:
            raise KeyboardInterrupt
        return record(self, number)

    monkeypatch.setattr(Recorder, "record", interrupted)
    assert main(["record", "--runs", "3"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        "stopped; 1 of 3 runs kept in logs; to resume: kraft record --out logs --resume"
    )
    assert {path.name for path in (folder / "logs").iterdir()} == {"run_01"}
    assert {path.name for path in (folder / "logs" / "run_01").iterdir()} == FILES


def test_a_run_that_cannot_be_written_leaves_no_part_of_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("kraft.files.os.rename", full)
    assert main(["record", "--runs", "1"]) == 2
    assert places(capsys.readouterr().err)[-1] == "logs/run_01"
    assert list((folder / "logs").iterdir()) == []


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_disk_is_explained_with_the_command_that_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first file of the second run cannot be written: its own name is that of a folder which is there no more."""

    def recorded(self: Recorder, number: int, *drive: object) -> Recording:
        if number == 2:
            monkeypatch.setattr("kraft.files.os.replace", full)
        return record(self, number, *drive)  # type: ignore[arg-type]

    record = Recorder.record
    monkeypatch.setattr(Recorder, "record", recorded)
    assert main(["record", "--runs", "3"]) == 2
    err = capsys.readouterr().err.splitlines()
    assert err[-2] == "1 of 3 runs kept in logs; to resume: kraft record --out logs --resume"
    assert re.fullmatch(r"logs/run_02/\w+\.\w+: cannot be written: No space left on device; expected .*", err[-1])


def test_a_run_that_ends_early_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "turns", "--runs", "1", "--json"]) == 0
    out, err = capsys.readouterr()
    (run,) = json.loads(out)["runs"]
    assert run["duration_s"] < 20
    assert run["note"].startswith("stopped after ")
    assert f"; {run['note']}" in err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["trainin"], "trainin"),
        (["--runs", "0"], "--runs"),
        (["--seed", "-1"], "--seed"),
        (["--out", "."], "."),
        (["--out", "/proc/x"], "/proc/x"),
        (["--for", "mushr-lag", "--runs", "21"], "--runs"),
        (["--for", "mushr-lag", "--commands", "logs.csv"], "--for logs.csv"),
        (["--commands", "x", "--runs", "2"], "--runs x"),
        (["--commands", "none.csv"], "none.csv"),
        (["--for", "jackal"], "jackal"),
        (["--for", "kraft.vehicles.mushr:MUSHR_LAG"], "kraft.vehicles.mushr:MUSHR_LAG"),
    ],
)
def test_bad_arguments_are_explained_without_driving(
    arguments: list[str], expected: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert places(err) == expected.split()
    assert list(folder.iterdir()) == []


def test_every_option_key_and_default_of_kraft_record_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "record.md").read_text(encoding="utf-8")
    assert main(["record", "--help"]) == 0
    options = set(re.findall(r"(?<![\w-])--[a-z]+", capsys.readouterr().out)) - {"--help"}
    assert options
    assert options <= set(re.findall(r"--[a-z]+", text))
    assert f"{request.RUNS} by default" in text
    assert main(["record", "--runs", "1", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    manifest = json.loads(Path("logs/run_01/manifest.json").read_text())
    keys = {*content, *content["runs"][0], *manifest}
    assert keys <= set(re.findall(r"`(\w+)`", text))


def test_recommended_drives_are_driven_and_their_commands_can_be_driven_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment, "FIRST", 10)
    monkeypatch.setattr(experiment, "ROUNDS", 0)
    assert main(["record", "--for", "mushr-lag", "--runs", "1", "--out", "planned"]) == 0
    lines = capsys.readouterr().err.splitlines()
    first = lines.index("planned drive 1 of 1:") + 1
    assert sum(line.startswith("  ") for line in lines[first : first + 2]) == 2, "a line for each step"
    assert max(map(len, lines[first : first + 4])) <= 100
    manifest = json.loads(Path("planned/run_01/manifest.json").read_text())
    assert (manifest["manoeuvre"], manifest["note"], manifest["arguments"]["for"]) == ("planned", "", "mushr-lag")
    sent = Path("planned/run_01/commands.csv").read_text()
    assert main(["record", "--commands", "planned", "--out", "again", "-q"]) == 0
    assert Path("again/run_01/commands.csv").read_text() == sent
    assert json.loads(Path("again/run_01/manifest.json").read_text())["manoeuvre"] == "run_01"


def test_planned_drives_that_end_early_say_what_was_lost_and_how_to_get_more(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment, "FIRST", 10)
    monkeypatch.setattr(experiment, "ROUNDS", 0)
    arguments = ["record", "--vehicle", "mushr-lag", "--for", "mushr-lag", "--runs", "1"]
    assert main([*arguments, "--out", "whole"]) == 0
    assert "ended early" not in capsys.readouterr().err
    end = json.loads((folder / "whole/run_01/manifest.json").read_text())["end"]
    monkeypatch.setattr(recorder, "STOP", 100.0)  # as if an obstacle were everywhere
    assert main([*arguments, "--out", "short"]) == 0
    *_, line = capsys.readouterr().err.splitlines()
    assert re.match(rf"1 of 1 planned drive ended early \(after 0\.\d of {end:.1f} s\): ", line)
    assert "larger bounds" in line
    assert "kraft record without --for" in line


def test_the_commands_that_the_documentation_states_brake_and_drive_backwards(folder: Path) -> None:
    (rows,) = re.findall(r"```\n(t,throttle,steering\n.*?)```", (ROOT / "docs/record.md").read_text(), re.DOTALL)
    (folder / "back.csv").write_text(rows)
    assert main(["record", "--vehicle", "mushr-drive", "--commands", "back.csv", "--out", "back"]) == 0
    assert json.loads((folder / "back/run_01/manifest.json").read_text())["note"] == ""
    columns = {}
    for name, key in (("commands", "throttle"), ("truth", "speed")):
        with (folder / f"back/run_01/{name}.csv").open() as file:
            columns[key] = [float(row[key]) for row in csv.DictReader(file)]
    assert min(columns["throttle"]) == -0.5
    assert min(columns["speed"]) < -0.1


def test_a_model_without_priors_is_refused_at_its_parameters(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "configs" / "vehicles" / "mushr-lag.yaml").read_text(encoding="utf-8")
    (folder / "bare.yaml").write_text(text.replace(", std: 0.2", "").split("identification:")[0], encoding="utf-8")
    assert main(["record", "--for", "bare.yaml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"bare.yaml:\d+:\d+: parameters.v_delta: has no std; ", line)


SLED = """from ompl_ext import Footprint, Vehicle, cos, derivative, sin
from ompl_ext.vehicle import ParameterRange


@derivative
def motion(x, u, p):
    (_, _, theta, v), (push, turn), (gain, lag) = x, u, p
    return v * cos(theta), v * sin(theta), turn * v, (gain * push - v) / lag


SLED = Vehicle(
    name="sled", derivative=motion, state=("x", "y", "theta", "v"), rest=("v",), top_speed=1.0,
    controls={"push": (-0.5, 1.0), "turn": (-1.0, 1.0)}, parameters={"gain": 0.9, "lag": 0.4},
    footprint=Footprint(0.4, 0.3),
    ranges={"gain": ParameterRange(0.3, 2.0, 0.2), "lag": ParameterRange(0.1, 1.0, 0.1)},
)
"""


def test_drives_are_planned_from_the_priors_that_code_states(folder: Path) -> None:
    (folder / "sled.py").write_text(SLED, encoding="utf-8")
    base = load_prior("sled.py:SLED", None)
    assert isinstance(base, Vehicle)
    narrow = load_prior("sled.py:SLED", replace(base, controls={"push": (0.0, 0.5), "turn": (-2.0, 2.0)}))
    assert isinstance(narrow, Vehicle)
    assert narrow.controls == {"push": (0.0, 0.5), "turn": (-1.0, 1.0)}
    known = known_before(base, Noise(0.005, 0.02), 30.0)
    assert known.parameters.std.tolist() == [0.2, 0.1]


def test_code_that_states_some_priors_alone_is_refused_with_the_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "sled.py").write_text(SLED.replace(', "lag": ParameterRange(0.1, 1.0, 0.1)', ""), encoding="utf-8")
    assert main(["record", "--vehicle", "sled.py:SLED", "--for", "sled.py:SLED"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sled.py:SLED: states no min, max and std of lag; expected ranges=")


def test_controls_that_no_manoeuvre_uses_are_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lifts = SLED.replace("(push, turn), (gain, lag)", "(push, turn, lift), (gain, lag)")
    lifts = lifts.replace('"turn": (-1.0, 1.0)}', '"turn": (-1.0, 1.0), "lift": (0.0, 1.0)}')
    (folder / "sled.py").write_text(lifts, encoding="utf-8")
    assert main(["record", "--vehicle", "sled.py:SLED", "--runs", "1"]) == 0
    assert "warning: no manoeuvre uses lift, which" in capsys.readouterr().err
    assert main(["record", "--vehicle", "sled.py:SLED", "--commands", "logs", "--out", "again"]) == 0
    assert "no manoeuvre uses" not in capsys.readouterr().err


@pytest.mark.parametrize("name", bundled.names("vehicle"))
def test_manoeuvres_use_every_control_of_a_bundled_vehicle(name: str) -> None:
    assert request.unused_controls(model_of(load_vehicle(name))) == ""
