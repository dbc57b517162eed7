"""ROS bags of every kind are read without ROS, by the clock and the topics that a person would choose."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.logs import Bag, Drive, drive, located, nanoseconds, write_bag

from kraft.errors import Code, InputError
from kraft.logs.log import Log
from kraft.logs.mapping import load_mapping
from kraft.logs.reader import read_logs

MADE = drive()
NAMES = {"bag": "drive.bag", "sqlite": "drive", "mcap": "drive"}


def read_one(path: Path) -> Log:
    found = read_logs(path)
    assert not found.problems
    (log,) = found.logs
    return log


def same_drive(log: Log, made: Drive = MADE, atol: float = 1e-8) -> None:
    (part,) = log.parts
    np.testing.assert_allclose(part.poses, made.poses, atol=1e-12)
    np.testing.assert_allclose(part.pose_times - part.pose_times[0], made.pose_times - made.pose_times[0], atol=atol)
    np.testing.assert_allclose(
        part.pose_times[0] - part.command_times[0], made.pose_times[0] - made.command_times[0], atol=atol
    )
    np.testing.assert_allclose(part.commands, made.commands, atol=1e-7)  # float32 in the message


def add_commands(bag: Bag) -> None:
    for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
        bag.ackermann("/drive", nanoseconds(time), speed, steering)


def refused(path: Path) -> tuple[list[str], str]:
    """Place, topic and code of each problem, and the whole message."""
    with pytest.raises(InputError) as error:
        read_logs(path)
    return located(error.value.diagnostics, path.parent), str(error.value)


@pytest.mark.parametrize("kind", ["bag", "sqlite", "mcap"])
@pytest.mark.parametrize(("poses", "commands"), [("odometry", "ackermann"), ("pose", "twist")])
def test_a_bag_gives_the_drive_to_the_nanosecond(tmp_path: Path, kind: str, poses: str, commands: str) -> None:
    log = read_one(write_bag(tmp_path / NAMES[kind], kind, MADE, poses, commands))
    same_drive(log, atol=2e-9)
    assert log.name == "drive"
    assert ("/drive: time from 'header.stamp'" in log.guess) == (commands == "ackermann")
    assert ("a turning rate by convention" in log.guess) == (commands == "twist")
    assert "(quaternion, converted)" in log.guess


@pytest.mark.parametrize(("kind", "suffix"), [("sqlite", ".db3"), ("mcap", ".mcap")])
def test_the_file_of_a_bag_is_enough(tmp_path: Path, kind: str, suffix: str) -> None:
    folder = write_bag(tmp_path / "drive", kind, MADE)
    shutil.copy(folder / f"drive{suffix}", tmp_path / f"bare{suffix}")
    log = read_one(tmp_path / f"bare{suffix}")
    same_drive(log)
    assert [Path(source.file).name for source in log.sources] == [f"bare{suffix}"]


def test_a_bag_without_message_definitions_is_read(tmp_path: Path) -> None:
    """As ROS 2 wrote them until Humble."""
    path = write_bag(tmp_path / "drive", "sqlite", MADE) / "drive.db3"
    with closing(sqlite3.connect(path)) as database, database:
        assert database.execute("SELECT count(*) FROM message_definitions").fetchone()[0] > 0
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    metadata = tmp_path / "drive" / "metadata.yaml"
    metadata.write_text(re.sub(r"type_description_hash:\s*\S+", "type_description_hash: ''", metadata.read_text()))
    same_drive(read_one(tmp_path / "drive"))


def test_a_bag_that_lost_messages_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", "sqlite", MADE) / "drive.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DELETE FROM messages WHERE id > 250")
    problems, message = refused(tmp_path / "drive")
    assert problems == ["drive unreadable"]
    assert "130 of 180 messages on /odom" in message


def test_every_file_of_a_bag_is_hashed(tmp_path: Path) -> None:
    log = read_one(write_bag(tmp_path / "drive", "mcap", MADE))
    assert [Path(source.file).name for source in log.sources] == ["drive.mcap", "metadata.yaml"]


def test_joints_are_read_by_their_names_in_any_order(tmp_path: Path) -> None:
    with Bag(tmp_path / "a.bag", "bag") as bag:
        for k, (time, (speed, steering)) in enumerate(zip(MADE.command_times, MADE.commands, strict=True)):
            given = {"throttle": speed, "steering": steering, "lamp": 1.0}
            names = ("throttle", "steering") if k < 5 else tuple(given)[:: 1 if k % 2 else -1]
            bag.joints("/joints", nanoseconds(time), {name: given[name] for name in names})
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose)
    log = read_one(tmp_path / "a.bag")
    assert log.controls == ("throttle", "steering")
    same_drive(log)


def test_the_time_of_the_sender_counts_and_not_that_of_the_recorder(tmp_path: Path) -> None:
    jitter = np.random.default_rng(0).integers(0, 30_000_000, len(MADE.pose_times))
    with Bag(tmp_path / "a.bag", "bag") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time), speed, steering)
        for time, pose, late in zip(MADE.pose_times, MADE.poses, jitter, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose, lag=int(late))
    same_drive(read_one(tmp_path / "a.bag"))


def test_stamps_of_another_clock_are_not_compared_with_the_recorder_s(tmp_path: Path) -> None:
    with Bag(tmp_path / "a.bag", "bag") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.twist("/cmd_vel", nanoseconds(time), speed, steering)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):  # the tracker's clock began with it
            bag.odometry("/odom", round(time * 1e9), *pose, lag=nanoseconds(0))
    log = read_one(tmp_path / "a.bag")
    same_drive(log)
    assert "poses: /odom: time from 'log_time' (s, the stamps in the headers are up to 1.7e+09 s off)" in log.guess


def latched(path: Path, age: float) -> Path:
    """A bag whose messages arrive late by a varying time, with a pose that was published ``age`` s before."""
    jitter = np.random.default_rng(0).integers(0, 30_000_000, len(MADE.pose_times))
    with Bag(path, "bag") as bag:
        lag = round(age * 1e9)
        bag.stamped_pose("/initialpose", nanoseconds(0.0) - lag, 0.0, 0.0, 0.0, lag=lag)
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time), speed, steering)
        for time, pose, late in zip(MADE.pose_times, MADE.poses, jitter, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose, lag=int(late))
    return path


def test_a_topic_that_is_not_used_does_not_decide_on_the_clock(tmp_path: Path) -> None:
    log = read_one(latched(tmp_path / "a.bag", age=3600.0))
    same_drive(log)
    assert log.guess.endswith("; not used: /initialpose")
    assert "log_time" not in log.guess


def test_a_clock_that_the_mapping_names_is_kept(tmp_path: Path) -> None:
    with Bag(tmp_path / "a.bag", "bag") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time) - 40_000_000_000, speed, steering, lag=40_000_000_000)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose)
    same_drive(read_one(tmp_path / "a.bag"))
    (tmp_path / "m.yaml").write_text("commands: {time: header.stamp}\n")
    with pytest.raises(InputError) as error:
        read_logs(tmp_path / "a.bag", mapping=load_mapping(tmp_path / "m.yaml"))
    assert located(error.value.diagnostics, tmp_path) == ["a.bag /odom data"]  # commands and poses do not overlap


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_topic_with_messages_of_two_types_is_named(tmp_path: Path, kind: str) -> None:
    with Bag(tmp_path / NAMES[kind], kind) as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time), speed, steering)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            (bag.odometry if time < 3 else bag.stamped_pose)("/pose", nanoseconds(time), *pose)
    problems, message = refused(tmp_path / NAMES[kind])
    assert problems == [f"{NAMES[kind]} /pose conflict"]
    assert "geometry_msgs/msg/PoseStamped, nav_msgs/msg/Odometry" in message


def test_the_folder_of_a_bag_and_its_file_are_one_log(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "drive", "mcap", MADE)
    found = read_logs([folder / "drive.mcap", folder, tmp_path])
    assert [log.name for log in found.logs] == ["drive"]
    (problem,) = found.problems
    assert problem.code == Code.DUPLICATE
    assert "1 other log" in problem.problem


def test_two_switches_are_a_question(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "mcap") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time), speed, steering)
            bag.boolean("/deadman", nanoseconds(time), True)
            bag.boolean("/enabled", nanoseconds(time), True)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose)
    problems, message = refused(tmp_path / "a")
    assert problems == ["a conflict"]
    assert "/deadman and /enabled" in message


def test_a_tracker_is_preferred_to_odometry_and_the_mux_output_to_its_inputs(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "mcap") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/mux/input/teleop", nanoseconds(time), 0.0, 0.0)
            bag.ackermann("/mux/output", nanoseconds(time), speed, steering)
        for time, (x, y, yaw) in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/vesc/odom", nanoseconds(time), x * 2, y * 2, yaw)
            bag.stamped_pose("/mocap/car", nanoseconds(time), x, y, yaw)
            bag.stamped_pose("/move_base/goal", nanoseconds(time), 0.0, 0.0, 0.0)
    log = read_one(tmp_path / "a")
    same_drive(log)
    assert log.guess.endswith("; not used: /mux/input/teleop, /vesc/odom, /move_base/goal")


def test_goals_are_poses_only_if_the_mapping_names_them(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "mcap") as bag:
        add_commands(bag)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.stamped_pose("/move_base_simple/goal", nanoseconds(time), *pose)
    problems, message = refused(tmp_path / "a")
    assert problems == ["a missing"]
    assert "has no poses but those of /move_base_simple/goal" in message
    (tmp_path / "m.yaml").write_text("poses: {table: /move_base_simple/goal}\n")
    (log,) = read_logs(tmp_path / "a", mapping=load_mapping(tmp_path / "m.yaml")).logs
    same_drive(log)


def test_two_equal_topics_are_a_question(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "mcap") as bag:
        add_commands(bag)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/car1/odom", nanoseconds(time), *pose)
            bag.odometry("/car2/odom", nanoseconds(time), *pose)
    problems, message = refused(tmp_path / "a")
    assert problems == ["a conflict"]
    assert "/car1/odom and /car2/odom" in message
    (tmp_path / "m.yaml").write_text("poses: {table: /car2/odom}\n")
    (log,) = read_logs(tmp_path / "a", mapping=load_mapping(tmp_path / "m.yaml")).logs
    assert "poses: /car2/odom:" in log.guess


def test_a_dead_man_topic_is_honoured(tmp_path: Path) -> None:
    with Bag(tmp_path / "a", "sqlite") as bag:
        for time, (speed, steering) in zip(MADE.command_times, MADE.commands, strict=True):
            bag.ackermann("/drive", nanoseconds(time), speed, steering)
            bag.boolean("/deadman", nanoseconds(time), 2 <= time < 4)
        for time, pose in zip(MADE.pose_times, MADE.poses, strict=True):
            bag.odometry("/odom", nanoseconds(time), *pose)
    (part,) = read_one(tmp_path / "a").parts
    assert 2.0 <= part.pose_times[0] < 2.04
    assert 3.9 < part.pose_times[-1] < 4.0


def test_a_bag_without_the_topics_says_which_there_are(tmp_path: Path) -> None:
    with Bag(tmp_path / "a.bag", "bag") as bag:
        bag.boolean("/light", nanoseconds(0.0), True)
    problems, message = refused(tmp_path / "a.bag")
    assert problems == ["a.bag /light missing"] * 2  # commands and poses
    assert "log_time, data" in message


def _cut(content: bytes) -> bytes:
    return content[: len(content) * 2 // 3]


def _garbled(content: bytes) -> bytes:
    noise = np.random.default_rng(5).integers(0, 256, len(content) // 2, dtype=np.uint8).tobytes()
    return content[: len(content) // 4] + noise + content[len(content) // 4 + len(noise) :]


@pytest.mark.parametrize("damage", [_cut, _garbled, lambda _: b""], ids=["cut", "garbled", "empty"])
@pytest.mark.parametrize(
    ("kind", "tool"), [("bag", "rosbag reindex"), ("mcap", "mcap recover"), ("db3", "ros2 bag reindex")]
)
def test_a_damaged_bag_is_refused_with_the_tool_that_may_save_it(
    tmp_path: Path, kind: str, tool: str, damage: Callable[[bytes], bytes]
) -> None:
    (tmp_path / "whole").mkdir()
    written = {"bag": "bag", "mcap": "mcap", "db3": "sqlite"}[kind]
    made = write_bag(tmp_path / "whole" / ("drive.bag" if kind == "bag" else "drive"), written, MADE)
    source = made if kind == "bag" else made / f"drive.{kind}"
    path = tmp_path / f"bad.{kind}"
    path.write_bytes(damage(source.read_bytes()))
    problems, message = refused(path)
    assert problems == [f"{path.name} unreadable"]
    assert tool in message


def test_one_truncated_bag_is_left_out(tmp_path: Path) -> None:
    write_bag(tmp_path / "good.bag", "bag", MADE)
    content = (tmp_path / "good.bag").read_bytes()
    (tmp_path / "bad.bag").write_bytes(content[: len(content) // 2])
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["good"]
    (problem,) = found.problems
    assert problem.file == str(tmp_path / "bad.bag")
