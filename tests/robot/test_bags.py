"""Bags of simulated drives: others decode them, the same seed gives the same bytes, identification finds the same."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from support.paths import ROOT
from support.script import output_of

from kraft.driving.method import load_method
from kraft.logs.reader import read_logs
from kraft.recording.recorder import Recorder, write_recording
from kraft.robot.bag import EPOCH, BagWriter, scene, write_recording_bag, write_trial
from kraft.robot.display import occupancy_grid
from kraft.robot.protocol import DriveSpec, Sense
from kraft.robot.robot_file import Rosbridge, load_robot
from kraft.robot.show import Display
from kraft.scenario import OccupancyMap, load_scenario, parse_scenario
from kraft.sysid import identify
from kraft.trial.result import TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main

TOPICS = {
    "/tf", "/pose", "/odometry/filtered", "/drive", "/map", "/plan", "/contingency", "/footprint", "/markers",
    "/markers/scene", "/truth/odom", "/rosout",
}  # fmt: skip


def short(vehicle: str = "mushr", method: str = "conservative-kraft") -> TrialSpec:
    scenario = load_scenario("boxes", {"trial.timeout": 2.5})
    return TrialSpec(scenario, load_method(method), load_vehicle(vehicle), seed=3)


@pytest.fixture(scope="module")
def driven() -> tuple[TrialSpec, TrialResult]:
    spec = short()
    return spec, run_trial(spec, keep_trees=True)


def decoded(path: Path) -> dict[str, list[Any]]:
    """Messages by topic, as mcap-ros2-support decodes them."""
    found = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found[channel.topic].append(message)
    return found


def seconds(stamp: Any) -> float:
    return (stamp.sec * 10**9 + stamp.nanosec - EPOCH) / 1e9


def test_another_decoder_finds_the_drive_in_the_bag(tmp_path: Path, driven: tuple[TrialSpec, TrialResult]) -> None:
    spec, result = driven
    write_trial(tmp_path / "drive.mcap", spec, result)
    found = decoded(tmp_path / "drive.mcap")
    assert set(found) == TOPICS
    assert len(found["/drive"]) == len(result.steps)
    for message, step in zip(found["/drive"], result.steps, strict=True):
        assert seconds(message.header.stamp) == pytest.approx(step.time, abs=1e-8)
        assert message.drive.speed == np.float32(step.command[0])
        assert message.drive.steering_angle == np.float32(step.command[1])
    for message, observation in zip(found["/pose"], result.observations, strict=True):
        assert seconds(message.header.stamp) == pytest.approx(observation.time, abs=1e-8)
        assert message.pose.position.x == observation.x
        yaw = 2.0 * math.atan2(message.pose.orientation.z, message.pose.orientation.w)
        assert math.remainder(yaw - observation.theta, math.tau) == pytest.approx(0.0, abs=1e-12)
    assert [len(message.poses) for message in found["/plan"]] == [
        len(cycle.reference.times) if cycle.kind == "plan" else 0 for cycle in result.cycles
    ]
    assert {child.child_frame_id for child in found["/tf"][0].transforms} == {"base_link", "truth/base_link"}
    assert any(marker.ns == "tree" and marker.points for message in found["/markers"] for marker in message.markers)
    assert found["/rosout"][-1].msg.startswith(result.outcome.value)


def test_the_example_draws_a_bag_as_the_layout_shows_it(tmp_path: Path, driven: tuple[TrialSpec, TrialResult]) -> None:
    spec, result = driven
    write_trial(tmp_path / "drive.mcap", spec, result)
    output_of(ROOT / "examples" / "draw_bag.py", str(tmp_path / "drive.mcap"), str(tmp_path / "drive.png"), "1.5")
    assert (tmp_path / "drive.png").stat().st_size > 20_000
    layout = json.loads((ROOT / "docs" / "kraft-layout.json").read_text(encoding="utf-8"))
    shown = set(layout["configById"]["3D!kraft"]["topics"]) | {layout["configById"]["RosOut!log"]["topicToRender"]}
    plots = [layout["configById"][f"Plot!{name}"]["paths"] for name in ("commands", "speed")]
    plotted = {path["value"].split(".")[0] for paths in plots for path in paths}
    assert shown | plotted <= set(decoded(tmp_path / "drive.mcap"))


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path: Path) -> None:
    for name in ("a", "b"):
        spec = short()
        write_trial(tmp_path / f"{name}.mcap", spec, run_trial(spec, keep_trees=True))
    other = TrialSpec(spec.scenario, spec.method, spec.vehicle, 4)
    write_trial(tmp_path / "c.mcap", other, run_trial(other, keep_trees=True))
    first, second, third = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert first == second != third


def test_identification_finds_the_same_in_the_bag_as_in_the_folder(tmp_path: Path) -> None:
    scenario, vehicle = load_scenario("training"), load_vehicle("mushr")
    recorder = Recorder(scenario, vehicle, 0)
    for number in (1, 2, 3):
        recording = recorder.record(number)
        write_recording(tmp_path / "logs", scenario, {}, recording)
        write_recording_bag(tmp_path / f"bags/run_0{number}.mcap", scenario.task(), vehicle, recording)
    by_folder, by_bag = (identify(vehicle, read_logs(tmp_path / name).logs) for name in ("logs", "bags"))
    for one, other in zip(by_folder.parameters.values(), by_bag.parameters.values(), strict=True):
        assert other.value == pytest.approx(one.value, abs=1e-3 * one.std)
        assert other.std == pytest.approx(one.std, rel=1e-4)


def test_the_commands_of_any_vehicle_come_back_by_their_names(tmp_path: Path) -> None:
    spec = short("unicycle2", "kraft")
    result = run_trial(spec)
    write_trial(tmp_path / "drive.mcap", spec, result)
    (log,) = read_logs(tmp_path / "drive.mcap", tuple(spec.vehicle.controls)).logs
    (part,) = log.parts
    np.testing.assert_array_equal(part.commands, np.array([step.command for step in result.steps]))


def test_what_is_true_is_never_read_as_a_pose(tmp_path: Path, driven: tuple[TrialSpec, TrialResult]) -> None:
    spec, result = driven
    write_trial(tmp_path / "drive.mcap", spec, result)
    (log,) = read_logs(tmp_path / "drive.mcap").logs
    assert "poses: /pose:" in log.guess
    assert "/truth" not in log.guess


def test_the_map_has_every_obstacle_and_free_floor_beside_it() -> None:
    scenario = parse_scenario(
        """
