"""`kraft record --resume` continues where a recording was interrupted, to the same bytes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from pathlib import Path

import pytest
from support.evaluation import places
from support.recorded import contents

from kraft.recording import experiment
from kraft.recording.recorder import Recorder, Recording
from kraft_cli.main import main
from kraft_cli.work import record as request


def interrupted(patch: pytest.MonkeyPatch, before: int, *arguments: str) -> None:
    """Record into logs until run `before` begins."""
    record = Recorder.record

    def stopping(self: Recorder, number: int, *drive: object) -> Recording:
        if number == before:
            raise KeyboardInterrupt
        return record(self, number, *drive)  # type: ignore[arg-type]

    with patch.context() as stopped:
        stopped.setattr(Recorder, "record", stopping)
        assert main(["record", *arguments]) == 130


def test_a_resumed_recording_has_the_bytes_of_an_uninterrupted_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--runs", "3", "--seed", "7", "--vehicle", "mushr"]
    assert main(["record", *arguments, "--out", "whole", "--bag", "whole.mcap"]) == 0
    interrupted(monkeypatch, 2, *arguments, "--bag", "logs.mcap")
    command = "kraft record --out logs --bag logs.mcap --resume"
    assert capsys.readouterr().err.splitlines()[-1] == f"stopped; 1 of 3 runs kept in logs; to resume: {command}"
    before = contents(folder / "logs")
    left = folder / "logs" / ".run_02.x1.part"  # what a kill leaves
    left.mkdir()
    (left / "commands.csv").write_text("t,throttle\n")
    (folder / "logs_01.mcap").unlink()  # as after a kill between the run and its bag
    assert main([*command.split()[1:], "--json"]) == 0
    out, err = capsys.readouterr()
    assert [line for line in err.splitlines() if "/3  " in line] == [
        "2/3  logs/run_02: left, 20.0 s, 601 poses", "3/3  logs/run_03: right, 20.0 s, 601 poses",
    ]  # fmt: skip
    content = json.loads(out)
    assert [run["kept"] for run in content["runs"]] == [True, False, False]
    assert (content["runs"][0]["poses"], content["runs"][0]["duration_s"]) == (601, 20.0)
    assert contents(folder / "logs") == contents(folder / "whole")
    assert before.items() <= contents(folder / "logs").items()
    assert not left.exists()
    for number in (1, 2, 3):
        assert Path(f"logs_{number:02d}.mcap").read_bytes() == Path(f"whole_{number:02d}.mcap").read_bytes()


def test_a_second_interrupt_does_not_hide_what_is_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = request.resume_command

    def interrupting(of: request.RecordRequest) -> str:
        os.kill(os.getpid(), signal.SIGINT)
        return command(of)

    monkeypatch.setattr(request, "resume_command", interrupting)
    before = signal.getsignal(signal.SIGINT)
    interrupted(monkeypatch, 2, "--runs", "3")
    line = "stopped; 1 of 3 runs kept in logs; to resume: kraft record --out logs --resume"
    assert capsys.readouterr().err.splitlines()[-1] == line
    assert signal.getsignal(signal.SIGINT) is before


def test_a_recording_that_is_complete_is_not_driven_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--runs", "1"]) == 0
    before = contents(folder)
    monkeypatch.setattr(Recorder, "record", None)
    capsys.readouterr()
    assert main(["record", "--resume"]) == 0
    out, err = capsys.readouterr()
    assert out == "1 log in logs; kraft sysid logs identifies the vehicle from them\n"
    assert "1/1" not in err
    assert contents(folder) == before


def test_a_recording_gets_more_runs_and_keeps_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(["record", "--runs", "1", "--seed", "3", "-q"]) == 0
    assert main(["record", "--runs", "3", "--seed", "3", "--out", "whole", "-q"]) == 0
    interrupted(monkeypatch, 3, "--runs", "3", "--resume")
    assert main(["record", "--resume", "-q"]) == 0, "the larger number is remembered"
    logs, whole = (contents(folder / name) for name in ("logs", "whole"))
    assert logs.keys() == whole.keys()
    other = [name for name in logs if logs[name] != whole[name]]
    assert other == ["run_01/manifest.json"], "it says that there was one run"


def test_fewer_runs_than_there_are_is_one_problem_with_the_number_to_give(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--runs", "2", "-q"]) == 0
    before = contents(folder)
    capsys.readouterr()
    assert main(["record", "--resume", "--runs", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "--runs: is 1, the folder has runs up to 2; expected 2 or more: runs are kept"
    assert main(["record", "--resume", "--runs", "1", "--seed", "5"]) == 2
    assert "arguments.seed: was 0, is 5 now; " in capsys.readouterr().err, "other differences are told too"
    assert contents(folder) == before


def test_a_run_that_is_missing_between_others_is_driven_again(folder: Path) -> None:
    assert main(["record", "--runs", "3", "-q"]) == 0
    before = contents(folder)
    shutil.rmtree("logs/run_02")
    assert main(["record", "--resume", "-q"]) == 0
    assert contents(folder) == before


def test_other_options_are_refused_with_every_difference(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "2"]) == 0
    before = contents(folder)
    capsys.readouterr()
    given = ["turns", "--seed", "1", "--runs", "3", "--vehicle", "mushr-lag"]
    assert main(["record", *given, "--resume"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[:2] for line in lines if "manifest" in line] == [
        ["logs/run_01/manifest.json", f"arguments.{key}"] for key in ("scenario", "seed", "vehicle")
    ]
    assert "arguments.seed: was 0, is 1 now; " in "".join(lines)
    assert contents(folder) == before
    assert main(["record", "training", "--seed", "0", "--runs", "2", "--resume"]) == 0


def test_another_scenario_of_the_same_name_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "rooms", "--out", "worlds"]) == 0
    (file,) = Path("worlds").glob("rooms-*.yaml")
    assert main(["record", str(file), "--runs", "2"]) == 0
    shutil.rmtree("logs/run_02")
    text = file.read_text()
    assert "sensing: {" in text
    file.write_text(text.replace("sensing: {", "sensing: {noise_scale: 2, "))
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "manifest" in line]
    assert line.startswith("logs/run_01/manifest.json: scenario.content.sensing.noise_scale: was 1.0, is 2.0 now; ")


def test_another_version_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "1"]) == 0
    path = Path("logs/run_01/manifest.json")
    path.write_text(re.sub(r'"mujoco": "[^"]+"', '"mujoco": "1.0"', path.read_text()))
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    assert capsys.readouterr().err.startswith(f'{path}: versions.mujoco: was "1.0", is ')


def test_planned_drives_are_planned_again_and_continued(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "FIRST", 10)
    monkeypatch.setattr(experiment, "ROUNDS", 0)
    arguments = ["--for", "mushr-lag", "--runs", "2"]
    assert main(["record", *arguments, "--out", "whole", "-q"]) == 0
    interrupted(monkeypatch, 2, *arguments, "-q")
    assert main(["record", "--resume", "-q"]) == 0
    assert contents(folder / "logs") == contents(folder / "whole")
    assert main(["record", "--for", "mushr-lag", "--runs", "1", "--out", "more", "-q"]) == 0
    assert main(["record", "--resume", "--runs", "2", "--out", "more", "-q"]) == 0
    more, whole = (contents(folder / name) for name in ("more", "whole"))
    assert [name for name in whole if more[name] != whole[name]] == ["run_01/manifest.json"]


def test_files_of_commands_that_were_changed_are_refused_at_the_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = ["t,throttle,steering", "0,0.0,0.0", "0.5,0.3,0.1", "2.5,0.0,0.0", "3.0,0.0,0.0"]
    for name in ("a", "b"):
        Path(f"{name}.csv").write_text("\n".join(lines) + "\n")
    arguments = ["--commands", "a.csv", "--commands", "b.csv"]
    assert main(["record", *arguments, "--out", "whole", "-q"]) == 0
    interrupted(monkeypatch, 2, *arguments)
    Path("a.csv").write_text("\n".join(lines).replace("0.5,0.3", "0.5,0.4") + "\n")
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    assert places(capsys.readouterr().err)[-1] == "logs/run_01/commands.csv:12:1"  # 0.5 s at 20 Hz, below a heading
    Path("a.csv").write_text("\n".join(lines) + "\n")
    assert main(["record", "--resume"]) == 0
    assert contents(folder / "logs") == contents(folder / "whole")


def test_a_damaged_run_is_refused_and_nothing_is_driven(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "1"]) == 0
    for name, damage in (("run_02", "poses.csv"), ("run_03", "manifest.json"), ("run_04", "")):
        shutil.copytree("logs/run_01", f"logs/{name}")
        if damage:
            Path(f"logs/{name}/{damage}").unlink()
    shutil.copytree("logs/run_01", "logs/run_05")
    Path("logs/run_05/manifest.json").write_text("{")
    before = contents(folder)
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    assert places(capsys.readouterr().err) == [
        "logs/run_02", "logs/run_03", "logs/run_04/manifest.json", "logs/run_05/manifest.json",
    ]  # fmt: skip
    assert contents(folder) == before


def test_a_run_with_other_numbers_of_rows_than_its_manifest_says_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "--runs", "1"]) == 0
    commands, poses = Path("logs/run_01/commands.csv"), Path("logs/run_01/poses.csv")
    stated = json.loads(Path("logs/run_01/manifest.json").read_text())
    lines = commands.read_text().splitlines(keepends=True)
    commands.write_text("".join([*lines, lines[-1]]))
    poses.write_text("")
    before = contents(folder)
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    expected = "expected the folder removed; its run is then driven again"
    rows = stated["commands"]
    assert capsys.readouterr().err.splitlines() == [
        f"{commands}: has {rows + 1} rows, not {rows} as its manifest says; {expected}",
        f"{poses}: has 0 rows, not {stated['poses']} as its manifest says; {expected}",
    ]
    assert contents(folder) == before


def test_what_cannot_be_removed_is_reported_before_anything_is_driven(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refusing(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    assert main(["record", "--runs", "2"]) == 0
    shutil.rmtree("logs/run_02")
    Path("logs/.run_02.x.part").mkdir()
    monkeypatch.setattr("kraft.recording.resumption.shutil.rmtree", refusing)
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    assert places(capsys.readouterr().err)[-1] == "logs/.run_02.x.part"
    assert not Path("logs/run_02").exists()


def test_a_run_beyond_the_number_of_runs_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--runs", "1"]) == 0
    shutil.copytree("logs/run_01", "logs/run_02")
    path = Path("logs/run_02/manifest.json")
    path.write_text(path.read_text().replace('"run": 1', '"run": 2'))
    capsys.readouterr()
    assert main(["record", "--resume"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("logs/run_02: is run 2 of 1; ")


def test_there_must_be_a_folder_and_an_empty_one_begins(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--resume"]) == 2
    assert places(capsys.readouterr().err) == ["logs"]
    Path("logs").mkdir()
    assert main(["record", "--resume", "--runs", "1", "-q"]) == 0
    assert main(["record", "--runs", "1", "--out", "whole", "-q"]) == 0
    assert contents(folder / "logs") == contents(folder / "whole")


def test_an_existing_folder_is_refused_with_the_option_that_continues(capsys: pytest.CaptureFixture[str]) -> None:
    Path("logs").mkdir()
    assert main(["record", "--runs", "1"]) == 2
    assert capsys.readouterr().err == f"logs: is there already; {request.NEW}\n"
    assert "--resume" in request.NEW


def test_a_folder_of_something_else_is_not_recorded_into(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "trials.jsonl").write_text("{}\n")
    assert main(["record", "--out", str(tmp_path), "--resume", "-q"]) == 2
    expected = "has no run, but other files, such as trials.jsonl; expected the folder of an interrupted kraft record"
    assert capfd.readouterr().err == f"{tmp_path}: {expected}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["trials.jsonl"]
