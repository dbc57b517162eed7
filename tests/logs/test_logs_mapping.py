"""The mapping file overrides the guess, and what is wrong in it is said at its line and column."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.logs import Bag, drive, located, nanoseconds, wide_columns, wrapped, write_table, write_wide
from support.paths import ROOT

from kraft.errors import InputError
from kraft.logs.guess import guess_commands
from kraft.logs.log import Log
from kraft.logs.mapping import Mapping, load_mapping
from kraft.logs.reader import heading, mapping_mismatch, read_logs
from kraft.logs.table import Table
from kraft.vehicles import CAR_CONTROLS
from kraft_cli.work.validate import check_file

MADE = drive()
TIMES = np.arange(0.025, 5.9, 0.025)
WIDE = wide_columns(TIMES, MADE)
DOCS = ROOT / "docs" / "logs.md"

ODD = {
    "a": TIMES * 1e3,
    "b": 1500 + 400 * WIDE["throttle"],
    "c": np.rad2deg(-WIDE["steering"]),
    "d": WIDE["x"] * 100,
    "e": WIDE["y"] * 100,
    "f": np.rad2deg(WIDE["yaw"]),
}
MAPPING = """\
commands:
  time: {column: a, unit: ms}
  controls:
    throttle: {column: b, zero: 1500, scale: 0.0025}
    steering: {column: c, unit: deg, scale: -1}
poses:
  time: {column: a, unit: ms}
  x: {column: d, unit: cm}
  y: {column: e, unit: cm}
  yaw: {column: f, unit: deg}
"""


def mapping_of(folder: Path, text: str) -> Mapping:
    (folder / "m.yaml").write_text(text, encoding="utf-8")
    return load_mapping(folder / "m.yaml")


def read(folder: Path, text: str, columns: dict[str, np.ndarray]) -> Log:
    path = write_table(folder / "logs" / "a.csv", list(columns), list(columns.values()))
    (log,) = read_logs(path, mapping=mapping_of(folder, text)).logs
    return log


def same_as_wide(log: Log) -> None:
    (part,) = log.parts
    np.testing.assert_allclose(part.pose_times, TIMES - TIMES[0], atol=1e-12)
    np.testing.assert_allclose(part.poses, np.column_stack([WIDE["x"], WIDE["y"], np.unwrap(WIDE["yaw"])]), atol=1e-9)
    np.testing.assert_allclose(part.commands, np.column_stack([WIDE["throttle"], WIDE["steering"]]), atol=1e-9)


def test_columns_without_names_are_read_as_the_mapping_says(tmp_path: Path) -> None:
    log = read(tmp_path, MAPPING, ODD)
    same_as_wide(log)
    assert "steering from 'c' (deg, converted)" in log.guess


def test_what_the_mapping_leaves_out_is_guessed(tmp_path: Path) -> None:
    columns = {**WIDE, "strange": WIDE["yaw"]}
    del columns["yaw"]
    log = read(tmp_path, "poses: {yaw: strange}\n", columns)
    same_as_wide(log)
    assert "yaw from 'strange' (rad)" in log.guess


def test_the_mapping_is_stronger_than_a_good_name(tmp_path: Path) -> None:
    columns = {**WIDE, "other": WIDE["throttle"] + 1}
    log = read(tmp_path, "commands: {controls: {throttle: other}}\n", columns)
    np.testing.assert_allclose(log.parts[0].commands[:, 0], WIDE["throttle"] + 1)


def test_degrees_are_converted_when_the_mapping_says_so(tmp_path: Path) -> None:
    same_as_wide(read(tmp_path, "poses: {yaw: {column: yaw, unit: deg}}\n", {**WIDE, "yaw": np.rad2deg(WIDE["yaw"])}))


def test_a_unit_in_the_mapping_is_believed(tmp_path: Path) -> None:
    big = {**WIDE, "steering": WIDE["steering"] * 20}
    log = read(tmp_path, "commands: {controls: {steering: {column: steering, unit: rad}}}\n", big)
    np.testing.assert_allclose(log.parts[0].commands[:, 1], big["steering"])


def test_controls_may_be_in_tables_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    write_table(folder / "motor.csv", ["t", "value"], [TIMES, WIDE["throttle"]])
    write_table(folder / "servo.csv", ["t", "value"], [TIMES + 0.01, WIDE["steering"]])
    write_table(folder / "mocap.csv", ["t", "x", "y", "yaw"], [TIMES, WIDE["x"], WIDE["y"], WIDE["yaw"]])
    text = """\
