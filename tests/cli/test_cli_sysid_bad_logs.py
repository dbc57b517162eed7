"""`kraft sysid` and drives of which no model may be made, or which no model explains in part."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.recorded import FOUR, weaken

from kraft_cli.main import main

PLAIN = ("sysid", "logs", "--model", "mushr-lag", "--extras", "none", "--json")

pytestmark = pytest.mark.usefixtures("logs")


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


def rewrite(run: Path, file: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the numbers of a file of a log, shape (rows, columns)."""
    heading, *rows = (run / file).read_text().splitlines()
    table = change(np.loadtxt(rows, delimiter=","))
    np.savetxt(run / file, table, fmt="%.9g", delimiter=",", header=heading, comments="")


BAD: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray], str]] = {
    "clock": ("commands.csv", lambda c: c + np.array([1.0, 0.0, 0.0]), "logs: the commands are recorded 1.04 s later than they act"),
    "swapped commands": ("commands.csv", lambda c: c[:, [0, 2, 1]], "logs: throttle and steering are swapped"),
    "swapped places": ("poses.csv", lambda p: p[:, [0, 2, 1, 3]], "'x' and 'y' are swapped"),
    "steering of a constant": ("commands.csv", lambda c: c * [1.0, 1.0, 0.0], "steering is always 0"),
    "throttle in the dead zone": (
        "poses.csv", lambda p: p[:1] * [0.0, 1.0, 1.0, 1.0] + p * [1.0, 0.0, 0.0, 0.0], "there is no motion",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_logs_of_which_no_model_may_be_made_end_with_1_and_with_what_to_do(
    kind: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, change, expected = BAD[kind]
    for run in FOUR:
        rewrite(folder / run, file, change)
    assert main(["sysid", *FOUR, "--out", "my.yaml"]) == 1
    err = said(capsys)
    assert any(expected in line and "; " in line for line in err)
    assert err[-1].startswith("error: ")
    assert not (folder / "my.yaml").exists()


@pytest.mark.parametrize(
    ("column", "said_of", "to_drive"),
    [(1, "throttle", "drives in which it takes several values"), (2, "steering", "drives with arcs to both sides")],
)
def test_a_control_that_never_changes_is_said_and_nothing_that_follows_from_it(
    column: int, said_of: str, to_drive: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Drives that turn or accelerate by themselves look like those of two cars, or like a hand on the car."""
    for run in (folder / "logs").iterdir():
        if run.is_dir():
            rewrite(run, "commands.csv", lambda c: np.where(np.arange(3) == column, 0.2, c))
    assert main(["sysid", "logs", "--out", "my.yaml", "--plot", "my.png"]) == 1
    err = said(capsys)
    assert f"logs: have commands in which {said_of} is always 0.2; expected {to_drive}" in "\n".join(err)
    assert "picture my.png" in err
    assert (folder / "my.png").exists()
    assert not any("two groups" in line or "no model explains" in line for line in err)
    assert not (folder / "my.yaml").exists()


def test_two_cars_in_one_folder_are_told_apart(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of the logs are of a car that takes a smaller command for the same steering."""
    runs = sorted(run.name for run in (folder / "logs").iterdir() if run.is_dir())
    turning = [run for run in runs if run not in ("run_01", "run_06")]  # those are straight
    for run in turning[::2]:
        rewrite(folder / "logs" / run, "commands.csv", lambda c: c * [1.0, 1.0, 0.5])
    given = [f"logs/{run}" for run in turning]
    assert main(["sysid", *given, "--model", "mushr-lag", "--out", "my.yaml", "--holdout", "0"]) == 1
    err = said(capsys)
    (line,) = [line for line in err if "fall into two groups" in line]
    for own in (turning[::2], turning[1::2]):
        assert ", ".join(f"logs/{run}" for run in own) in line or ", ".join(own) in line
    assert not (folder / "my.yaml").exists()


def test_one_log_of_another_car_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A log that is held out, of a car that drives much faster: two groups of logs would need two logs each."""
    main([*PLAIN])
    out, err = capsys.readouterr()
    assert "is predicted worse than any other log" not in err
    odd = json.loads(out)["held_out"][0]
    rewrite(folder / "logs" / odd, "poses.csv", lambda p: p * [1.0, 1.5, 1.5, 1.0])
    main([*PLAIN])
    (line,) = [line for line in said(capsys) if "is predicted worse than any other log" in line]
    assert line.startswith(f"warning: {odd} is predicted worse")


def test_logs_that_turn_to_one_side_are_warned_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for run in FOUR:
        rewrite(folder / run, "commands.csv", lambda c: np.column_stack([c[:, :2], 0.2 + 0.1 * np.sin(c[:, 0])]))
        commands = np.loadtxt((folder / run / "commands.csv").read_text().splitlines()[1:], delimiter=",")
        times = np.arange(0.0, commands[-1, 0], 1 / 30)
        steering = np.interp(times, commands[:, 0], commands[:, 2])
        yaw = np.cumsum(0.6 / 0.33 * np.tan(steering)) / 30
        places = np.cumsum(0.6 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0) / 30
        table = np.column_stack([times, places, yaw])
        np.savetxt(folder / run / "poses.csv", table, fmt="%.9g", delimiter=",", header="t,x,y,yaw", comments="")
    main(["sysid", *FOUR, "--model", "mushr-lag", "--extras", "none"])
    assert any(
        "the vehicle only steers to the left: drive arcs to the left and to the right" in e for e in said(capsys)
    )


def test_a_hand_on_the_car_is_left_out_with_its_time(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def carried(poses: np.ndarray) -> np.ndarray:
        time = np.clip(poses[:, :1] - 8.0, 0.0, 2.0)
        return poses + np.hstack([0.0 * time, 0.5 * time, -0.5 * time, 0.0 * time])

    rewrite(folder / "logs" / "run_03", "poses.csv", carried)
    assert main(["sysid", *FOUR, "--model", "mushr-lag", "--extras", "none", "--json"]) == 0
    out, err = capsys.readouterr()
    (found,) = json.loads(out)["unexplained"]
    assert found["log"].endswith("run_03")
    assert 7.0 < found["begin_s"] < 8.5
    assert 9.5 < found["end_s"] < 11.0
    assert "left out, because no model explains it: " in err


def test_a_vehicle_file_that_predicts_better_is_not_replaced(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*PLAIN, "--out", "my.yaml"]) == 0
    assert main([*PLAIN, "--out", "my.yaml"]) == 0  # as good
    before = (folder / "my.yaml").read_bytes()
    capsys.readouterr()
    assert main(PLAIN) == 0
    held_out = json.loads(capsys.readouterr().out)["held_out"]
    for run in (folder / "logs").iterdir():
        if run.is_dir() and run.name not in held_out:
            weaken(run, 0.95)
    assert main([*PLAIN, "--out", "my.yaml"]) == 1
    out, err = capsys.readouterr()
    assert "held-out logs are predicted better with my.yaml as it is" in json.loads(out)["objections"][0]
    assert "my.yaml was not written" in err
    assert (folder / "my.yaml").read_bytes() == before


def test_a_robot_with_two_sides_that_stands_still_is_not_taken_for_a_car(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{0.05 * k:g},{0.01 * (k % 7):g},{0.01 * (k % 5):g},1,2,0" for k in range(200)]
    still = tmp_path / "still.csv"
    still.write_text("\n".join(["t,left,right,x,y,yaw", *rows]))
    assert main(["sysid", str(still)]) == 1
    err = capsys.readouterr().err
    assert "there is no motion" in err
    assert "throttle" not in err
