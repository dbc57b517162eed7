"""What is in the wrong unit, or along other axes, is refused or said with what to write into a mapping file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.logs import drive, write_table, write_wide
from support.wide_log import MADE, TIMES, WIDE, N, finding, read, refused

from kraft.errors import Code, InputError
from kraft.logs.mapping import Column, Mapping, Poses
from kraft.logs.reader import read_logs


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"yaw": np.rad2deg(WIDE["yaw"])}, "poses.yaw: {column: 'yaw', unit: deg}"),
        ({"yaw": np.rad2deg(np.unwrap(WIDE["yaw"]))}, "poses.yaw: {column: 'yaw', unit: deg}"),
        ({"steering": np.rad2deg(WIDE["steering"])}, "commands.controls.steering: {column: 'steering', unit: deg}"),
        ({"x": WIDE["x"] * 1e3, "y": WIDE["y"] * 1e3}, "poses.x: {column: 'x', unit: mm}"),
        ({"x": WIDE["x"] * 50, "y": WIDE["y"] * 50}, "poses.x: {column: 'x', unit: cm}"),
        ({"x": WIDE["x"] * 200, "y": WIDE["y"] * 200}, "or cm: the speed would be 0.16 m/s in mm and 1.6 m/s in cm"),
        ({"t": TIMES * 1e3}, "poses.time: {column: 't', unit: ms}"),
        ({"throttle": 1500 + 300 * np.sin(TIMES)}, "commands.controls.throttle: {column: 'throttle', zero: 1500, scale: 0.002}"),
    ],
)  # fmt: skip
def test_a_wrong_unit_is_refused_with_what_to_write(
    tmp_path: Path, changed: dict[str, np.ndarray], expected: str
) -> None:
    problems, message = refused(tmp_path, **changed)
    assert [problem.split()[-1] for problem in problems] == [Code.DATA]
    assert expected in message


def test_pulse_widths_of_the_steering_are_proposed_as_the_angles_of_the_vehicle(tmp_path: Path) -> None:
    write_wide(tmp_path / "log.csv", {"steering": 1500 + 400 * np.sin(TIMES)})
    with pytest.raises(InputError) as error:
        read_logs(tmp_path, limits={"throttle": (0.0, 1.0), "steering": (-0.38, 0.38)})
    (problem,) = error.value.diagnostics
    assert "{column: 'steering', zero: 1500, scale: 0.00076}" in problem.expected
    assert "a guess that 1000 to 2000 is -0.38 to 0.38 rad; its sign may be the opposite one" in problem.expected


def test_radians_that_were_never_wrapped_are_no_degrees(tmp_path: Path) -> None:
    made = drive(duration=40.0, turn=1.5)  # about ten rounds: 60 rad
    assert made.poses[:, 2].max() > 59
    write_table(tmp_path / "poses.csv", ["t", "x", "y", "yaw"], [made.pose_times, *made.poses.T])
    write_table(tmp_path / "commands.csv", ["t", "throttle", "steering"], [made.command_times, *made.commands.T])
    (log,) = read_logs(tmp_path).logs
    np.testing.assert_allclose(log.parts[0].poses, made.poses)


@pytest.mark.parametrize("heading", [40.0, -100.0, 170.0])
def test_degrees_on_a_straight_line_are_told_by_its_direction(tmp_path: Path, heading: float) -> None:
    way, yaw = 0.8 * TIMES, np.full(N, heading)
    noise = np.random.default_rng(5).normal(0, 1.0, N)
    straight = {"x": way * np.cos(np.deg2rad(heading)), "y": way * np.sin(np.deg2rad(heading))}
    for values in (yaw, yaw + noise):
        _, message = refused(tmp_path, **straight, yaw=values)
        assert "poses.yaw: {column: 'yaw', unit: deg}" in message
    (part,) = read(tmp_path, **straight, yaw=np.deg2rad(yaw + noise)).parts
    assert len(part.poses) == N


def test_degrees_on_a_straight_line_are_told_by_the_other_logs(tmp_path: Path) -> None:
    straight = np.column_stack([0.8 * MADE.pose_times, 0 * MADE.pose_times, 0 * MADE.pose_times + 2.0])
    for name, poses in (("curved", MADE.poses * (1, 1, 180 / np.pi)), ("straight", straight)):
        write_table(tmp_path / name / "poses.csv", ["t", "x", "y", "yaw"], [MADE.pose_times, *poses.T])
        write_table(
            tmp_path / name / "commands.csv", ["t", "throttle", "steering"], [MADE.command_times, *MADE.commands.T]
        )
    write_wide(tmp_path / "other.csv", {}, drive(turn=0.3))
    (tmp_path / "other.csv").write_text((tmp_path / "other.csv").read_text().replace("yaw", "theta"))
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["other"]
    curved, alike = found.problems
    assert "curved" in curved.file
    assert "straight" in alike.file
    assert (curved.code, alike.code) == (Code.DATA, Code.DATA)


def test_a_yaw_that_turns_the_other_way_is_said(tmp_path: Path) -> None:
    text = finding(read(tmp_path, yaw=-WIDE["yaw"]), "heading").text
    assert "(poses.yaw: {column: 'yaw', unit: rad, scale: -1})" in text


def test_swapped_x_and_y_are_refused_with_what_to_write(tmp_path: Path) -> None:
    problems, message = refused(tmp_path, x=WIDE["y"], y=WIDE["x"])
    assert problems == ["a.csv mismatch"]
    assert "write poses: {x: 'y', y: 'x'} into a mapping file" in message
    assert "or for a compass heading poses.yaw: {column: 'yaw', unit: rad, zero: 1.5708, scale: -1}" in message


def with_yaw(tmp_path: Path, degrees: np.ndarray) -> Path:
    """A log whose yaw is in degrees and called `heading_deg`."""
    columns = {name: values for name, values in WIDE.items() if name != "yaw"} | {"heading_deg": degrees}
    return write_table(tmp_path / "a.csv", list(columns), list(columns.values()))


def test_the_line_for_a_compass_heading_makes_it_a_yaw(tmp_path: Path) -> None:
    path = with_yaw(tmp_path, (90.0 - np.rad2deg(WIDE["yaw"])) % 360.0)
    with pytest.raises(InputError) as error:
        read_logs(path)
    assert "poses.yaw: {column: 'heading_deg', unit: deg, zero: 90, scale: -1}" in str(error.value)
    stated = Mapping(poses=Poses(yaw=Column(column="heading_deg", unit="deg", zero=90.0, scale=-1.0)))
    (log,) = read_logs(path, mapping=stated).logs
    assert not [f for f in log.findings if f.kind == "heading"]
    turned = Mapping(poses=Poses(yaw=Column(column="heading_deg", unit="deg", scale=-1.0)))
    (log,) = read_logs(path, mapping=turned).logs
    assert "unit: deg, zero: 90, scale: -1}" in finding(log, "heading").text


@pytest.mark.parametrize("turn", [90.0, -90.0])
def test_a_yaw_at_a_right_angle_to_the_motion_is_said_with_what_to_write(tmp_path: Path, turn: float) -> None:
    (log,) = read_logs(with_yaw(tmp_path, np.rad2deg(WIDE["yaw"]) + turn)).logs
    assert f"poses.yaw: {{column: 'heading_deg', unit: deg, zero: {turn:g}}}" in finding(log, "heading").text


@pytest.mark.parametrize(
    "changed",
    [
        {"yaw": np.rad2deg(WIDE["yaw"])},
        {"steering": np.rad2deg(WIDE["steering"])},
        {"x": WIDE["y"], "y": WIDE["x"]},
        {"yaw": np.pi / 2 - WIDE["yaw"]},
    ],
    ids=["degrees", "steering", "swapped", "compass"],
)
def test_a_log_that_shows_its_own_units_and_axes_is_not_left_out_with_another(
    tmp_path: Path, changed: dict[str, np.ndarray]
) -> None:
    write_wide(tmp_path / "good.csv")
    write_wide(tmp_path / "slight.csv", made=drive(turn=0.1))
    write_wide(tmp_path / "bad.csv", changed)
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["good", "slight"]
    assert [problem.file for problem in found.problems] == [str(tmp_path / "bad.csv")]


@pytest.mark.parametrize("steering", [0.0, 1.2])
def test_a_straight_drive_does_not_show_the_unit_of_its_steering(tmp_path: Path, steering: float) -> None:
    write_wide(tmp_path / "curved.csv", {"steering": np.rad2deg(WIDE["steering"])})
    still = np.zeros(N)
    write_wide(tmp_path / "straight.csv", {"x": 0.8 * TIMES, "y": still, "yaw": still, "steering": still + steering})
    with pytest.raises(InputError) as error:
        read_logs(tmp_path)
    assert {problem.file for problem in error.value.diagnostics} == {
        str(tmp_path / name) for name in ("curved.csv", "straight.csv")
    }
