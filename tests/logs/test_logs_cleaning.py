"""What cannot be used in a log is left out, counted and said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.logs import Drive, drive, located, wide_columns, wrapped, write_pair, write_table, write_wide
from support.wide_log import MADE, ROW, TIMES, WIDE, N, finding, read, refused

from kraft.errors import InputError
from kraft.logs.log import Finding, Log
from kraft.logs.motion import extent, tracks
from kraft.logs.reader import read_logs


def test_a_clean_log_has_no_findings(tmp_path: Path) -> None:
    (log,) = read_logs(write_pair(tmp_path, drive(turn=0.0))).logs
    assert log.findings == ()


def test_rows_without_numbers_are_left_out(tmp_path: Path) -> None:
    log = read(tmp_path, x=np.where(np.isin(ROW, [3, 9]), np.nan, WIDE["x"]))
    assert len(log.parts[0].poses) == N - 2
    assert finding(log, "nan") == Finding(
        "nan", 2, "2 of 235 poses are not numbers (NaN), first in line 5 of a.csv; left out"
    )


def test_a_time_stamp_counts_once(tmp_path: Path) -> None:
    log = read(tmp_path, t=np.where(ROW == 40, TIMES[39], TIMES))
    assert len(log.parts[0].poses) == N - 1
    assert (
        finding(log, "duplicate").text
        == "1 of 235 rows have the time stamp of the one before, first in line 42 of a.csv; left out"
    )


def test_time_that_runs_backwards_is_left_out(tmp_path: Path) -> None:
    log = read(tmp_path, t=np.where(ROW == 50, 0.1, TIMES))
    times = log.parts[0].pose_times
    assert np.all(np.diff(times) > 0)
    assert len(times) == N - 1
    assert finding(log, "backward").text == "time runs backwards in 1 of 235 rows, first in line 52 of a.csv; left out"


def test_a_clock_that_begins_again_is_refused(tmp_path: Path) -> None:
    problems, _ = refused(tmp_path, t=np.where(ROW < 100, TIMES, TIMES - 2.4))
    assert problems == ["a.csv:102 data"]


def test_wraps_of_the_yaw_are_counted_and_made_continuous(tmp_path: Path) -> None:
    log = read(tmp_path)
    assert np.abs(np.diff(log.parts[0].poses[:, 2])).max() < 0.1
    assert finding(log, "wrap").count == 1


def test_the_log_is_cut_at_a_gap(tmp_path: Path) -> None:
    keep = (TIMES < 2) | (TIMES > 3)
    path = write_table(tmp_path / "poses.csv", ["t", "x", "y", "yaw"], [WIDE[k][keep] for k in ("t", "x", "y", "yaw")])
    write_table(
        tmp_path / "commands.csv", ["t", "throttle", "steering"], [WIDE[k] for k in ("t", "throttle", "steering")]
    )
    (log,) = read_logs(path.parent).logs
    first, second = log.parts
    assert first.pose_times[-1] < 2
    assert second.pose_times[0] > 3 - 0.03
    assert finding(log, "gap").text.startswith(
        "1 gap without poses of up to 1.05 s, first after line 80 of poses.csv; "
    )
    assert second.command_times[0] == pytest.approx(second.pose_times[0] - 1.0, abs=0.026)  # what it may still obey
    assert first.command_times[-1] <= first.pose_times[-1]


def test_missing_poses_are_counted_and_end_no_part(tmp_path: Path) -> None:
    keep = ~np.isin(ROW, [20, 21, 90, 140])
    path = write_table(tmp_path / "a.csv", list(WIDE), [values[keep] for values in WIDE.values()])
    (log,) = read_logs(path).logs
    assert len(log.parts) == 1
    assert finding(log, "dropout").count == 4


def test_a_pause_of_commands_sent_at_a_rate_ends_a_part(tmp_path: Path) -> None:
    keep = (MADE.command_times < 2) | (MADE.command_times > 4)
    (log,) = read_logs(
        write_pair(tmp_path, Drive(MADE.command_times[keep], MADE.commands[keep], MADE.pose_times, MADE.poses))
    ).logs
    first, second = log.parts
    assert first.pose_times[-1] < 1.95 + 0.51
    assert second.pose_times[0] > 4
    assert finding(log, "command gap").text.startswith(
        "1 gap without commands of up to 2.1 s, first after line 41 of commands.csv"
    )


def test_what_was_commanded_before_a_pause_is_not_obeyed_after_it(tmp_path: Path) -> None:
    keep = (MADE.command_times < 2) | (MADE.command_times > 2.68)  # shorter than the history of a part
    made = Drive(MADE.command_times[keep], MADE.commands[keep], MADE.pose_times, MADE.poses)
    (log,) = read_logs(write_pair(tmp_path, made)).logs
    assert finding(log, "command gap").count == 1
    assert log.parts[1].command_times[0] == pytest.approx(2.7)
    assert log.parts[1].pose_times[0] >= 2.7


def test_commands_that_are_logged_when_they_change_are_held(tmp_path: Path) -> None:
    times = np.array([0.0, 0.1, 2.0, 4.5])
    made = Drive(times, np.column_stack([np.full(4, 0.5), [0.0, 0.1, 0.2, 0.3]]), MADE.pose_times, MADE.poses)
    (log,) = read_logs(write_pair(tmp_path, made)).logs
    (part,) = log.parts
    np.testing.assert_array_equal(part.command_times, times)
    assert len(part.poses) == len(MADE.poses)


def test_commands_that_are_logged_when_they_change_are_held_between_sweeps_at_a_rate(tmp_path: Path) -> None:
    at_a_rate = (MADE.command_times * 10).astype(int) % 13 < 7  # sweeps of 0.7 s, holds of 0.6 s
    kept = MADE.command_times[at_a_rate]
    made = Drive(kept, MADE.commands[at_a_rate], MADE.pose_times, MADE.poses)
    (log,) = read_logs(write_pair(tmp_path, made)).logs
    (part,) = log.parts
    np.testing.assert_array_equal(part.command_times, kept)
    assert len(part.poses) == len(MADE.poses)
    repeated = made.commands.copy()
    repeated[1::2] = repeated[: len(repeated) // 2 * 2 : 2]  # sent at a rate, whether they change or not
    write_pair(tmp_path / "rate", Drive(kept, repeated, MADE.pose_times, MADE.poses))
    (log,) = read_logs(tmp_path / "rate").logs
    assert finding(log, "command gap").count == 4


def test_a_clock_too_coarse_for_its_rows_is_refused_with_the_first_of_them(tmp_path: Path) -> None:
    problems, text = refused(tmp_path, t=np.floor(TIMES))
    assert problems == ["a.csv:3 data"]
    assert "of 235 rows have the t of the one before, and other numbers" in text


def test_poses_before_the_first_command_and_long_after_the_last_are_left_out(tmp_path: Path) -> None:
    keep = (MADE.command_times > 1) & (MADE.command_times < 4)
    (log,) = read_logs(
        write_pair(tmp_path, Drive(MADE.command_times[keep], MADE.commands[keep], MADE.pose_times, MADE.poses))
    ).logs
    (part,) = log.parts
    assert part.command_times[0] <= part.pose_times[0]
    assert part.pose_times[-1] <= part.command_times[-1] + 0.5
    early, late = [f for f in log.findings if f.kind == "uncommanded"]
    assert len(part.poses) + early.count + late.count == len(MADE.poses)


def test_an_outlier_is_left_out_and_a_teleport_ends_a_part(tmp_path: Path) -> None:
    outlier = ROW % 50 == 20
    log = read(tmp_path, x=np.where(outlier, 0.0, WIDE["x"]), y=np.where(outlier, 9.0, WIDE["y"]))
    assert finding(log, "outlier").count == 5
    assert len(log.parts) == 1
    assert log.parts[0].poses[:, 1].max() < 3
    log = read(tmp_path, x=WIDE["x"] + 5.0 * (ROW > 120))
    assert finding(log, "teleport").text == "1 teleport, first at line 123 of a.csv; the log is cut there"
    assert [len(part.poses) for part in log.parts] == [121, N - 121]


def test_a_flipped_marker_is_an_outlier(tmp_path: Path) -> None:
    log = read(tmp_path, yaw=wrapped(WIDE["yaw"] + np.pi * (ROW == 30)))
    assert finding(log, "outlier").count == 1
    assert np.abs(np.diff(log.parts[0].poses[:, 2])).max() < 0.1


def test_an_outlier_at_the_beginning_does_not_hide_the_rest() -> None:
    times = np.arange(40) * 0.05
    poses = np.column_stack([times, times * 0, times * 0])
    poses[0] = (50.0, 0.0, 0.0)
    labels = tracks(times, poses, 3.0)
    assert len(set(labels[1:])) == 1
    assert labels[0] != labels[1]


def test_noise_that_steps_farther_than_the_vehicle_drives_is_no_teleport(tmp_path: Path) -> None:
    noise = np.random.default_rng(4).normal(0, 0.06, (2, N))
    assert np.hypot(*np.diff(noise)).max() > 0.05 + 3.0 * 0.025  # what a vehicle at the least top speed could reach
    log = read(tmp_path, x=WIDE["x"] + noise[0], y=WIDE["y"] + noise[1])
    assert len(log.parts[0].poses) == N
    assert {f.kind for f in log.findings} == {"wrap"}


def test_noise_and_small_outliers_stay_for_the_robust_loss(tmp_path: Path) -> None:
    noise = np.random.default_rng(3).normal(0, 0.02, (2, N))
    log = read(tmp_path, x=WIDE["x"] + noise[0], y=WIDE["y"] + noise[1])
    assert len(log.parts[0].poses) == N
    assert {f.kind for f in log.findings} == {"wrap"}


def test_poses_that_stand_still_while_the_vehicle_moves_are_left_out(tmp_path: Path) -> None:
    old = np.where(ROW % 6 == 5, ROW - 1, ROW)
    log = read(tmp_path, **{name: WIDE[name][old] for name in ("x", "y", "yaw")})
    assert finding(log, "stale").count == 39
    assert len(log.parts[0].poses) == N - 39


def test_poses_that_stand_still_for_long_while_the_vehicle_turns_are_left_out(tmp_path: Path) -> None:
    """It ends near where they stood still, so that its speed on the chord is small."""
    times, angles = 0.03 * np.arange(400), 0.06 * np.arange(400)  # 2 m/s in a circle of 1 m
    old = np.where((np.arange(400) >= 100) & (np.arange(400) < 300), 100, np.arange(400))
    noise = np.random.default_rng(0).normal(0.0, 0.002, (400, 2))
    x, y = (np.column_stack([np.sin(angles), 1.0 - np.cos(angles)]) + noise)[old].T
    columns = {"t": times, "throttle": np.ones(400), "steering": np.full(400, 0.3)}
    log = read(tmp_path, **columns, x=x, y=y, yaw=wrapped(angles[old]))
    assert finding(log, "stale").count == 199
    assert {f.kind for f in log.findings} == {"stale", "gap", "wrap"}
    assert [len(part.poses) for part in log.parts] == [101, 100]


def test_an_outlier_after_a_standstill_does_not_make_its_poses_stale(tmp_path: Path) -> None:
    stop = np.concatenate([ROW[:80], np.full(75, 80), ROW[80 : N - 75]])
    x = WIDE["x"][stop]
    x[150] += 1.0
    log = read(tmp_path, x=x, **{name: WIDE[name][stop] for name in ("y", "yaw")})
    assert [f.kind for f in log.findings if f.kind != "wrap"] == ["outlier"]
    assert len(log.parts[0].poses) == N - 1


def test_a_vehicle_that_stops_and_goes_on_is_believed(tmp_path: Path) -> None:
    stop = np.concatenate([ROW[:80], np.full(75, 80), ROW[80 : N - 75]])
    log = read(tmp_path, **{name: WIDE[name][stop] for name in ("x", "y", "yaw")})
    assert len(log.parts[0].poses) == N
    assert {f.kind for f in log.findings} <= {"wrap"}


def test_while_the_dead_man_switch_is_released_the_log_does_not_count(tmp_path: Path) -> None:
    held = (ROW // 40) % 2 == 1
    log = read(tmp_path, dead_man=held.astype(float))
    assert [len(part.poses) for part in log.parts] == [40, 40, 35]
    assert all(part.command_times[0] == part.pose_times[0] for part in log.parts)  # earlier commands reached nothing
    assert finding(log, "dead man").count == N - 115
    assert "dead man: time from 't' (s), dead man from 'dead_man'" in log.guess
    problems, _ = refused(tmp_path, dead_man=np.zeros(N))
    assert problems == ["a.csv data"]


def test_a_command_from_before_the_switch_was_held_counts_from_when_it_is(tmp_path: Path) -> None:
    """Poses and switch have one clock, commands another, so that the switch is never held just when a command is sent."""
    held = (MADE.pose_times >= 2).astype(float)
    columns = [MADE.pose_times, *MADE.poses[:, :2].T, wrapped(MADE.poses[:, 2]), held]
    write_table(tmp_path / "poses.csv", ["t", "x", "y", "yaw", "dead_man"], columns)
    write_table(tmp_path / "commands.csv", ["t", "throttle", "steering"], [MADE.command_times, *MADE.commands.T])
    (log,) = read_logs(tmp_path).logs
    (part,) = log.parts
    since = part.pose_times[0]
    sent = int(np.searchsorted(MADE.command_times, since, side="right")) - 1
    assert MADE.command_times[sent] < since - 0.005
    assert part.command_times[0] == since
    np.testing.assert_array_equal(part.commands[0], MADE.commands[sent])


def test_a_switch_that_could_be_either_of_two_columns_is_an_error(tmp_path: Path) -> None:
    held = ((ROW // 40) % 2 == 1).astype(float)
    problems, message = refused(tmp_path, armed=held, enabled=held)
    assert problems == ["a.csv conflict"]
    assert "'armed', 'enabled'" in message
    columns = {**WIDE, "armed": held, "enabled": held}
    del columns["throttle"], columns["yaw"]
    with pytest.raises(InputError) as error:
        read_logs(write_table(tmp_path / "a.csv", list(columns), list(columns.values())))
    # with the missing columns: every problem at once
    assert sorted(located(error.value.diagnostics, tmp_path)) == ["a.csv conflict", "a.csv missing", "a.csv missing"]


def test_a_doubtful_switch_in_one_file_is_not_made_up_for_by_another(tmp_path: Path) -> None:
    held = ((ROW // 40) % 2 == 1).astype(float)
    commands, poses = ("t", "throttle", "steering"), ("t", "x", "y", "yaw")
    write_table(tmp_path / "commands.csv", [*commands, "enabled"], [*(WIDE[k] for k in commands), held])
    write_table(tmp_path / "poses.csv", [*poses, "armed", "engaged"], [*(WIDE[k] for k in poses), held, held])
    with pytest.raises(InputError, match="'armed', 'engaged'") as error:
        read_logs(tmp_path)
    assert located(error.value.diagnostics, tmp_path) == ["poses.csv conflict"]
    write_table(tmp_path / "poses.csv", [*poses, "rc_was_armed"], [*(WIDE[k] for k in poses), held * 0])
    (log,) = read_logs(tmp_path).logs
    assert [len(part.poses) for part in log.parts] == [40, 40, 35]
    assert log.guess.endswith(
        "dead man: commands.csv: time from 't' (s), dead man from 'enabled'; not used: rc_was_armed of poses.csv"
    )


def test_no_motion_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, (3, N))
    problems, message = refused(tmp_path, x=noise[0], y=noise[1], yaw=noise[2])
    assert problems == ["a.csv data"]
    assert "limits.least_motion" in message


def test_a_log_of_less_than_half_a_second_may_move(tmp_path: Path) -> None:
    path = write_table(tmp_path / "a.csv", list(WIDE), [values[:16] for values in WIDE.values()])
    (log,) = read_logs(path).logs  # 0.3 m in 0.375 s
    assert len(log.parts[0].poses) == 16
    still = {
        name: np.full(16, values[0]) if name in ("x", "y", "yaw") else values[:16] for name, values in WIDE.items()
    }
    write_table(path, list(still), list(still.values()))
    with pytest.raises(InputError, match=r"limits\.least_motion") as error:
        read_logs(path)
    assert located(error.value.diagnostics, tmp_path) == ["a.csv data"]


@pytest.mark.parametrize("duration", [0.1, 0.49, 0.5, 0.51, 1.3, 20.0])
def test_a_straight_drive_gets_as_far_as_the_first_mean_is_from_the_last(duration: float) -> None:
    times = 7 + np.linspace(0, duration, 1001)
    way, turn = extent(times, np.column_stack([0.8 * times, 0 * times, 0.1 * times]))
    block = min(0.5, duration / 2)
    assert 0.8 * (duration - block) <= way + 0.002 * duration
    assert way < 0.8 * duration
    assert turn == pytest.approx(way / 8)


def test_commands_and_poses_of_different_times_are_refused(tmp_path: Path) -> None:
    write_pair(tmp_path, Drive(MADE.command_times + 1.7e9, MADE.commands, MADE.pose_times, MADE.poses))
    with pytest.raises(InputError) as error:
        read_logs(tmp_path)
    assert located(error.value.diagnostics, tmp_path) == ["poses.csv data"]
    assert "commands.csv: 1699999999.990" in str(error.value)


def test_few_commands_of_another_day_do_not_reach_the_poses(tmp_path: Path) -> None:
    write_pair(tmp_path, Drive(MADE.command_times[:5], MADE.commands[:5], MADE.pose_times + 1e5, MADE.poses))
    with pytest.raises(InputError) as error:
        read_logs(tmp_path)
    assert located(error.value.diagnostics, tmp_path) == ["poses.csv data"]


def test_pieces_of_fewer_than_three_poses_are_left_out(tmp_path: Path) -> None:
    keep = (TIMES < 2) | (np.abs(TIMES - 3.0) < 0.03) | (TIMES > 4)
    commands, poses = ("t", "throttle", "steering"), ("t", "x", "y", "yaw")
    write_table(tmp_path / "commands.csv", commands, [WIDE[k] for k in commands])
    write_table(tmp_path / "poses.csv", poses, [WIDE[k][keep & (ROW != 119)] for k in poses])
    (log,) = read_logs(tmp_path).logs
    assert finding(log, "short").count == 2
    assert len(log.parts) == 2


def oriented(tmp_path: Path, x: float, y: float, z: np.ndarray, w: np.ndarray) -> Log:
    columns = {k: v for k, v in WIDE.items() if k != "yaw"} | {"qx": z * 0 + x, "qy": z * 0 + y, "qz": z, "qw": w}
    (log,) = read_logs(write_table(tmp_path / "a.csv", list(columns), list(columns.values()))).logs
    return log


def test_an_orientation_of_zeros_is_no_orientation(tmp_path: Path) -> None:
    seen = ~np.isin(ROW, [7, 8])
    log = oriented(tmp_path, 0.0, 0.0, np.sin(WIDE["yaw"] / 2) * seen, np.cos(WIDE["yaw"] / 2) * seen)
    assert finding(log, "nan").text == "2 of 235 poses have no orientation, first in line 9 of a.csv; left out"
    with pytest.raises(InputError, match="qx, qy, qz, qw") as error:
        oriented(tmp_path, 0.0, 0.0, WIDE["yaw"] * 0, WIDE["yaw"] * 0)
    assert located(error.value.diagnostics, tmp_path) == ["a.csv:2 data"]


@pytest.mark.filterwarnings("error")
def test_a_log_with_an_orientation_in_a_single_pose_is_refused(tmp_path: Path) -> None:
    seen = ROW == 5
    with pytest.raises(InputError) as error:
        oriented(tmp_path, 0.0, 0.0, np.sin(WIDE["yaw"] / 2) * seen, np.cos(WIDE["yaw"] / 2) * seen)
    assert located(error.value.diagnostics, tmp_path) == ["a.csv:7 data"]


def test_a_vehicle_that_lies_on_its_side_is_said(tmp_path: Path) -> None:
    log = oriented(tmp_path, 0.7, 0.1, WIDE["yaw"] * 0, WIDE["yaw"] * 0 + 0.7)
    assert finding(log, "tilted").count == 1


def test_a_vehicle_whose_axis_up_is_y_is_said_though_its_heading_is_mostly_ahead(tmp_path: Path) -> None:
    yaw = np.where(0.8 * len(ROW) > ROW, 0.1, 2.0)
    log = oriented(tmp_path, 0.0, np.sin(yaw / 2), 0.0 * yaw, np.cos(yaw / 2))
    assert finding(log, "tilted").count == 1


def test_a_line_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    path = write_wide(tmp_path / "a.csv")
    path.write_text(path.read_text()[:-60])
    (log,) = read_logs(path).logs
    assert finding(log, "broken").text == "1 line of a.csv with too few or too many fields, first line 236; left out"


def test_zeros_before_the_first_message_are_left_out(tmp_path: Path) -> None:
    early = ROW < 30
    log = read(tmp_path, **{name: np.where(early, 0.0, WIDE[name]) for name in ("throttle", "steering")})
    assert finding(log, "zeros").count == 30  # the car moved meanwhile
    assert finding(log, "uncommanded").count == 30
    shifted = {"x": WIDE["x"] + 3.0, "y": WIDE["y"] - 2.0, "yaw": WIDE["yaw"]}
    log = read(tmp_path, **{name: np.where(early, 0.0, values) for name, values in shifted.items()})
    assert finding(log, "zeros").count == 30
    assert len(log.parts[0].poses) == N - 30


def test_a_car_that_waits_at_the_origin_is_commanded_zero(tmp_path: Path) -> None:
    waits = {name: np.concatenate([np.zeros(30), WIDE[name][:-30] - WIDE[name][0]]) for name in ("x", "y", "yaw")}
    commands = {name: np.where(ROW < 30, 0.0, WIDE[name]) for name in ("throttle", "steering")}
    log = read(tmp_path, **waits, **commands)
    assert {f.kind for f in log.findings} <= {"wrap"}
    assert len(log.parts[0].poses) == N


def test_a_glitch_while_the_car_waits_is_no_motion(tmp_path: Path) -> None:
    waits = {name: np.concatenate([np.zeros(30), WIDE[name][:-30] - WIDE[name][0]]) for name in ("x", "y", "yaw")}
    waits["x"] = np.where(ROW == 12, 3.0, waits["x"] + 1.0 + 1e-4 * (ROW % 2))
    commands = {name: np.where(ROW < 30, 0.0, WIDE[name]) for name in ("throttle", "steering")}
    log = read(tmp_path, **waits, **commands)
    assert finding(log, "outlier").count == 1
    assert {f.kind for f in log.findings} <= {"wrap", "outlier"}


@pytest.mark.parametrize(("every", "found"), [(4, 1), (1, 0)])
def test_commands_that_are_recorded_more_often_than_they_are_sent_are_said(
    tmp_path: Path, every: int, found: int
) -> None:
    rows = np.arange(0.02, 5.9, 0.02)
    wide = wide_columns(rows, MADE)
    for name in ("throttle", "steering"):
        wide[name] = (0.3 + 0.02 * np.sin(rows))[(np.arange(len(rows)) // every) * every]
    (log,) = read_logs(write_table(tmp_path / "a.csv", list(wide), list(wide.values()))).logs
    assert len([f for f in log.findings if f.kind == "repeated"]) == found


@pytest.mark.parametrize("first", [0, 7])
def test_outliers_of_half_a_metre_are_left_out_and_hide_nothing(tmp_path: Path, first: int) -> None:
    """One of twenty poses: neither the heading, nor the top speed, nor the beginning is taken for something else."""
    rng = np.random.default_rng(3)
    bad = np.arange(first, N, 20)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(bad))
    x, y = WIDE["x"].copy(), WIDE["y"].copy()
    x[bad] += 0.5 * np.cos(angle)
    y[bad] += 0.5 * np.sin(angle)
    log = read(tmp_path, x=x, y=y)
    assert [f.kind for f in log.findings if f.kind in ("heading", "zeros")] == []
    assert "more than 3 m/s" in finding(log, "outlier").text
    kept = np.concatenate([part.poses[:, :2] for part in log.parts])
    right = np.column_stack([WIDE["x"], WIDE["y"]])
    assert max(np.hypot(*(right - pose).T).min() for pose in kept[1:]) < 0.01
