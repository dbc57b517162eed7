"""The problems of all options and files of a command are reported together."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.evaluation import places

from kraft_cli.main import main

COMMANDS = {
    "plan turns --param L=abc --param foo=3": "--param, --param foo",
    "plan turns --param L --set x --planner dirty --iterations 0 --seed -2 --threads 70 --from no.json --plot a.gif":
        "--iterations, --param, --planner, --seed, --set, --threads, a.gif, no.json",
    "plan nosuch --vehicle nope --time 0 --after 1 --out /proc/x": "--after, --time, /proc/x/plan.json, nope, nosuch",
    "sysid nologs --model foo --holdout 2 --param L=nan --graph slow --pose-noise 1 --next 50 --horizon 99 --plot a.gif "
    "--out b.txt --mapping no.yaml":
        "--graph, --holdout, --horizon, --next, --param, --pose-noise, a.gif, b.txt, foo, no.yaml, nologs",
    "sysid nologs --model mushr --next 50 --area 3 --commands /proc/x": "--area, --next, /proc/x, nologs",
    "sysid nologs --model mushr --freeze zz --param L=nan": "--freeze, --param, nologs",
    "sysid nologs --param L=-1": "--param L, nologs",
    "sysid nologs --model mushr --param L=-1 --param q=2": "--param, --param L, nologs",
    "record nosuch --vehicle nope --for zip --commands nofile --runs 3 --bag a.txt --out /proc/x":
        "--bag, --for, --runs, /proc/x, nofile, nope, nosuch, zip",
    "eval nosuch other.yaml --methods kraft,foo --suite nosuite": "--suite, foo, nosuch, nosuite, other.yaml",
    "eval turns --trials 0 --seed -1 --jobs 0 --methods kraftt,foo --out /proc/x":
        "--jobs, --seed, --trials, /proc/x, foo, kraftt",
    "eval nosuch --set x --vary y --trials 1000000000 --methods foo":
        "--set, --trials, --vary, foo, nosuch",
    "eval nosuch --set x --jobs 0 --suite nosuite --methods foo --out /proc/x":
        "--jobs, --set, --suite, /proc/x, foo, nosuch, nosuite",
    "import barn X --goal 5,5,nan --start a,b --out /proc/x": "--goal, --start, /proc/x, X",
    "import map nomap.yaml": "--goal, --start, nomap.yaml",
    "import map nomap.yaml --start a --goal 1,2": "--start, nomap.yaml",
    "import bran X": "X, bran",
    "generate clutter --density 0.9 --count 0 --seed -1 --vehicle nope": "--count, --density, --seed, --vehicle",
    "run nosuch --method foo --vehicle nope --seed -1 --set x --plot a.gif --video a.avi --bag a.txt --out /proc/x":
        "--bag, --seed, --set, /proc/x, a.avi, a.gif, foo, nope, nosuch",
    "drive nosuch --robot norobot --method foo --seed -1 --set x --bag a.txt --out /proc/x":
        "--bag, --seed, --set, /proc/x, foo, norobot, nosuch",
    "world nosuch --robot norobot --vehicle nope --set x": "--set, nope, norobot, nosuch",
    "world nosuch --robot sim --speed 0 --video a.gif": "--speed, a.gif, nosuch",
    "generate rooms --count 10001": "--count",
}  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_the_problems_of_all_options_and_files_are_reported_together(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert sorted(places(err)) == COMMANDS[command].split(", ")
    assert list(folder.iterdir()) == []


SCENE = """name: room
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {box: {center: [2, 2], size: [1, 1]}, circle: {center: [2, 2], radius: wide}}
start: {x: 0.5, y: 0.5, heading_deg: 0}
goal: {center: [3, 3], radius: 0.3}
planning: {iterations: 500, time: 2, edge_duration: [1, 0.5], goal_bias: often}
sensing: {preset: rendered, noise_scale: 2, dropout: 3}
truth: {tilt: {angle: 0.1, angle_deg: 5, uphill_deg: north}}
"""
ROBOT = """name: mine
transport: {kind: loopback}
rate_hz: 15
pose: {topic: /pose, type: geometry_msgs/msg/PoseStamped, rate_hz: 2}
command: {topic: /drive, timeout: 0.1}
limits: {speed: fast}
"""
MAPPING = """commands: {time: t, controls: {throttle: u, steering: {column: s, scale: big}}}
poses: {time: t, x: x, y: y, yaw: {column: a, unit: m}, quaternion: q}
dead_man: {column: held, masks: [throtle]}
limits: {top_speed: -1}
"""
FILES = {
    "room.yaml": (
        SCENE,
        ["4:5: obstacles[0]", "4:76: obstacles[0].circle.radius", "7:35: planning.time",
         "7:53: planning.edge_duration", "7:74: planning.goal_bias", "8:42: sensing.noise_scale",
         "8:54: sensing.dropout", "8:54: sensing.dropout", "9:15: truth.tilt", "9:54: truth.tilt.uphill_deg"],
    ),
    "log.yaml": (
        MAPPING,
        ["1:74: commands.controls.steering.scale", "2:53: poses.yaw.unit", "2:69: poses.quaternion",
         "2:69: poses.quaternion", "3:34: dead_man.masks[0]", "4:21: limits.top_speed"],
    ),
    "robot.yaml": (ROBOT, ["1:1: watchdog.pose_age", "3:10: rate_hz", "6:17: limits.speed"]),
}  # fmt: skip


@pytest.mark.parametrize("file", FILES)
def test_problems_between_keys_are_reported_beside_those_of_the_same_keys(
    file: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, expected = FILES[file]
    (folder / file).write_text(content)
    assert main(["validate", file]) == 2
    *lines, total = capsys.readouterr().err.splitlines()
    assert total == f"{len(expected)} problems in 1 file"
    for place, line in zip(expected, lines, strict=True):
        assert place in line
