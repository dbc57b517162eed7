"""`kraft sysid`: from logs to a vehicle that plans and drives, with what is doubtful said and nothing doubtful written."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.evaluation import places
from support.logs import REAL_LOGS, needs_real_logs
from support.paths import ROOT
from support.recorded import FOUR, IDENTIFY, weaken

from kraft.recording import experiment
from kraft.sysid import factor_graph as compilation
from kraft.sysid.fit_progress import FitProgress
from kraft.sysid.parameters import is_unknown_to_planning
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.main import main
from kraft_cli.work import sysid_progress
from kraft_cli.work.sysid_request import SysidRequest, checked

KEYS = {"model", "params", "rmse_train_m", "rmse_holdout_m", "logs", "converged", "iterations", "wall_s", "warnings"}

pytestmark = pytest.mark.usefixtures("logs")


def keep_seconds(run: Path, seconds: float) -> None:
    """Leave the beginning of a log."""
    for path in (run / "poses.csv", run / "commands.csv"):
        heading, *rows = path.read_text().splitlines(keepends=True)
        path.write_text("".join([heading, *(row for row in rows if float(row.split(",")[0]) <= seconds)]))


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_the_json_object_holds_what_was_promised(plain: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    content = plain
    assert content["schema"] == "kraft.sysid/1"
    assert set(content) >= KEYS
    assert (content["model"], content["logs"], content["converged"]) == ("mushr-lag", 8, True)
    assert list(content["params"]) == ["L", "phi_diff", "v_delta", "tau"]
    for each in content["params"].values():
        assert set(each) >= {"value", "std", "ci95", "unit"}
        assert each["ci95"][0] < each["value"] < each["ci95"][1]
    assert content["params"]["L"]["unit"] == "m"
    assert content["params"]["L"]["value"] == pytest.approx(0.334, abs=0.01)
    assert 0 < content["rmse_train_m"] < 0.1
    assert 0 < content["rmse_holdout_m"] < 0.1
    assert len(content["held_out"]) == 2
    assert content["vehicle_file"] is None
    assert main([*IDENTIFY, "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert {**again, "wall_s": 0} == {**content, "wall_s": 0}


def test_the_lag_predicts_better_than_its_nominal_values_and_than_the_papers_model(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On drives that it has not seen, after 1 to 3 s, without any number of the bundled vehicles."""
    errors = {}
    for model in ("MUSHR", "MUSHR_LAG"):
        main(["sysid", "logs", "--model", f"kraft.vehicles.mushr:{model}", "--extras", "none", "--json"])
        prediction = json.loads(capsys.readouterr().out)["prediction"]
        errors[model] = prediction["holdout"]["position_m"], prediction["holdout_initial"]["position_m"]
    identified, nominal = errors["MUSHR_LAG"]
    assert all(identified[seconds] < nominal[seconds] for seconds in ("1", "2", "3"))
    assert identified["1"] < 0.9 * nominal["1"]
    assert all(identified[seconds] < 0.5 * errors["MUSHR"][0][seconds] for seconds in ("1", "2", "3"))