commands:
  controls:
    throttle: {table: motor.csv, column: value}
    steering: {table: servo.csv, column: value}
poses: {table: mocap.csv}
"""
    (log,) = read_logs(folder, mapping=mapping_of(tmp_path, text)).logs
    (part,) = log.parts
    assert len(part.command_times) == 2 * len(TIMES) - 2  # each change of either, once both are known, to the last pose
    held = np.searchsorted(TIMES + 0.01, part.command_times + TIMES[0] + 1e-9, side="right") - 1
    np.testing.assert_allclose(part.commands[:, 1], WIDE["steering"][held])
    assert len(log.sources) == 3


def test_commands_are_known_only_while_each_control_is_commanded(tmp_path: Path) -> None:
    folder, on = tmp_path / "logs", TIMES < 3
    write_table(folder / "motor.csv", ["t", "throttle"], [TIMES, WIDE["throttle"]])
    write_table(folder / "servo.csv", ["t", "steering"], [TIMES[on], WIDE["steering"][on]])
    write_table(folder / "mocap.csv", ["t", "x", "y", "yaw"], [TIMES, WIDE["x"], WIDE["y"], WIDE["yaw"]])
    text = """\
commands:
  controls:
    throttle: {table: motor.csv, column: throttle}
    steering: {table: servo.csv, column: steering}
poses: {table: mocap.csv}
"""
    (log,) = read_logs(folder, mapping=mapping_of(tmp_path, text)).logs
    (part,) = log.parts
    assert part.pose_times[-1] + TIMES[0] == pytest.approx(TIMES[on][-1] + 0.5, abs=0.026)
    (late,) = [found for found in log.findings if found.kind == "uncommanded"]
    assert late.count == len(TIMES) - len(part.poses)


def test_a_mapping_counts_for_the_folder_of_a_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    steps = {"time": TIMES, "x": 0 * TIMES, "command_throttle": WIDE["throttle"], "command_steering": WIDE["steering"]}
    seen = {"time": TIMES, "arrival": TIMES + 0.08, "x": WIDE["x"], "y": WIDE["y"], "theta": WIDE["yaw"]}
    write_table(run / "steps.csv", list(steps), list(steps.values()))
    write_table(run / "observations.csv", list(seen), list(seen.values()))
    scaled = mapping_of(tmp_path, "commands: {controls: {throttle: {column: command_throttle, scale: 2}}}\n")
    (log,) = read_logs(run, mapping=scaled).logs
    np.testing.assert_allclose(log.parts[0].commands[:, 0], 2 * WIDE["throttle"])
    truth = mapping_of(tmp_path, "poses: {table: steps.csv}\n")
    with pytest.raises(InputError, match="x or as y or as yaw") as error:
        read_logs(run, mapping=truth)
    assert located(error.value.diagnostics, run) == ["steps.csv missing"]


def test_columns_that_only_look_like_a_switch_can_be_overruled(tmp_path: Path) -> None:
    columns = {**WIDE, "left_enabled": TIMES * 0, "right_enabled": TIMES * 0}
    same_as_wide(read(tmp_path, "dead_man: {column: left_enabled, above: -1}\n", columns))


def test_a_switch_without_a_clock_of_its_own_is_on_the_one_that_is_named(tmp_path: Path) -> None:
    columns = {"time [s]": TIMES + 1000.0, **WIDE, "dead_man": (TIMES < 3).astype(float)}
    log = read(tmp_path, "commands: {time: t}\nposes: {time: t}\n", columns)
    assert "dead man: time from 't' (s)" in log.guess
    assert log.parts[0].pose_times[-1] == pytest.approx(3 - 0.025 - TIMES[0])


def test_a_topic_of_any_type_can_be_named(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "mcap") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            for topic, value in (("/motor", speed), ("/servo", steering)):
                bag.send(topic, "std_msgs/msg/Float64", nanoseconds(time), bag.make("std_msgs/msg/Float64", value))
            buttons = np.array([0, int(time >= 1)], np.int32)
            joy = bag.make("sensor_msgs/msg/Joy", bag.header(nanoseconds(time)), np.zeros(2, np.float32), buttons)
            bag.send("/joy", "sensor_msgs/msg/Joy", nanoseconds(time), joy)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose)
    text = """\