name: shapes
bounds: {x: [0, 4], y: [-1, 2]}
obstacles:
  - {box: {center: [1, 0], size: [0.6, 0.2], yaw_deg: 30}}
  - {circle: {center: [2, 1], radius: 0.3}}
  - {polygon: {vertices: [[3, 0], [3.6, 0], [3.3, 0.6]]}}
start: {x: 0.4, y: 1.5, heading_deg: 0}
goal: {center: [3.5, 1.5], radius: 0.2}
"""
    )
    grid = occupancy_grid(scenario.task(), EPOCH, "map")
    info = grid.info
    cells = grid.data.reshape(info.height, info.width)

    def occupied(x: float, y: float) -> bool:
        column, row = (int((value - low) / info.resolution) for value, low in ((x, 0.0), (y, -1.0)))
        return bool(cells[row, column] == 100)

    assert all(occupied(*place) for place in ((1, 0), (1.2, 0.12), (2.2, 1.1), (3.3, 0.3), (3.3, 0.55)))
    assert not any(occupied(*place) for place in ((0.4, 1.5), (1, 0.4), (2, 0.5), (3.05, 0.4), (3.9, 0)))


def test_run_and_record_write_bags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    short_trial = ["--set", "trial.timeout=1", "--method", "kraft", "--vehicle", "mushr"]
    assert main(["-q", "run", "boxes", *short_trial, "--bag", "run.mcap", "--json"]) == 1
    assert set(decoded(tmp_path / "run.mcap")) >= {"/drive", "/pose"}
    assert main(["-q", "record", "--runs", "2", "--out", "logs", "--bag", "rec.mcap"]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == ["rec_01.mcap", "rec_02.mcap", "run.mcap"]


@pytest.mark.parametrize("name", ["drive.bag", "missing/../drive", "."])
def test_a_bag_with_another_ending_is_refused_before_the_drive(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "boxes", "--bag", name]) == 2
    assert capsys.readouterr().err.startswith("--bag: ")
    assert list(tmp_path.iterdir()) == []


def test_a_run_in_json_names_no_bag_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "-q",
        "run",
        "boxes",
        "--set",
        "trial.timeout=0.5",
        "--vehicle",
        "mushr",
        "--method",
        "kraft",
        "--json",
    ]
    assert main(arguments) == 1
    assert json.loads(capsys.readouterr().out)["schema"] == "kraft.run/1"


@pytest.mark.parametrize("resolution", [0.011, 0.02, 0.05, 0.06, 0.13])
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_walls_of_one_cell_are_whole_in_the_map_however_fine_theirs_is(resolution: float, yaw: float) -> None:
    task = load_scenario("turns", {"obstacles": []}).task()
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    count = round(1.0 / resolution)
    for column in range(8):
        occupied = np.zeros((count, count), bool)
        occupied[:, column] = True
        walls = OccupancyMap(occupied, resolution, (x0 + 0.5, y0 + 0.3, yaw))
        info = (grid := occupancy_grid(replace(task, obstacles=(walls,)), EPOCH, "map")).info
        cells = grid.data.reshape(info.height, info.width) == 100
        along = np.linspace(0.001, count * resolution - 0.001, 400)
        across = (column + 0.5) * resolution
        x = x0 + 0.5 + math.cos(yaw) * across - math.sin(yaw) * along
        y = y0 + 0.3 + math.sin(yaw) * across + math.cos(yaw) * along
        there = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        rows, columns = ((y - y0) / info.resolution).astype(int), ((x - x0) / info.resolution).astype(int)
        assert there.any()
        assert cells[rows[there], columns[there]].all()
        assert cells.mean() < 0.1


@pytest.mark.parametrize("keeps", [True, False])
def test_of_a_bag_that_ends_early_what_is_written_stays_if_it_shall(tmp_path: Path, keeps: bool) -> None:
    def write() -> None:
        with BagWriter(tmp_path / "x.mcap", keeps=keeps) as bag:
            for time, topic, message in scene(load_scenario("turns").task(), EPOCH, "map"):
                bag.write(topic, time, message)
            raise OSError(28, "the disk is full")

    with pytest.raises(OSError, match="full"):
        write()
    assert [path.name for path in tmp_path.iterdir()] == (["x.mcap"] if keeps else [])
    if keeps:
        with (tmp_path / "x.mcap").open("rb") as stream:
            assert {channel.topic for _, channel, _ in make_reader(stream).iter_messages()} == {
                "/map",
                "/markers/scene",
            }


def test_the_bag_of_a_drive_is_complete_where_nobody_receives_what_is_displayed(
    tmp_path: Path, driven: tuple[TrialSpec, TrialResult], capfd: pytest.CaptureFixture[str]
) -> None:
    """A display that starts late, or whose rosbridge is gone, finds nobody; the bag was cut at the first cycle."""
    spec, result = driven
    robot = load_robot("sim").model_copy(update={"transport": Rosbridge(kind="rosbridge", url="ws://127.0.0.1:9")})
    drive = DriveSpec(spec.scenario.task(), spec.method, spec.vehicle, robot, timeout=60.0)
    ticks = tuple((step.time, np.array(step.command), np.array(step.estimate)) for step in result.steps)
    with Display(drive, tmp_path / "drive.mcap") as display:
        for number, cycle in enumerate(result.cycles):
            display.sensed(Sense(EPOCH, ticks=ticks[number :: len(result.cycles)]))
            display.show(cycle)
    assert display.problem == ""
    found = decoded(tmp_path / "drive.mcap")
    assert len(found["/plan"]) == len(result.cycles)
    assert len(found["/drive"]) == len(ticks)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("kraft display: plans are not shown: transport: nobody answers at ws://127.0.0.1:9")
    assert line.endswith("; the bag is written all the same")


def test_nothing_is_kept_for_a_display_that_has_ended() -> None:
    """A drive goes on without it, maybe for hours, and each cycle has a tree."""
    task, method = load_scenario("turns").task(), load_method("adaptive-kraft")
    display = Display(DriveSpec(task, method, load_vehicle("mushr"), load_robot("sim"), timeout=60.0), None)
    display._theirs.close()  # as when its process ends
    for _ in range(3):
        display.sensed(Sense(EPOCH))
    display._feeder.join(10.0)
    assert not display._feeder.is_alive()
    display.sensed(Sense(EPOCH))
    assert display._waiting.empty()
