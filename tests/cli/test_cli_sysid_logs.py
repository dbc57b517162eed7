"""`kraft sysid` and its files: which logs are left out, what it says about them, what it never reads, what it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recorded import FOUR

from kraft.errors import InputError
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.main import main
from kraft_cli.work import sysid_fit as module

pytestmark = pytest.mark.usefixtures("logs")


def shorten(run: Path, poses: int, apart: int = 3) -> None:
    """Leave some poses of a log, `apart` thirtieths of a second from each other, where it is fastest."""
    heading, *rows = (run / "poses.csv").read_text().splitlines(keepends=True)
    places = np.loadtxt(rows, delimiter=",")[:, 1:3]
    first = int(np.argmax(np.hypot(*(places[apart * poses :] - places[: -apart * poses]).T)))
    (run / "poses.csv").write_text("".join([heading, *rows[first : first + apart * poses : apart]]))


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("mapping", "options", "expected"),
    [
        ("commands: {controls: {throttle: thrott}}\n", [], ["m.yaml:1:33: commands.controls.throttle: "]),
        (
            "commands: {controls: {throttel: throttle}}\nposes: {yaw: hed, quaternion: null}\n",
            [],
            ["m.yaml:1:23: commands.controls.throttel: ", "m.yaml:2:14: poses.yaw: "],
        ),
        ("{}\n", ["--model", "unicycle2"], ["logs: the logs have throttle, steering; "]),
    ],
)
def test_a_mapping_or_a_vehicle_that_fits_no_log_is_one_line_for_each_mistake(
    mapping: str, options: list[str], expected: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "m.yaml").write_text(mapping)
    assert main(["sysid", "logs", "--model", "mushr-lag", "--mapping", "m.yaml", *options]) == 2
    for line, start in zip(said(capsys), expected, strict=True):
        assert line.startswith(start)


def test_a_column_that_only_some_logs_lack_leaves_those_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands = folder / "logs" / "run_02" / "commands.csv"
    for run in (folder / "logs").iterdir():
        if run.is_dir() and run.name != "run_02":
            path = run / "commands.csv"
            path.write_text(path.read_text().replace("throttle", "gas", 1))
    (folder / "m.yaml").write_text("commands: {controls: {throttle: gas}}\n")
    assert "throttle" in commands.read_text()
    assert main(["sysid", "logs", "--model", "mushr-lag", "--mapping", "m.yaml", "--extras", "none", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["logs"] == 7
    assert "left out: m.yaml:1:33: commands.controls.throttle: " in err


def test_the_columns_of_logs_that_differ_only_in_the_names_of_files_are_said_once(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in (folder / "logs").iterdir():
        if run.is_dir():
            for name in ("commands", "poses"):
                (run / f"{name}.csv").rename(folder / f"{run.name}_{name}.csv")
    given = sorted(map(str, folder.glob("run_*.csv")))
    assert main(["sysid", *given, "--model", "mushr-lag", "--extras", "none"]) == 0
    (line,) = [line for line in said(capsys) if "throttle from" in line]
    assert line.startswith("run_01 and 7 more: commands: run_01_commands.csv: time from 't' (s)")


def test_a_bad_log_is_left_out_and_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "logs" / "run_02" / "poses.csv").write_text("t,x,y,yaw\n0.0,1,2,0\n")
    assert main(["sysid", "logs", "--model", "mushr-lag", "--extras", "none", "--json"]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["logs"] == 7
    (left_out,) = content["left_out"]
    assert left_out.startswith("logs/run_02/poses.csv")
    assert f"left out: {left_out}" in err


def test_a_log_of_a_few_poses_is_left_out_and_counted_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shorten(folder / "logs" / "run_02", 4, 9)
    options = ["--extras", "none", "--out", "my.yaml", "--plot", "my.png", "--json"]
    assert main(["sysid", "logs", "--model", "mushr-lag", *options]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["logs"] == 7
    assert content["left_out"] == ["run_02: has no part with 5 poses, the longest has 4; expected a longer drive"]
    assert f"left out: {content['left_out'][0]}" in err
    config = load_vehicle_config("my.yaml")
    assert config.identification is not None
    assert "run_02" not in [log.name for log in config.identification.logs]
    assert "of 7 logs held out" in err


def test_when_all_logs_have_a_few_poses_it_ends_with_1(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for run in (folder / "logs").iterdir():
        shorten(run, 4, 9)
    assert main(["sysid", "logs", "--model", "mushr-lag", "--json"]) == 1
    out, err = capsys.readouterr()
    assert err.splitlines()[-1] == "error: none of the 8 logs can be used"
    content = json.loads(out)
    assert (content["schema"], content["reason"]) == ("kraft.sysid/1", "none of the 8 logs can be used")
    assert [Path(problem["file"]).name for problem in content["problems"]] == [f"run_{k:02d}" for k in range(1, 9)]


def test_held_out_logs_that_are_too_short_leave_the_fit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--model", "mushr-lag", "--extras", "none"]
    assert main(["sysid", "--model", "mushr-lag", *FOUR, *options, "--json"]) == 0
    (held_out,) = json.loads(capsys.readouterr().out)["held_out"]
    shorten(folder / "logs" / held_out, 7)
    assert (
        main(["sysid", "--model", "mushr-lag", *FOUR, *options, "--out", "my.yaml", "--plot", "my.png", "--json"]) == 0
    )
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["held_out"] == [held_out]
    assert (content["rmse_holdout_m"], content["rmse_holdout_initial_m"]) == (None, None)
    assert (content["prediction"]["holdout"], content["prediction"]["holdout_initial"]) == (None, None)
    assert content["rmse_train_m"] > 0
    why = "the fit is not tested: 1 held-out log cannot be predicted (logs are all shorter than a second)"
    assert why in content["warnings"]
    assert f"warning: {why}" in err
    assert (folder / "my.png").stat().st_size > 50_000
    config = load_vehicle_config("my.yaml")
    assert config.identification is not None
    assert config.identification.held_out is None
    assert why in config.identification.warnings
    assert main(["sysid", "--model", "mushr-lag", *FOUR, *options]) == 0
    assert "OPEN LOOP, fitted logs" in capsys.readouterr().out


def test_a_held_out_log_that_is_too_short_beside_others_is_named(
    plain: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _ = plain["held_out"]
    shorten(folder / "logs" / first, 7)
    assert main(["sysid", "logs", "--model", "mushr-lag", "--extras", "none", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["rmse_holdout_m"] > 0
    assert f"held-out logs too short to be predicted: {first}" in content["warnings"]


@pytest.mark.parametrize("verbose", [False, True])
def test_a_problem_that_all_logs_have_is_explained_once_and_it_ends_with_1(
    verbose: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in (folder / "logs").iterdir():
        (run / "poses.csv").write_text("t,x,y,yaw\n0.0,1,2,0\n")
    assert main(["sysid", "logs", "--model", "mushr-lag", "--plot", "my.png", *(["-v"] if verbose else [])]) == 1
    err = said(capsys)
    assert err[-1] == "error: none of the 8 logs can be used"
    assert sum("poses.csv" in line for line in err) == (8 if verbose else 1)
    (once,) = [line for line in err if line.endswith("; the same in 7 other logs (-v lists them)")]
    assert once.startswith("logs/run_01/poses.csv")


def test_a_column_of_the_mapping_file_that_many_logs_lack_is_said_once(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = folder / "logs" / "run_01" / "commands.csv"
    first.write_text(first.read_text().replace("throttle", "gas", 1))
    (folder / "m.yaml").write_text("commands: {controls: {throttle: gas}}\n")
    main(["sysid", "logs", "--model", "mushr-lag", "--mapping", "m.yaml", "--extras", "none"])
    (left_out,) = [line for line in said(capsys) if line.startswith("left out: ")]
    assert "m.yaml:1:33: commands.controls.throttle: there is no column 'gas' in commands.csv; " in left_out


def test_what_only_the_estimator_refuses_leaves_a_picture_of_the_logs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from kraft.errors import InputError

    def refused(*_: object) -> None:
        raise InputError.of("logs", "show no motion", "expected drives")

    monkeypatch.setattr(module, "identify", refused)
    assert main(["sysid", "logs", "--model", "mushr-lag", "--plot", "my.png"]) == 1
    assert said(capsys)[-2:] == [
        "logs: show no motion; expected drives",
        "error: the parameters cannot be identified from these logs",
    ]
    assert (folder / "my.png").stat().st_size > 20_000


def test_the_truth_is_never_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["sysid", "--model", "mushr-lag", *FOUR, "--extras", "none", "--json"]
    assert main(arguments) == 0
    before = json.loads(capsys.readouterr().out)
    for run in (folder / "logs").iterdir():
        (run / "truth.csv").unlink()
        (run / "truth.csv").mkdir()  # whoever opens it fails
    assert main(arguments) == 0
    assert {**json.loads(capsys.readouterr().out), "wall_s": 0} == {**before, "wall_s": 0}


def test_a_problem_that_many_logs_have_with_other_numbers_is_said_once(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in (folder / "logs").iterdir():
        heading, *rows = (run / "poses.csv").read_text().splitlines()
        poses = np.loadtxt(rows, delimiter=",") * [1.0, 1000.0, 1000.0, 1.0]  # in mm
        np.savetxt(run / "poses.csv", poses, delimiter=",", header=heading, comments="")
    assert main(["sysid", "logs", "--model", "mushr-lag"]) == 1
    (line,) = [line for line in said(capsys) if "poses.csv" in line]
    assert line.endswith("; the same with other numbers in 7 other logs (-v lists them)")


def test_a_plot_that_cannot_be_written_does_not_cost_the_vehicle_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise InputError.of("my.png", "cannot be written: No space left on device", "expected enough space")

    monkeypatch.setattr("kraft_cli.work.sysid._draw", full)
    options = ["--model", "mushr-lag", "--extras", "none", "--out", "my.yaml", "--plot", "my.png"]
    assert main(["sysid", "logs", *options]) == 2
    assert "my.png: cannot be written" in capsys.readouterr().err
    assert Path("my.yaml").exists()