commands:
  controls: {throttle: {table: /motor, column: data}, steering: {table: /servo, column: data}}
dead_man: {table: /joy, column: "buttons[1]"}
"""
    (log,) = read_logs(tmp_path / "a", mapping=mapping_of(tmp_path, text)).logs
    (part,) = log.parts
    assert 1.0 <= part.pose_times[0] < 1.04
    expected = MADE.commands[MADE.command_times >= 0.99]
    np.testing.assert_allclose(part.commands, expected[: len(part.commands)])


def test_an_inverted_switch_is_held_while_it_is_low(tmp_path: Path) -> None:
    stopped = (TIMES >= 3).astype(float)
    log = read(tmp_path, "dead_man: {column: estop, inverted: true}\n", {**WIDE, "estop": stopped})
    assert log.parts[0].pose_times[-1] == pytest.approx(3 - 0.025 - TIMES[0])


def test_limits_are_what_the_mapping_says(tmp_path: Path) -> None:
    gap = {name: values[(TIMES < 2) | (TIMES > 2.3)] for name, values in WIDE.items()}
    assert len(read(tmp_path, "limits: {pose_gap: 1}\n", gap).parts) == 1
    assert len(read(tmp_path, "limits: {pose_gap: 0.2}\n", gap).parts) == 2
    assert len(read(tmp_path, "limits: {top_speed: 500}\n", {**WIDE, "x": WIDE["x"] + 5 * (TIMES > 3)}).parts) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("poses: {yaw: hding}\n", "m.yaml:1:14 poses.yaw unknown"),
        ("poses:\n  yaw: {column: q, unit: deg}\n", "m.yaml:2:17 poses.yaw.column unknown"),
        ("commands: {controls: {throtle: throttle}}\n", "m.yaml:1:23 commands.controls.throtle unknown"),
        ("poses: {table: b.csv}\n", "m.yaml:1:16 poses.table unknown"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_log_is_said_in_the_mapping_file(tmp_path: Path, text: str, expected: str) -> None:
    columns = {("heading" if name == "yaw" else name): values for name, values in WIDE.items()}
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    with pytest.raises(InputError) as error:
        read_logs(path, mapping=mapping_of(tmp_path, text))
    assert located(error.value.diagnostics, tmp_path) == [expected]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("poses: {yaw: {column: a, unit: degrees}}\n", "1:32 poses.yaw.unit"),
        ("poses: {yaw: {column: a, unit: mm}}\n", "1:32 poses.yaw.unit"),
        ("commands: {controls: {steering: {column: a, unit: ms}}}\n", "1:51 commands.controls.steering.unit"),
        ("poses: {time: {unit: ms}}\n", "1:9 poses.time.column"),
        ("pose: {x: a}\n", "1:1 pose"),
        ("poses: {x: {colum: a}}\n", "1:13 poses.x.colum"),
        ("poses: {x: 3}\n", "1:12 poses.x"),
        ("poses: {x: {column: a, scale: 0}}\n", "1:31 poses.x.scale"),
        ("poses: {x: {column: a, table: b.csv}}\n", "1:31 poses.x.table"),
        ("commands: {time: {column: a, table: b.csv}}\n", "1:37 commands.time.table"),
        ("dead_man: {column: a, time: {column: b, table: b.csv}}\n", "1:48 dead_man.time.table"),
        ("poses: {yaw: a, quaternion: [a, b, c, d]}\n", "1:29 poses.quaternion"),
        ("limits: {pose_gap: -1}\n", "1:20 limits.pose_gap"),
        ("dead_man: {column: a, masks: []}\n", "1:30 dead_man.masks"),
        ("commands: {controls: {throttle: a}}\ndead_man: {column: b, masks: [throtle]}\n", "2:31 dead_man.masks[0]"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_mapping_file_is_said_at_its_place(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as error:
        mapping_of(tmp_path, text)
    (problem,) = error.value.diagnostics
    assert f"{problem.line}:{problem.column} {problem.path}" == expected
    checked = check_file(tmp_path / "m.yaml", print)
    assert (checked.kind, checked.problems) == ("mapping", error.value.diagnostics)


def test_an_unknown_control_is_said_alike_of_one_log_and_of_all(tmp_path: Path) -> None:
    said = mapping_of(
        tmp_path,
        "commands: {controls: {throtle: a, steering: steering, brake: b}}\ndead_man: {column: d, masks: [brake]}\n",
    )
    table = Table("a.csv", "", WIDE, np.zeros(len(TIMES), np.int64))
    with pytest.raises(InputError) as error:
        guess_commands([table], CAR_CONTROLS, said)
    assert [problem.path for problem in error.value.diagnostics] == [
        *(f"commands.controls.{n}" for n in ("throtle", "brake")),
        "dead_man.masks[0]",
    ]
    assert mapping_mismatch("logs", [heading(table)], CAR_CONTROLS, said)[:3] == error.value.diagnostics


def test_validate_knows_a_mapping_file(tmp_path: Path) -> None:
    mapping_of(tmp_path, MAPPING)
    checked = check_file(tmp_path / "m.yaml", print)
    assert (checked.kind, checked.problems) == ("mapping", ())


def test_the_example_of_the_documentation_reads_what_it_describes(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)
    columns = {
        "stamp": (1.7e9 + TIMES) * 1e3,
        "motor_pwm": 1500 + 500 * WIDE["throttle"],
        "servo_angle": np.rad2deg(WIDE["steering"]),
        "cam_x": WIDE["x"] * 1e3,
        "cam_y": WIDE["y"] * 1e3,
        "cam_rot": np.rad2deg(-WIDE["yaw"]),
        "rc_switch": np.where(TIMES < 4, 1900.0, 1100.0),
    }
    log = read(tmp_path, text, columns)
    (part,) = log.parts
    n = len(part.poses)
    assert part.pose_times[-1] == pytest.approx(4 - 0.025 - TIMES[0], abs=1e-5)
    np.testing.assert_allclose(part.poses[:, :2], np.column_stack([WIDE["x"], WIDE["y"]])[:n], atol=1e-9)
    np.testing.assert_allclose(part.poses[:, 2], np.unwrap(WIDE["yaw"])[:n], atol=1e-9)
    np.testing.assert_allclose(
        part.commands, np.column_stack([WIDE["throttle"], WIDE["steering"]])[: len(part.commands)], atol=1e-9
    )


def test_a_mapping_that_is_not_there_is_said(tmp_path: Path) -> None:
    write_wide(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"m\.yaml"):
        load_mapping(tmp_path / "m.yaml")


def test_a_switch_may_act_on_the_throttle_alone(tmp_path: Path) -> None:
    times = np.arange(0.0, 5.8, 0.05)
    columns = wide_columns(times, drive())
    released = (times > 2.01) & (times < 3.01)
    columns["dead_man"] = 1.0 - released
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    mapping = mapping_of(tmp_path, "dead_man: {column: dead_man, masks: [throttle]}\n")
    (log,) = read_logs(path, mapping=mapping).logs
    (part,) = log.parts
    assert len(part.poses) == len(times)
    held = np.searchsorted(part.command_times, times, side="right") - 1
    np.testing.assert_array_equal(part.commands[held, 0], np.where(released, 0.0, columns["throttle"]))
    np.testing.assert_array_equal(part.commands[held, 1], columns["steering"])
    (found,) = [f for f in log.findings if f.kind == "dead man"]
    assert found.count == released.sum()
    assert len(read_logs(path).logs[0].parts) == 2  # without the mapping file the log does not count meanwhile


def test_pulse_widths_are_masked_only_with_their_neutral_number(tmp_path: Path) -> None:
    columns = {**WIDE, "throttle": 1500.0 + 400.0 * WIDE["throttle"], "dead_man": (TIMES < 3.0).astype(float)}
    switch = "dead_man: {column: dead_man, masks: [throttle]}\n"
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    with pytest.raises(InputError) as error:
        read_logs(path, mapping=mapping_of(tmp_path, switch), any_command_unit=True)
    (problem,) = error.value.diagnostics
    assert (problem.line, problem.path) == (1, "dead_man.masks")
    assert "zero" in problem.expected
    stated = switch + "commands: {controls: {throttle: {column: throttle, zero: 1500}}}\n"
    (part,) = read_logs(path, mapping=mapping_of(tmp_path, stated), any_command_unit=True).logs[0].parts
    assert part.commands[-1, 0] == 0.0


def test_a_switch_between_two_commands_acts_at_its_own_time(tmp_path: Path) -> None:
    made = drive()
    write_table(
        tmp_path / "commands.csv", ["t", "throttle", "steering"], [made.command_times[::20], *made.commands[::20].T]
    )
    poses = [made.pose_times, *made.poses[:, :2].T, wrapped(made.poses[:, 2]), (made.pose_times < 3.47).astype(float)]
    write_table(tmp_path / "poses.csv", ["t", "x", "y", "yaw", "dead_man"], poses)
    mapping = mapping_of(tmp_path, "dead_man: {column: dead_man, masks: [throttle]}\nlimits: {command_gap: 5}\n")
    (part,) = read_logs([tmp_path / "commands.csv", tmp_path / "poses.csv"], mapping=mapping).logs[0].parts
    released = made.pose_times[made.pose_times >= 3.47][0] - made.command_times[0]
    k = int(np.argmin(np.abs(part.command_times - released)))
    assert part.command_times[k] == pytest.approx(released, abs=1e-9)
    assert part.commands[k - 1, 0] > 0.0
    assert (part.commands[k:, 0] == 0.0).all()
    assert part.commands[k, 1] == part.commands[k - 1, 1]


def test_a_switch_that_is_released_after_the_last_command_acts(tmp_path: Path) -> None:
    """Commands are logged when they change."""
    made = drive()
    write_table(tmp_path / "commands.csv", ["t", "throttle", "steering"], [[0.0, 0.5, 1.0], [0.2, 0.5, 0.5], 3 * [0.1]])
    poses = [made.pose_times, *made.poses[:, :2].T, wrapped(made.poses[:, 2]), (made.pose_times < 3.0).astype(float)]
    write_table(tmp_path / "poses.csv", ["t", "x", "y", "yaw", "dead_man"], poses)
    mapping = mapping_of(tmp_path, "dead_man: {column: dead_man, masks: [throttle]}\n")
    (log,) = read_logs([tmp_path / "commands.csv", tmp_path / "poses.csv"], mapping=mapping).logs
    assert log.parts[-1].commands[-1].tolist() == [0.0, 0.1]
    assert [f.count for f in log.findings if f.kind == "dead man"] == [int((made.pose_times >= 3.0).sum())]


@pytest.mark.parametrize(
    ("name", "factor", "text", "said"),
    [
        ("t", 1e2, "", "unit: ms} into a mapping file, or name the column so (t_ms)"),
        ("t", 1e6, "", "unit: us} into a mapping file, or name the column so (t_us)"),
        ("t_s", 1e2, "", "unit: ms} into a mapping file"),
        ("t", 1e2, "poses: {time: {column: t, unit: s}}\n", "expected one every 1e-05 to 2 s"),
    ],
)
def test_poses_that_are_too_rare_are_in_another_unit_unless_it_is_stated(
    tmp_path: Path, name: str, factor: float, text: str, said: str
) -> None:
    columns = {(name if key == "t" else key): factor * values if key == "t" else values for key, values in WIDE.items()}
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    with pytest.raises(InputError) as error:
        read_logs(path, mapping=mapping_of(tmp_path, text) if text else None)
    (problem,) = error.value.diagnostics
    assert problem.expected.replace(", and the same for commands.time", "").endswith(said)


def test_a_mapping_file_that_names_columns_tells_which_files_of_a_folder_have_commands(tmp_path: Path) -> None:
    for number in (1, 2):
        for kind, names in (("left", "abc"), ("right", "adef")):
            columns = [ODD[name] for name in names]
            write_table(tmp_path / "logs" / f"day_{number}_{kind}.csv", list(names), columns)
    found = read_logs(tmp_path / "logs", mapping=mapping_of(tmp_path, MAPPING))
    assert not found.problems
    assert [log.name for log in found.logs] == ["day_1", "day_2"]
    for log in found.logs:
        same_as_wide(log)
