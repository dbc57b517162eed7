"""What identifies a true robot: the content of its file and of the files that this refers to."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from kraft.trial.robot_content import robot_content
from kraft.vehicles.true_robot import RobotTruth

ROBOT = """<mujoco>
  <compiler meshdir="parts"/>
  <include file="assets.xml"/>
  <worldbody><body name="base"><freejoint/><geom type="mesh" mesh="hull"/></body></worldbody>
</mujoco>
"""
ASSETS = """<mujoco><asset>
  <mesh name="hull" file="hull.obj"/>
  <texture name="paint" type="2d" file="paint.png"/>
</asset></mujoco>
"""
HULL = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def robot(tmp_path: Path) -> RobotTruth:
    (tmp_path / "parts").mkdir()
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "assets.xml").write_text(ASSETS)
    (tmp_path / "parts/hull.obj").write_text(HULL)
    return RobotTruth(mjcf=str(tmp_path / "robot.xml"))


def test_files_that_a_mujoco_model_refers_to_are_part_of_it(robot: RobotTruth, tmp_path: Path) -> None:
    seen = [robot_content(robot)]
    assert seen[0]["mjcf"]["files"].keys() == {"assets.xml", "parts/hull.obj"}
    for file in ("robot.xml", "assets.xml", "parts/hull.obj"):
        (tmp_path / file).write_text((tmp_path / file).read_text() + "\n")
        seen.append(robot_content(robot))
    (tmp_path / "paint.png").write_bytes(b"")
    seen.append(robot_content(robot))
    assert len({str(each) for each in seen}) == 5
    assert robot_content(robot) == seen[-1]


def test_the_folders_of_such_files_are_those_of_mujoco(robot: RobotTruth, tmp_path: Path) -> None:
    (tmp_path / "assets.xml").write_text('<mujoco><asset><mesh name="hull" file="hull.obj"/></asset></mujoco>')
    assert mujoco.MjModel.from_xml_path(robot.mjcf).body_mass[1] == pytest.approx(1000.0 / 6.0)
    assert robot_content(robot)["mjcf"]["files"].keys() == {"assets.xml", "parts/hull.obj"}


def test_a_model_without_such_files_is_stated_by_its_own_content_alone(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    content = robot_content(RobotTruth(mjcf=str(tmp_path / "robot.xml")))
    assert content["mjcf"].keys() == {"file", "sha256"}
    (tmp_path / "robot.xml").write_text("no XML")
    assert robot_content(RobotTruth(mjcf=str(tmp_path / "robot.xml")))["mjcf"].keys() == {"file", "sha256"}
