"""Robot files: the bundled ones are valid, and what is wrong with one is reported at its place."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.errors import Code, Diagnostic
from kraft.robot.robot_file import TrackedPoint, load_robot
from kraft_cli.main import main
from kraft_cli.work.validate import check_file

GOOD = """name: mine
transport: {kind: ros2, domain: 3}
pose: {topic: /pose, type: geometry_msgs/msg/PoseStamped}
command: {topic: /drive}
"""


def problems_of(folder: Path, text: str) -> tuple[Diagnostic, ...]:
    (folder / "r.yaml").write_text(text, encoding="utf-8")
    return check_file(folder / "r.yaml", print).problems


@pytest.mark.parametrize("name", bundled.names("robot"))
def test_a_bundled_robot_is_valid_and_described_and_names_its_schema(name: str) -> None:
    path = bundled.folder("robot") / f"{name}.yaml"
    assert path.read_text(encoding="utf-8").splitlines()[0] == "# yaml-language-server: $schema=robot.schema.json"
    assert check_file(path, print).kind == "robot"
    robot = load_robot(name)
    assert robot.name == name
    assert robot.description


def test_the_topics_of_the_bundled_cars_are_those_that_their_stacks_use() -> None:
    f1tenth, mushr = load_robot("f1tenth"), load_robot("mushr")
    assert (f1tenth.pose.topic, f1tenth.command.topic) == ("/pf/pose/odom", "/drive")
    assert mushr.pose.topic == "/car/particle_filter/inferred_pose"
    assert mushr.command.topic == "/car/mux/ackermann_cmd_mux/input/navigation"
    assert f1tenth.command.timeout == mushr.command.timeout == 0.2


def test_a_good_file_has_no_problems(tmp_path: Path) -> None:
    assert problems_of(tmp_path, GOOD) == ()


@pytest.mark.parametrize(
    ("old", "new", "key", "line", "code"),
    [
        ("kind: ros2", "kind: zenoh", "transport.kind", 2, Code.VALUE),
        ("domain: 3", "domain: 300", "transport.domain", 2, Code.VALUE),
        ("domain: 3", "url: x", "transport.url", 2, Code.UNKNOWN),
        ("PoseStamped}", "Pose2D}", "pose.type", 3, Code.VALUE),
        ("topic: /pose", "topic: pose", "pose.topic", 3, Code.VALUE),
        ("topic: /pose", "topic: /drive", "command.topic", 4, Code.DUPLICATE),
        ("topic: /pose", "topic: {a: /pose}", "pose.topic", 3, Code.TYPE),
        ("/drive}", "/drive, speed: {scale: 0}}", "command.speed.scale", 4, Code.VALUE),
        ("/drive}", "/drive, speed: {unit: km/h}}", "command.speed.unit", 4, Code.VALUE),
        ("/drive}", "/drive, timeout: -1}", "command.timeout", 4, Code.VALUE),
        ("/drive}", "/drive, type: sensor_msgs/msg/JointState, speed: {scale: -1}}", "command.speed", 4, Code.CONFLICT),
        (
            "/drive}",
            "/drive, type: sensor_msgs/msg/JointState, steering: {offset_deg: 5}}",
            "command.steering",
            4,
            Code.CONFLICT,
        ),
        ("/drive}", "/drive, timeout: 0.1}\nrate_hz: 15", "rate_hz", 5, Code.CONFLICT),
        ("/drive}", "/drive, timeout: 1}\nrate_hz: 8", "rate_hz", 5, Code.VALUE),
        ("/drive}", "/drive}\nwatchdog: {pose_age: 0.05}", "watchdog.pose_age", 5, Code.CONFLICT),
        ("/drive}", "/drive}\ndead_man: {topic: /joy, type: sensor_msgs/msg/Joy}", "dead_man.button", 5, Code.CONFLICT),
        ("/drive}", "/drive}\nlimits: {speed: 0}", "limits.speed", 5, Code.VALUE),
        ("command: {topic: /drive}\n", "", "command", 1, Code.MISSING),
        ("/drive}", "/drive}\ndisplay: kraft", "display", 5, Code.VALUE),
    ],
)
def test_what_is_wrong_is_reported_at_its_place(
    tmp_path: Path, old: str, new: str, key: str, line: int, code: Code
) -> None:
    assert old in GOOD
    (problem,) = problems_of(tmp_path, GOOD.replace(old, new))
    assert (problem.path, problem.line, problem.code) == (key, line, code)


def test_every_problem_of_a_file_is_reported_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("/pose,", "pose,").replace("domain: 3", "domain: x").replace("/drive}", "/drive, timout: 1}")
    assert [problem.line for problem in problems_of(tmp_path, text)] == [2, 3, 4]


def test_the_pose_of_the_body_follows_from_that_of_the_rear_axle() -> None:
    point = TrackedPoint(x=-0.165, y=0.02, heading_deg=90.0)
    pose = 1.0, 2.0, 0.3
    assert point.body_pose(*point.tracked_pose(*pose)) == pytest.approx(pose)
    assert TrackedPoint(x=-0.2).body_pose(1.0, 2.0, math.pi / 2) == pytest.approx((1.0, 2.2, math.pi / 2))


def test_robots_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "robots"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == ["f1tenth", "mushr", "sim"]