def test_what_many_logs_have_and_costs_nothing_is_said_once(
    tables: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--model", "mushr-lag", "--extras", "none"]
    (wraps,) = (line for line in tables[1].splitlines() if "yaw wraps" in line)
    found = re.fullmatch(r"(\d) logs: yaw wraps; made continuous, nothing is left out \(-v lists them\)", wraps)
    assert found is not None
    assert main(["-v", "sysid", "logs", "--model", "mushr-lag", *options]) == 0
    each = [line for line in said(capsys) if re.match(r"run_\d\d: yaw wraps \d times?, first at line", line)]
    assert len(each) == int(found.group(1)) > 1
    run = each[0].partition(":")[0]
    assert main(["sysid", f"logs/{run}", *options]) == 0
    assert any(line.startswith(each[0].partition(", first")[0]) for line in said(capsys))


def test_all_that_is_wrong_with_options_and_places_is_said_before_the_logs_are_read(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "my.yaml").mkdir()
    assert (
        main(
            ["sysid", "--model", "mushr-lag", "nowhere", "--out", "my.yaml", "--plot", "/proc/my.png", "--freeze", "l"]
        )
        == 2
    )
    proc, freeze, out, logs = said(capsys)
    assert proc.startswith("/proc/my.png: cannot be written: nothing can be made in /proc")
    assert freeze == "--freeze: mushr-lag has no parameter l; did you mean 'L'?"
    assert out == "my.yaml: is a folder; expected the name of a file"
    assert logs.startswith("nowhere: does not exist")


def test_an_identification_that_takes_long_says_how_it_goes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[str] = []
    times = iter([0.0, 1.9, 2.0, 3.9, 8.0, 9.0, 11.5])
    report = sysid_progress.ProgressReporter(heard.append, "car", lambda: next(times))
    for fit, iteration in ((1, 1), (1, 2), (2, 1), (3, 4)):
        report(FitProgress(fit, 5, iteration, 1000.0 * fit))
    report.begin("model 2 of 3, cart")
    report(FitProgress(1, 1, 7, 10.0))
    assert heard == [
        "car: fit 1 of about 5, iteration 2",
        "car: fit 3 of about 5, iteration 4, about 12 s remain",
        "model 2 of 3, cart: fit 1 of about 1, iteration 7",
    ]
    monkeypatch.setattr(sysid_progress, "PROGRESS_INTERVAL", 0.0)
    keep_seconds(folder / "logs" / "run_02", 6.0)
    arguments = ["sysid", "--model", "mushr-lag", "logs/run_02", "--extras", "none", "--graph", "paper"]
    assert main(arguments) == 0
    assert any(re.fullmatch("mushr-lag: fit 1 of about [12], iteration 1", line) for line in said(capsys))
    assert main([*arguments, "-q"]) == 0
    assert not any("iteration" in line for line in said(capsys))


def test_a_file_is_compiled_by_its_own_name(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sysid", "--model", "mushr-lag", *FOUR, "--extras", "none", "--out", "my.yaml", "-q"]) == 0
    monkeypatch.setattr(compilation, "are_steps_cached", lambda _: False)
    assert main(["sysid", "--model", "mushr-lag", *FOUR, "--extras", "none", "--model", "my.yaml"]) == 0
    assert "compiling the model of my.yaml for identification on this machine" in capsys.readouterr().err


def test_a_person_gets_tables_and_hears_what_was_taken_for_what(tables: tuple[str, str]) -> None:
    out, err = tables
    lines = out.splitlines()
    assert re.fullmatch(r"PARAMETER +VALUE +95 % INTERVAL \(sandwich\) +INITIAL +UNIT +MEANING", lines[0])
    assert re.fullmatch(r"L +0\.3\d+ +0\.3\d+ to 0\.3\d+ +0\.3\d+ +m +wheelbase", lines[1])
    assert re.fullmatch(r"OPEN LOOP, held-out logs +1 s +2 s +3 s +all", lines[6])
    assert re.fullmatch(r"position, identified( +[\d.]+ cm){4}", lines[7])
    assert re.fullmatch(r"position, constant motion( +[\d.]+ cm){4}", lines[9])
    assert re.fullmatch(r"yaw, initial( +[\d.]+ deg){4}", lines[11])
    assert "intervals follow from the differences between logs" in out
    assert "run_01 and 7 more: commands: commands.csv: time from 't'" in err
    assert re.search(r"2 of 8 logs held out: run_\d\d, run_\d\d", err)


def test_quiet_leaves_the_tables_and_the_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sysid", "logs", "--model", "mushr-lag", "--extras", "none", "-q"]) == 0
    assert all(line.startswith("warning: ") for line in said(capsys))


def test_what_it_writes_plans_and_drives(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "sysid",
        "--model",
        "mushr-lag",
        *FOUR,
        "--model",
        "mushr-drive",
        "--extras",
        "none",
        "--out",
        "my.yaml",
    ]
    assert main([*arguments, "--plot", "my.png"]) == 0
    assert "vehicle file my.yaml" in capsys.readouterr().out
    assert (folder / "my.png").stat().st_size > 50_000
    config = load_vehicle_config("my.yaml")
    assert config.name == "my"
    assert config.identification is not None
    assert len(config.identification.logs) == len(FOUR)
    assert main(["validate", "my.yaml"]) == 0
    assert main(["plan", "turns", "--vehicle", "my.yaml", "--iterations", "1000"]) == 0
    assert main(["run", "turns", "--vehicle", "my.yaml"]) == 0
    assert main(arguments) == 0  # over the file that it wrote


def test_a_file_is_for_planning_which_knows_no_friction_beside_the_model(
    with_extras: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = with_extras["params"]
    assert main(["sysid", "logs", "--model", "mushr-lag", "--out", "my.yaml", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    written = load_vehicle_config("my.yaml")
    assert "friction" in alone
    assert not [name for name in content["params"] if is_unknown_to_planning(name)]
    assert written.values == {
        name: pytest.approx(content["params"][name]["value"], rel=1e-5) for name in written.values
    }
    fastest = max(
        np.loadtxt(path, delimiter=",", skiprows=1)[:, 4].max() for path in (folder / "logs").glob("*/truth.csv")
    )
    assert written.top_speed == "v_delta"
    assert written.values["v_delta"] < 1.02 * fastest
    assert (written.delay is None) == ("delay" not in content["params"])  # of all commands: driving knows it
    unsought = "lag_throttle, lag_steering, friction, dead_band_throttle, dead_band_steering, play_steering"
    assert f"not considered, because planning does not model them: {unsought}" in content["notes"]


def test_a_file_with_what_planning_does_not_know_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["sysid", "logs", "--model", "mushr-lag", "--out", "my.yaml", "--json"]
    assert main([*arguments, "--extras", "lag_steering,lever"]) == 0
    content = json.loads(capsys.readouterr().out)
    warning = "planning does not model lag_steering, "
    assert any(each.startswith(warning) for each in content["warnings"])
    assert main([*arguments, "--param", "lag_steering=0.02"]) == 0
    assert any(each.startswith(warning) for each in json.loads(capsys.readouterr().out)["warnings"])


@pytest.mark.parametrize(
    ("options", "unknown"), [(["--param", "friction=0.1"], True), (["--freeze", "friction"], False)]
)
def test_an_extra_that_was_asked_for_is_neither_shown_by_the_data_nor_unsought(
    options: list[str], unknown: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """And one that is frozen at nothing is nothing that planning lacks."""
    assert main(["sysid", "logs", "--model", "mushr-lag", "--out", "my.yaml", "--json", *options]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (
        "requested auxiliary parameters, kept: friction; significant auxiliary parameters, kept: lever; removed: delay, yaw_offset"
    ) in content["notes"]
    unsought = "lag_throttle, lag_steering, dead_band_throttle, dead_band_steering, play_steering"
    assert f"not considered, because planning does not model them: {unsought}" in content["notes"]
    assert any(each.startswith("planning does not model friction") for each in content["warnings"]) == unknown


def test_an_extra_that_is_kept_may_be_hardly_told_apart(with_extras: dict[str, Any]) -> None:
    """One that is indistinguishable is removed, or the model is not identified."""
    content = with_extras
    assert content["params"]["friction"]["extra"]
    assert any(
        each.startswith("v_delta and friction are nearly indistinguishable (correlation 0.9")
        for each in content["warnings"]
    )
    assert not any("are indistinguishable" in each for each in (*content["warnings"], *content["objections"]))


def test_where_no_extra_is_shown_beside_a_frozen_model_nothing_is_identified(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--freeze", "L,phi_diff,v_delta,tau,lever", "--out", "my.yaml", "--plot", "my.png", "--json"]
    assert main(["sysid", "logs", "--model", "mushr-lag", *options]) == 1
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["correlation"] == {"names": [], "matrix": []}
    why = "every parameter of the model is frozen, and the data show no auxiliary parameter"
    assert content["objections"] == [why]
    assert err.splitlines()[-1] == f"error: not identified: {why}; my.yaml was not written"
    assert (folder / "my.png").exists()


def test_with_few_logs_none_is_held_out_and_that_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    runs = [f"logs/run_{k:02d}" for k in (2, 3, 4)]
    assert main(["sysid", *runs, "--model", "mushr-lag", "--extras", "none", "--json"]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert (content["rmse_holdout_m"], content["held_out"], content["interval"]) == (None, [], "graph")
    assert "3 logs: none is held out" in err
    assert main(["sysid", *runs, "--model", "mushr-lag", "--extras", "none", "--holdout", "0.3", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["held_out"]) == 1


def test_frozen_parameters_and_other_initial_values(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--freeze", "L,phi_diff", "--param", "L=0.3", "--extras", "none", "--pose-noise", "0.002,0.02", "--json"]
    assert main(["sysid", "logs", "--model", "mushr-lag", *options]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["params"]["L"]["value"] == 0.3
    assert content["params"]["L"]["frozen"]
    assert not content["params"]["tau"]["frozen"]
    assert content["correlation"]["names"] == ["v_delta", "tau"]
    assert content["pose_noise"] == {"position_m": 0.002, "yaw_rad": 0.02, "measured": False}


def test_straight_lines_do_not_identify_a_wheelbase(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--model", "mushr-lag", "--extras", "none", "--out", "my.yaml", "--plot", "my.png"]
    assert main(["sysid", "logs/run_01", "logs/run_06", *options]) == 1
    err = said(capsys)
    assert re.match(r"error: not identified: .*the logs do not identify L.*; my\.yaml was not written", err[-1])
    assert any(line.startswith("warning: the logs do not identify L:") for line in err)
    assert not (folder / "my.yaml").exists()
    assert (folder / "my.png").exists()


@pytest.mark.parametrize(("factor", "status"), [(0.95, 0), (0.6, 1)])
def test_what_predicts_worse_than_before_is_said_and_if_it_is_far_worse_it_is_not_written(
    factor: float, status: int, plain: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plain["identifiable"]  # with the logs as they are
    held_out = plain["held_out"]
    for run in (folder / "logs").iterdir():
        if run.is_dir() and run.name not in held_out:
            weaken(run, factor)
    assert main([*IDENTIFY, "--json", "--out", "my.yaml"]) == status
    out, err = capsys.readouterr()
    content = json.loads(out)
    identified, initial = (100 * content[f"rmse_holdout{which}_m"] for which in ("", "_initial"))
    both = f"(position {identified:.2f} cm identified, {initial:.2f} cm initial"
    assert f"warning: the identified values predict held-out logs no better than the initial values do {both}" in err
    assert (folder / "my.yaml").exists() == (status == 0)
    assert content["identifiable"] == (status == 0)
    refused = f"error: not identified: held-out logs are predicted far better with the initial values {both})"
    assert (f"{refused}; my.yaml was not written" in err) == (status == 1)
    assert ("warning: with those held out, the logs fall into two groups" in err) == (status == 1)


def test_the_first_identification_says_that_it_compiles_and_a_quiet_one_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as before:
        before.setattr(compilation, "are_steps_cached", lambda _: False)
        assert main(["sysid", "--model", "mushr-lag", "logs/run_02", "--extras", "none"]) == 0
        err = said(capsys)
        begun = err.index("compiling the model of mushr-lag for identification on this machine, once ...")
        assert err[begun + 1].startswith("compiled in ")
        assert main(["sysid", "--model", "mushr-lag", "logs/run_02", "--extras", "none", "-q"]) == 0
        assert not any("compil" in line for line in said(capsys))
    assert main(["sysid", "--model", "mushr-lag", "logs/run_02", "--extras", "none"]) == 0
    assert not any("compil" in line for line in said(capsys))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nowhere"], "nowhere: "),
        (["logs/run_01/truth.csv"], "logs/run_01/truth.csv: "),
        (["logs", "--model", "musrh"], "musrh: "),
        (["logs", "--holdout", "1"], "--holdout: is 1; expected a fraction of at least 0 and below 1"),
        (["logs", "--freeze", "l"], "--freeze: mushr-lag has no parameter l; did you mean 'L'?"),
        (["logs", "--extras", "dely"], "--extras: mushr-lag has no"),
        (["logs", "--graph", "papre"], "--graph: "),
        (["logs", "--pose-noise", "0.01"], "--pose-noise: "),
        (["logs", "--param", "L"], "--param: "),
        (["nowhere", "--param", "L=7"], "--param L: is 7; expected a value from 0.15 to 0.6 m"),
        (["nowhere", "--param", "delay=0.9"], "--param delay: is 0.9; expected a value from -0.1 to 0.5 s"),
        (["nowhere", "--param", "friction=0.9"], "--param friction: is 0.9; expected a value from 0 to 0.5\n"),
        (["nowhere", "--param", "delay=0.1", "--extras", "none"],
         "--param: delay is"),
        (["nowhere", "--freeze", "side", "--extras", "lever,delay"],
         "--freeze: side is"),
        (["nowhere", "--freeze", "L,phi_diff,v_delta,tau", "--extras", "none"],
         "--freeze: leaves nothing of mushr-lag to identify"),
        (["nowhere", "--freeze", "L,phi_diff,v_delta,tau,delay,lever,yaw_offset", "--out", "my.yaml"],
         "--freeze: leaves nothing of mushr-lag to identify"),
        (["logs", "--mapping", "none.yaml"], "none.yaml: "),
        (["logs", "--out", "my.txt"], "my.txt: "),
        (["logs", "--plot", "my.gif"], "my.gif: "),
        (["logs", "--plot", "logs/run_01/poses.csv/my.png"], "logs/run_01/poses.csv/my.png: "),
    ],
)  # fmt: skip
def test_bad_arguments_are_explained(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sysid", "--model", "mushr-lag", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert any(line.startswith(expected.strip()) for line in err.splitlines())


def test_every_option_and_key_of_kraft_sysid_is_described(
    with_extras: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "sysid.md").read_text(encoding="utf-8")
    assert main(["sysid", "--help"]) == 0
    options = set(re.findall(r"(?<![\w-])--[a-z]+(?:-[a-z]+)*", capsys.readouterr().out)) - {"--help"}
    assert options
    assert options <= set(re.findall(r"--[a-z]+(?:-[a-z]+)*", text))
    content = with_extras
    described = set(re.findall(r"`(\w+)`", text))
    assert set(content) <= described
    assert set(content["params"]["L"]) <= described


@needs_real_logs
def test_on_a_real_car_prediction_is_as_good_as_its_poses(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sysid", "--model", "mushr-lag", str(REAL_LOGS), "--holdout", "0.5", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    errors = content["prediction"]["holdout"]
    assert content["logs"] == 41
    assert errors["position_m"]["3"] < 0.0164
    assert errors["yaw_rad"]["3"] < 0.016
    assert "play_steering" in content["params"]
    assert content["params"]["delay"]["value"] == pytest.approx(0.1, abs=0.04)


def test_next_drives_are_printed_and_their_commands_written(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment, "FIRST", 10)
    monkeypatch.setattr(experiment, "ROUNDS", 0)
    options = ("--model", "mushr-lag", "--extras", "none", "--next", "2", "--area", "9,8")
    assert main(["sysid", *FOUR, *options, "--commands", "next", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    drives = content["next"]["drives"]
    assert content["next"]["area_m"] == [9.0, 8.0]
    assert [drive["commands"] for drive in drives] == [f"next/drive_{k}/commands.csv" for k in (1, 2)]
    for drive in drives:
        rows = (folder / drive["commands"]).read_text().splitlines()
        assert rows[0] == "t,throttle,steering"
        assert float(rows[-1].split(",")[0]) == pytest.approx(drive["duration_s"])
        assert drive["error_after_m"] < drive["error_before_m"]
        assert set(drive["std"]) == {"L", "phi_diff", "v_delta", "tau"}
    assert drives[0]["std"]["L"]["before"] == pytest.approx(content["params"]["L"]["std"])
    assert main(["sysid", *FOUR, *options]) == 0
    out = capsys.readouterr().out
    assert (
        "NEXT 2 DRIVES, in an area of 9 m x 8 m\ncommands as read from the logs: of a column in degrees in rad" in out
    )
    assert all(step in out for step in drives[0]["steps"])


@pytest.mark.parametrize(
    ("options", "place"),
    [
        (("--next", "0"), "--next"),
        (("--next", "21"), "--next"),
        (("--next", "1", "--area", "6"), "--area"),
        (("--next", "1", "--area", "6,-1"), "--area"),
        (("--next", "1", "--commands", "logs"), "logs"),
        (("--area", "6,4"), "--area"),
        (("--commands", "new"), "--commands"),
        (("--next", "1", "--area", "0.01,0.01"), "--area"),
    ],
)
def test_bad_options_of_next_drives_are_explained(
    options: tuple[str, ...], place: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment, "FIRST", 5)
    assert main(["sysid", *FOUR, "--model", "mushr-lag", "--extras", "none", "-q", *options]) == 2
    assert places(capsys.readouterr().err) == [place]


@pytest.mark.parametrize(
    ("columns", "model"), [("t,left,right", "differential"), ("t,throttle,steering", "car-lag"), ("t,a,b", "car-lag")]
)
def test_without_a_model_the_commands_in_the_logs_decide_between_a_car_and_a_robot_with_two_sides(
    columns: str, model: str, tmp_path: Path
) -> None:
    times = 0.05 * np.arange(200)
    yaw = 0.3 * times
    commands = np.column_stack([times, 0.5 + 0.1 * np.sin(times), 0.6 + 0.1 * np.cos(times)])
    poses = np.column_stack([times, np.sin(yaw) / 0.6, (1.0 - np.cos(yaw)) / 0.6, yaw])
    run = tmp_path / "other" / "run_01"
    run.mkdir(parents=True)
    np.savetxt(run / "commands.csv", commands, fmt="%.9g", delimiter=",", header=columns, comments="")
    np.savetxt(run / "poses.csv", poses, fmt="%.9g", delimiter=",", header="t,x,y,yaw", comments="")
    base, _ = checked(SysidRequest(logs=(tmp_path / "other",)))
    assert base.name == model


def test_a_table_of_poses_without_rows_is_named_for_a_robot_with_two_sides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "sides" / "run_01"
    run.mkdir(parents=True)
    (run / "commands.csv").write_text("t,left,right\n0,0.1,0.2\n1,0.2,0.1\n", encoding="utf-8")
    (run / "poses.csv").write_text("t,x,y,yaw\n", encoding="utf-8")
    assert main(["sysid", str(run)]) == 1
    problem, last = said(capsys)
    assert problem.startswith(f"{run / 'poses.csv'}: has a heading but no rows")
    assert last == "error: the only log cannot be used"


def test_files_of_a_robot_with_two_sides_whose_names_do_not_pair_are_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "sides"
    folder.mkdir()
    for number in (1, 2):
        (folder / f"a{number}_cmd.csv").write_text("t,left,right\n0,0.1,0.2\n1,0.2,0.1\n", encoding="utf-8")
        (folder / f"b{number}_pose.csv").write_text("t,x,y,yaw\n0,0,0,0\n", encoding="utf-8")
    assert main(["sysid", str(folder)]) == 2
    (problem,) = said(capsys)
    assert problem.startswith(f"{folder}: 2 files have commands and 2 have poses, but their names do not pair")


@pytest.mark.parametrize(("options", "notes"), [((), 1), (("--param", "L=0.3"), 0)])
def test_a_wheelbase_that_nobody_stated_is_said_once_with_the_option(
    options: tuple[str, ...], notes: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in (folder / "logs").iterdir():  # pulse widths
        heading, *rows = (run / "commands.csv").read_text().splitlines()
        commands = np.loadtxt(rows, delimiter=",") * [1.0, 400.0, -900.0] + [0.0, 1500.0, 1500.0]
        np.savetxt(run / "commands.csv", commands, delimiter=",", header=heading, comments="")
    assert main(["sysid", "logs", "--json", *options]) == 0
    content = json.loads(capsys.readouterr().out)
    said = [note for note in content["notes"] if "wheelbase" in note]
    assert len(said) == notes
    assert all("--param L=..." in note for note in said)
    assert not content["commands"]["steering"]["as_is"]
