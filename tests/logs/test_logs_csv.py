"""CSV logs: columns are guessed from names, units and shapes, whatever tool wrote the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.logs import (
    drive,
    located,
    problems_of,
    read_one,
    same_drive,
    wide_columns,
    wrapped,
    write_pair,
    write_table,
    write_wide,
)

from kraft.errors import InputError
from kraft.logs.mapping import Mapping
from kraft.logs.matching import missing_columns
from kraft.logs.names import axis_score, control_score, parse, time_score, yaw_score
from kraft.logs.reader import read_logs
from kraft.logs.table import Table, read_csv
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.run_folder import step_heading

MADE = drive()
WIDE = wide_columns(np.arange(0.025, 5.9, 0.025), MADE)


def test_a_wide_table_becomes_commands_and_continuous_poses(tmp_path: Path) -> None:
    log = read_one(write_wide(tmp_path / "a.csv"))
    (part,) = log.parts
    assert (log.name, log.controls) == ("a", ("throttle", "steering"))
    np.testing.assert_allclose(part.poses[:, 2], np.unwrap(WIDE["yaw"]), atol=1e-12)
    np.testing.assert_allclose(part.commands[:, 1], WIDE["steering"])
    assert part.pose_times[0] == part.command_times[0] == 0.0
    assert log.duration == pytest.approx(WIDE["t"][-1] - WIDE["t"][0])
    assert log.guess == (
        "commands: time from 't' (s), throttle from 'throttle', steering from 'steering' (rad); "
        "poses: time from 't' (s), x from 'x' (m), y from 'y' (m), yaw from 'yaw' (rad)"
    )


def test_the_source_has_the_hash_of_the_bytes(tmp_path: Path) -> None:
    path = write_wide(tmp_path / "a.csv")
    first = read_one(path).sources
    path.write_text(path.read_text() + "\n")
    second = read_one(path).sources
    assert first[0].file == second[0].file == str(path)
    assert first[0].sha256 != second[0].sha256
    assert len(first[0].sha256) == 64


@pytest.mark.parametrize("folder", ["pair", "."])
def test_a_pair_of_files_is_one_log_with_two_clocks(tmp_path: Path, folder: str) -> None:
    write_pair(tmp_path / folder, MADE)
    log = read_one(tmp_path)
    same_drive(log, MADE)
    assert [Path(source.file).name for source in log.sources] == ["commands.csv", "poses.csv"]
    assert "poses: poses.csv: time from 't' (s)" in log.guess


def test_truth_is_never_opened(tmp_path: Path) -> None:
    write_pair(tmp_path, MADE)
    (tmp_path / "truth.csv").write_bytes(b"\0")
    (tmp_path / "manifest.json").write_text("{}")
    same_drive(read_one(tmp_path), MADE)
    (tmp_path / "truth.csv").chmod(0)
    same_drive(read_one(tmp_path), MADE)


def test_pairs_in_one_folder_belong_together_by_their_names(tmp_path: Path) -> None:
    second = drive(turn=-0.5)
    write_pair(tmp_path, MADE, "run1_commands.csv", "run1_poses.csv")
    write_pair(tmp_path, second, "run2_cmd.csv", "run2_odom.csv")
    first, other = read_logs(tmp_path).logs
    assert [first.name, other.name] == ["run1", "run2"]
    same_drive(first, MADE)
    same_drive(other, second)


def test_a_pair_may_be_given_as_two_files(tmp_path: Path) -> None:
    write_pair(tmp_path, MADE)
    (log,) = read_logs([tmp_path / "commands.csv", tmp_path / "poses.csv"]).logs
    same_drive(log, MADE)


def test_a_run_folder_gives_what_was_seen_and_not_what_is_true(tmp_path: Path) -> None:
    heading = step_heading(load_vehicle("mushr"))
    assert {"time", "x", "command_throttle", "command_steering"} <= set(heading)
    columns = dict.fromkeys(heading, np.full(len(MADE.command_times), 77.0))
    columns |= {
        "time": MADE.command_times,
        "command_throttle": MADE.commands[:, 0],
        "command_steering": MADE.commands[:, 1],
    }
    write_table(tmp_path / "run" / "steps.csv", heading, list(columns.values()))
    seen = [MADE.pose_times, MADE.pose_times + 0.08, MADE.poses[:, 0], MADE.poses[:, 1], wrapped(MADE.poses[:, 2])]
    write_table(tmp_path / "run" / "observations.csv", ["time", "arrival", "x", "y", "theta"], seen)
    (tmp_path / "run" / "result.json").write_text("{}")
    log = read_one(tmp_path)
    assert log.name == "run"
    same_drive(log, MADE)


def test_commands_of_the_brake_guard_are_among_those_of_a_run(tmp_path: Path) -> None:
    commands = np.column_stack([MADE.command_times, MADE.commands])
    by_guard = np.zeros(len(commands), bool)
    by_guard[[3, 7, 8, -1]] = True
    heading = ["time", "command_throttle", "command_steering"]
    write_table(tmp_path / "run" / "steps.csv", heading, list(commands[~by_guard].T))
    write_table(tmp_path / "run" / "guard.csv", heading, list(commands[by_guard].T))
    seen = [MADE.pose_times, MADE.pose_times, MADE.poses[:, 0], MADE.poses[:, 1], wrapped(MADE.poses[:, 2])]
    write_table(tmp_path / "run" / "observations.csv", ["time", "arrival", "x", "y", "theta"], seen)
    same_drive(read_one(tmp_path), MADE)
    (tmp_path / "run" / "guard.csv").write_text(",".join(heading) + "\n")  # of a drive that was killed
    assert len(read_one(tmp_path).parts[0].commands) == len(commands) - 4
    write_table(tmp_path / "run" / "guard.csv", heading[:2], list(commands[by_guard, :2].T))
    with pytest.raises(InputError, match=r"guard\.csv: has other columns than steps\.csv"):
        read_logs(tmp_path)


RENAMED = [
    {"t": "timestamp", "throttle": "cmd_speed", "steering": "cmd_steer", "yaw": "theta"},
    {"t": "time [s]", "throttle": "u_throttle", "steering": "u_steering", "x": "pos_x", "y": "pos_y", "yaw": "heading"},
    {"t": "Time", "x": "pose.pose.position.x", "y": "pose.pose.position.y", "yaw": "pose.yaw"},
    {"throttle": "speed", "steering": "delta", "x": "px", "y": "py", "yaw": "psi"},
    {"throttle": "drive.speed", "steering": "drive.steering_angle", "x": "x_m", "y": "y_m", "yaw": "yaw_rad"},
    {"throttle": "commandedSpeed", "steering": "commandedSteeringAngle", "x": "poseX", "y": "poseY", "yaw": "poseYaw"},
    {"throttle": "Throttle", "steering": "Steering", "x": "X (m)", "y": "Y (m)", "yaw": "Yaw (rad)"},
]


@pytest.mark.parametrize("names", RENAMED, ids=lambda names: next(iter(names.values())))
def test_columns_are_recognised_under_the_names_that_people_give_them(tmp_path: Path, names: dict[str, str]) -> None:
    path = write_table(tmp_path / "a.csv", [names.get(name, name) for name in WIDE], list(WIDE.values()))
    (part,) = read_one(path).parts
    np.testing.assert_allclose(part.poses[:, :2], np.column_stack([WIDE["x"], WIDE["y"]]))
    np.testing.assert_allclose(part.commands, np.column_stack([WIDE["throttle"], WIDE["steering"]]))


def test_a_measured_speed_is_not_taken_for_the_command(tmp_path: Path) -> None:
    columns = {**WIDE, "v": WIDE["x"], "odom_speed": WIDE["x"], "cmd_speed": WIDE["throttle"]}
    del columns["throttle"]
    log = read_one(write_table(tmp_path / "a.csv", list(columns), list(columns.values())))
    assert "throttle from 'cmd_speed'" in log.guess


def test_estimates_and_targets_are_not_taken_for_the_measured_pose(tmp_path: Path) -> None:
    others = {f"{word}_{name}": WIDE["t"] + 5 for word in ("estimate", "goal", "desired") for name in ("x", "y", "yaw")}
    columns = {**others, **WIDE}
    log = read_one(write_table(tmp_path / "a.csv", list(columns), list(columns.values())))
    assert "x from 'x' (m), y from 'y' (m), yaw from 'yaw' (rad)" in log.guess


@pytest.mark.parametrize(
    ("name", "old", "factor", "said"),
    [
        ("yaw_deg", "yaw", 180 / np.pi, "yaw from 'yaw_deg' (deg, converted)"),
        ("heading [deg]", "yaw", 180 / np.pi, "yaw from 'heading [deg]' (deg, converted)"),
        ("steering_deg", "steering", 180 / np.pi, "steering from 'steering_deg' (deg, converted)"),
        ("t_ms", "t", 1e3, "time from 't_ms' (ms, converted)"),
        ("stamp_ns", "t", 1e9, "time from 'stamp_ns' (ns, converted)"),
        ("x_mm", "x", 1e3, "x from 'x_mm' (mm, converted)"),
        ("utm_easting", "x", 1.0, "x from 'utm_easting' (m)"),
        ("northing [mm]", "y", 1e3, "y from 'northing [mm]' (mm, converted)"),
    ],
)
def test_a_unit_in_the_name_is_converted(tmp_path: Path, name: str, old: str, factor: float, said: str) -> None:
    path = write_table(
        tmp_path / "a.csv",
        [name if n == old else n for n in WIDE],
        [v * factor if n == old else v for n, v in WIDE.items()],
    )
    log = read_one(path)
    (part,) = log.parts
    assert said in log.guess
    np.testing.assert_allclose(part.poses[:, 0], WIDE["x"], atol=1e-12)
    np.testing.assert_allclose(part.poses[:, 2], np.unwrap(WIDE["yaw"]), atol=1e-9)
    np.testing.assert_allclose(part.commands[:, 1], WIDE["steering"], atol=1e-12)
    np.testing.assert_allclose(part.pose_times, WIDE["t"] - WIDE["t"][0], atol=1e-9)


@pytest.mark.parametrize(("unit", "factor"), [("ns", 1e9), ("us", 1e6), ("ms", 1e3), ("s", 1.0)])
def test_stamps_since_1970_are_told_by_their_size(tmp_path: Path, unit: str, factor: float) -> None:
    log = read_one(write_wide(tmp_path / "a.csv", {"t": (1.7e9 + WIDE["t"]) * factor}))
    assert f"time from 't' ({unit}" in log.guess
    np.testing.assert_allclose(log.parts[0].pose_times, WIDE["t"] - WIDE["t"][0], atol=5e-7)


def test_an_orientation_in_four_columns_becomes_a_yaw(tmp_path: Path) -> None:
    half = WIDE["yaw"] / 2
    columns = {k: v for k, v in WIDE.items() if k != "yaw"}
    columns |= {
        "orientation.x": half * 0,
        "orientation.y": half * 0,
        "orientation.z": np.sin(half),
        "orientation.w": np.cos(half),
    }
    log = read_one(write_table(tmp_path / "a.csv", list(columns), list(columns.values())))
    np.testing.assert_allclose(log.parts[0].poses[:, 2], np.unwrap(WIDE["yaw"]), atol=1e-9)
    assert "yaw from 'orientation' (quaternion, converted)" in log.guess


def test_empty_cells_are_rows_of_the_other_stream(tmp_path: Path) -> None:
    commands, poses = len(MADE.command_times), len(MADE.pose_times)
    stack = [np.concatenate([MADE.command_times, MADE.pose_times])]
    stack += [np.concatenate([MADE.commands[:, k], np.full(poses, np.nan)]) for k in range(2)]
    stack += [np.concatenate([np.full(commands, np.nan), MADE.poses[:, k]]) for k in range(3)]
    order = np.argsort(stack[0])
    log = read_one(
        write_table(tmp_path / "a.csv", ["t", "throttle", "steering", "x", "y", "yaw"], [c[order] for c in stack])
    )
    same_drive(log, MADE)
    assert log.findings == ()


def test_a_wide_table_may_have_a_clock_for_each_stream(tmp_path: Path) -> None:
    columns = {"cmd_time": WIDE["t"], "pose_time": WIDE["t"] + 0.004, **{k: v for k, v in WIDE.items() if k != "t"}}
    log = read_one(write_table(tmp_path / "a.csv", list(columns), list(columns.values())))
    (part,) = log.parts
    assert part.command_times[0] == 0.0
    assert part.pose_times[0] == pytest.approx(0.004)


@settings(max_examples=40)
@given(
    separator=st.sampled_from([",", ";", "\t", " "]),
    comment=st.sampled_from(["", "# made by a tool\n", "# made by a tool\n\n# t is in s\n"]),
    marked=st.booleans(),
    bom=st.booleans(),
    newline=st.sampled_from(["\n", "\r\n"]),
    comma=st.booleans(),
    quoted=st.booleans(),
    trailing=st.booleans(),
)
def test_any_way_of_writing_a_table_reads_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    separator: str,
    comment: str,
    marked: bool,
    bom: bool,
    newline: str,
    comma: bool,
    quoted: bool,
    trailing: bool,
) -> None:
    names = [f'"{name}"' for name in WIDE] if quoted else list(WIDE)
    lines = [("# " if marked else "") + separator.join(names)]
    for row in zip(*WIDE.values(), strict=True):
        cells = [repr(float(value)) for value in row]
        cells = [cell.replace(".", ",") for cell in cells] if comma and separator != "," else cells
        lines.append(separator.join(cells) + (separator if trailing and separator != " " else ""))
    text = comment + "\n".join(lines) + "\n"
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_bytes((b"\xef\xbb\xbf" if bom else b"") + text.replace("\n", newline).encode())
    table = read_csv(path, path.read_bytes())
    assert list(table.columns) == list(WIDE)
    for name, values in WIDE.items():
        np.testing.assert_array_equal(table.columns[name], values)
    first = next(i for i, line in enumerate(text.split("\n"), 1) if line[:1].isdigit())
    assert table.rows[0] == first


@given(st.text(max_size=30))
def test_no_name_of_a_column_breaks_the_guess(name: str) -> None:
    parse(name)
    for score in (time_score(name, {"cmd"}), axis_score(name, "x"), yaw_score(name), control_score(name, "throttle")):
        assert score is None or isinstance(score, int)


@settings(max_examples=60)
@given(st.binary(max_size=400) | st.text(alphabet="txy, \n\"';#0.5e-nan", max_size=200).map(str.encode))
def test_no_content_breaks_the_reader(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_logs(path)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", ["a.csv syntax"]),
        ("0,1,2\n1,2,3\n", ["a.csv:1 syntax"]),
        ("t,x,y,yaw,throttle,steering\n", ["a.csv data"]),
        ("PK\0\0", ["a.csv syntax"]),
        ("t,cmd_speed,cmd_stear,x,y,yaw\n1,2,3,4,5,6\n", ["a.csv missing"]),
        ("t,throttle,steerng,x,y\n1,2,3,4,5\n", ["a.csv missing", "a.csv missing"]),
        ("t,left_throttle,right_throttle,steering,x,y,yaw\n1,2,3,4,5,6,7\n", ["a.csv conflict"]),
        ("t,throttle,steering,x,y,yaw\n1,.5,.1,1,1,1\n", ["a.csv:2 data"]),
        ("t,throttle,steering,x,y,yaw\n1,.5,.1,a,1,1\n2,.5,.1,b,1,1\n", ["a.csv:2 data"]),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_table_is_said_at_its_place(tmp_path: Path, content: str, expected: list[str]) -> None:
    (tmp_path / "a.csv").write_text(content)
    assert problems_of(tmp_path / "a.csv") == expected


def test_tables_that_ros_tools_export_are_read(tmp_path: Path) -> None:
    """`rostopic echo -p` writes stamps in ns, other tools in two columns; both write text columns too."""
    stamp = 1_700_000_000 + MADE.pose_times
    half = MADE.poses[:, 2] / 2
    position, orientation = "field.pose.pose.position", "field.pose.pose.orientation"
    heading = [
        "%time",
        "field.header.frame_id",
        *(f"{position}.{a}" for a in "xyz"),
        *(f"{orientation}.{a}" for a in "xyzw"),
    ]
    columns = [
        stamp * 1e9,
        stamp * np.nan,
        *MADE.poses[:, :2].T,
        half * 0,
        half * 0,
        half * 0,
        np.sin(half),
        np.cos(half),
    ]
    path = write_table(tmp_path / "odom.csv", heading, columns)
    path.write_text("\n".join(line.replace(",,", ",map,", 1) for line in path.read_text().splitlines()) + "\n")
    times = 1_700_000_000 + MADE.command_times
    heading = ["header.stamp.secs", "header.stamp.nsecs", "drive.speed", "drive.steering_angle"]
    write_table(tmp_path / "drive.csv", heading, [times // 1, times % 1 * 1e9, *MADE.commands.T])
    log = read_one(tmp_path)
    np.testing.assert_allclose(log.parts[0].poses, MADE.poses, atol=1e-9)
    np.testing.assert_allclose(log.parts[0].command_times, MADE.command_times, atol=1e-6)
    assert "time from 'time' (ns, converted, by their size)" in log.guess
    assert "time from 'header.stamp.secs' (s)" in log.guess


@pytest.mark.parametrize(
    ("seconds", "rest"),
    [("secs", "nsecs"), ("sec", "nanosec"), ("stamp_secs", "stamp_nsecs"), ("pose.sec", "pose.nanosec")],
)
def test_the_nanoseconds_of_a_split_stamp_are_added_to_its_seconds(tmp_path: Path, seconds: str, rest: str) -> None:
    times = 1_700_000_000.5 + WIDE["t"]
    columns = {seconds: times // 1, rest: times % 1 * 1e9, **{name: WIDE[name] for name in WIDE if name != "t"}}
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    named = Mapping.model_validate({"commands": {"time": seconds}, "poses": {"time": seconds}})
    for mapping in (Mapping(), named):
        (log,) = read_logs(path, mapping=mapping).logs
        np.testing.assert_allclose(log.parts[0].pose_times, WIDE["t"] - WIDE["t"][0], atol=1e-6)


def test_a_second_clock_in_nanoseconds_is_not_the_rest_of_the_first(tmp_path: Path) -> None:
    columns = {"stamp_sec": WIDE["t"], "stamp_nanosec": WIDE["t"] * 1e9, **WIDE}
    columns.pop("t")
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    assert problems_of(path) == ["a.csv conflict"]


def test_a_control_of_another_vehicle_is_looked_for_by_its_name(tmp_path: Path) -> None:
    columns = {
        **{k: v for k, v in WIDE.items() if k not in ("throttle", "steering")},
        "cmd_acceleration": WIDE["throttle"],
        "cmd_angular_acceleration": WIDE["steering"],
    }
    path = write_table(tmp_path / "a.csv", list(columns), list(columns.values()))
    log = read_one(path, controls=("acceleration", "angular_acceleration"))
    np.testing.assert_allclose(log.parts[0].commands, np.column_stack([WIDE["throttle"], WIDE["steering"]]))
    assert problems_of(path) == ["a.csv missing"]


def test_the_message_about_missing_columns_names_them_and_the_nearest() -> None:
    table = Table("a.csv", "", dict.fromkeys(("t", "cmd_speed", "cmd_stear"), np.zeros(0)), np.zeros(0, np.int64))
    assert str(missing_columns(table, ["steering", "yaw"])) == (
        "a.csv: no column is recognised as steering or as yaw; there are t, cmd_speed, cmd_stear; "
        "did you mean 'cmd_stear' for steering? a mapping file can name the column"
    )


@pytest.mark.parametrize("repeated", [1, 30], ids=["open quote", "field too long"])
def test_a_stray_quote_is_said_at_its_line_and_the_other_logs_are_read(tmp_path: Path, repeated: int) -> None:
    write_wide(tmp_path / "good.csv")
    heading, *rows = write_wide(tmp_path / "quote.csv").read_text().splitlines()
    rows[5] = f'"{rows[5]}'
    (tmp_path / "quote.csv").write_text("\n".join([heading, *rows, *rows[6:] * repeated]) + "\n")
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["good"]
    assert located(found.problems, tmp_path) == ["quote.csv:7 syntax"]


def test_a_heading_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x" + "x" * 140_000 + "\n1,2\n")
    assert problems_of(tmp_path / "a.csv") == ["a.csv:1 syntax"]


def test_a_quoted_text_of_two_lines_is_one_field(tmp_path: Path) -> None:
    heading, *rows = write_wide(tmp_path / "a.csv").read_text().splitlines()
    rows = [f'{row},"ok, 5"' for row in rows]
    for row in (3, -1):
        rows[row] = rows[row].replace("ok, 5", 'two\nlines of ""text""')
    (tmp_path / "a.csv").write_text("\n".join([f"{heading},note", *rows]) + "\n")
    assert len(read_one(tmp_path / "a.csv").parts[0].poses) == len(WIDE["t"])


@pytest.mark.parametrize("row", [100, -1])
@pytest.mark.parametrize("stamp", [1e12, 1e18])
def test_a_damaged_stamp_costs_its_row_alone(tmp_path: Path, row: int, stamp: float) -> None:
    times = np.arange(0.025, 5.9, 0.025)
    times[row] = stamp
    log = read_one(write_wide(tmp_path / "a.csv", {"t": times}))
    assert sum(len(part.poses) for part in log.parts) == len(times) - 1
    assert max(part.pose_times[-1] for part in log.parts) < 6.0


def test_a_comment_with_as_many_fields_as_the_heading_is_a_comment(tmp_path: Path) -> None:
    path = write_wide(tmp_path / "a.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:50], "# lap 2, run 3, ok, a, b, c", *lines[50:]]) + "\n")
    assert {finding.kind for finding in read_one(path).findings} <= {"wrap"}


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_two_columns_of_one_name_are_a_question_unless_their_numbers_are_the_same(tmp_path: Path, shift: float) -> None:
    columns = [MADE.pose_times, *MADE.poses.T, MADE.poses[:, 0] + shift]
    write_pair(tmp_path / "run", MADE)
    write_table(tmp_path / "run" / "poses.csv", ["t", "x", "y", "yaw", "x"], columns)
    if shift:
        assert problems_of(tmp_path / "run") == ["run/poses.csv conflict"]
    else:
        same_drive(read_one(tmp_path / "run"), MADE)
