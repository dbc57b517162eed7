"""`kraft drive` and the simulated robot as two processes, over rosbridge and over DDS."""

from __future__ import annotations

import fcntl
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import connect

from benchmarks.rig import ROBOT, Rig
from kraft.driving.method import load_method
from kraft.errors import Defect, InputError
from kraft.logs.reader import read_logs
from kraft.robot.connect import open_transport
from kraft.robot.drive import DriveResult
from kraft.robot.messages import ACKERMANN, GRID, POSE, header, make, pose_fields, stamped_pose
from kraft.robot.protocol import Checked, DriveSpec, Ended
from kraft.robot.robot_file import load_robot
from kraft.robot.show import KINDS
from kraft.scenario import load_scenario
from kraft.trial.result import Outcome
from kraft.vehicles.load import load_vehicle
from kraft_cli.main import main
from kraft_cli.work import drive as work

DOMAINS = itertools.count(10 + threading.get_native_id() % 80)


@pytest.mark.parametrize("transport", ["rosbridge", "ros2"])
def test_the_car_reaches_the_goal_and_everything_is_written(tmp_path: Path, transport: str) -> None:
    settings = f"{{kind: ros2, domain: {next(DOMAINS)}, interface: lo}}" if transport == "ros2" else ""
    bag = tmp_path / "drive.mcap"
    near = {"goal.center": [1.7, 1.6], "trial.timeout": 150.0}
    with Rig(tmp_path, transport=settings, arguments=("--bag", str(bag)), settings=near, speed=0.5) as rig:
        assert rig.until(lambda: rig.process.poll() is not None, 100.0)
        out, errors = rig.process.communicate()
        driven = json.loads(out)
        assert rig.process.returncode == 0, errors
        assert rig.until(lambda: rig.result is not None, 10.0)
        assert rig.result is not None
        assert rig.result.outcome is Outcome.SUCCESS
    assert driven["outcome"] == "success"
    compared = next(check for check in driven["checks"] if check["name"] == "scenario")
    assert (compared["state"], compared["detail"]) == ("ok", "the robot simulates boxes"), "it is announced"
    assert driven["t_s"] == pytest.approx(rig.result.time, abs=1.5)
    reasons = [event for event in rig.events if event != "success" and not event.startswith("the commitment of cycle")]
    assert driven["watchdog_stops"] <= len(reasons), "the stop at the end is none of the watchdog"
    folder = tmp_path / "out"
    assert {path.name for path in folder.iterdir()} - {"guard.csv"} == {  # which is there if the controller was held up
        "manifest.json", "steps.csv", "observations.csv", "events.csv", "cycles.jsonl", "result.json",
    }  # fmt: skip
    (log,) = read_logs(folder).logs
    assert log.duration > 0.8 * driven["t_s"]
    (by_bag,) = read_logs(bag).logs
    sent, logged = by_bag.parts[0].commands[:100], log.parts[0].commands[:110]
    if (folder / "guard.csv").exists():  # the commands of controller and guard may be logged in another order
        assert np.isclose(sent[:, None], logged[None], rtol=0.0, atol=1e-6).all(axis=2).any(axis=1).all()
    else:
        np.testing.assert_allclose(sent, logged[:100], atol=1e-6)
    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = {channel.topic for _, channel, _, _ in reader.iter_decoded_messages()}
    assert {"/plan", "/contingency", "/markers", "/map", "/pose", "/drive", "/tf", "/odometry/filtered"} <= topics


def test_what_a_killed_controller_did_not_report_is_not_said_to_be_nothing() -> None:
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr")
    spec = DriveSpec(task, load_method("adaptive-kraft"), vehicle, load_robot("sim"), timeout=60.0)
    killed = Ended("stopped", "the controller's process ended with -9", 3.0)
    driven = work.Driven(work.DriveRequest("boxes", "sim"), spec, DriveResult(Checked((), None), killed))
    rows = dict(work.drive_table(driven))
    assert rows["controller"] == "ended without a report of its ticks and of the watchdog's stops"
    assert "watchdog" not in rows


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_to_all_processes_stops_the_car_and_writes_the_result(
    tmp_path: Path, number: signal.Signals
) -> None:
    """A service manager sends it to the guard too, which has a session of its own."""
    bag = tmp_path / "drive.mcap"
    with Rig(tmp_path, arguments=("--bag", str(bag))) as rig:
        rig.drive_until(2.0)
        for pid in (rig.pid("control"), rig.pid("guard"), rig.pid("display"), rig.process.pid):
            os.kill(pid, number)
        assert rig.stands(6.0)
        out, _ = rig.process.communicate(timeout=30)
        assert rig.process.returncode == 128 + number
        assert json.loads(out)["outcome"] == "interrupted"
        assert json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))["outcome"] == "interrupted"
    with bag.open("rb") as file:
        assert make_reader(file).get_summary() is not None, "the bag is complete"


def test_the_second_interrupt_ends_at_once_and_writes_what_is_known(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drive_until(1.5)
        for _ in range(2):
            os.kill(rig.process.pid, signal.SIGINT)
            rig.until(lambda: False, 0.05)
        assert rig.until(lambda: rig.process.poll() is not None, 5.0)
        assert rig.process.returncode == 130
        assert rig.stands(6.0)
        _, errors = rig.process.communicate()
        assert f"written to {tmp_path / 'out'}" in errors.splitlines()[-1]
        assert "a second signal" in rig.events[-1]
        result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
        assert (result["outcome"], result["reason"][:15]) == ("interrupted", "a second signal")
        assert result["cycles"] >= 1
        assert {check["state"] for check in result["checks"]} <= {"ok", "warning"}


def test_an_interrupt_of_the_check_list_ends_it_at_once(tmp_path: Path) -> None:
    """Poses that never come are waited for 15 s."""
    described = ROBOT.format(transport=f"{{kind: loopback, socket: {tmp_path / 'socket'}}}", more="", give_up=2.0)
    (tmp_path / "robot.yaml").write_text(described, encoding="utf-8")
    server = open_transport(load_robot(tmp_path / "robot.yaml"), "robot")
    command = [sys.executable, "-m", "kraft_cli", "drive", "boxes", "--robot", str(tmp_path / "robot.yaml"), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        until = time.monotonic() + 60.0
        while not server.peers("/pf/pose/odom").subscribers and time.monotonic() < until:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        out, _ = process.communicate(timeout=30.0)
    server.close()
    assert time.monotonic() - began < 12.0, "it has not waited to the end, but the machine may be busy"
    assert process.returncode == 130
    driven = json.loads(out)
    assert (driven["outcome"], driven["reason"], driven["cycles"]) == ("interrupted", "by a signal", 0)


EARLY = """
import os, signal, sys
from kraft.robot import drive
from kraft_cli.main import main

started = drive.process_context().Process.start

def start(process):
    started(process)
    if process.name == "kraft controller":
        os.kill(os.getpid(), signal.SIGINT)

drive.process_context().Process.start = start
sys.exit(main(sys.argv[1:]))
"""


def test_an_interrupt_while_the_processes_start_ends_all_of_them(tmp_path: Path) -> None:
    described = ROBOT.format(transport=f"{{kind: loopback, socket: {tmp_path / 'socket'}}}", more="", give_up=2.0)
    (tmp_path / "robot.yaml").write_text(described, encoding="utf-8")
    server = open_transport(load_robot(tmp_path / "robot.yaml"), "robot")
    command = [sys.executable, "-c", EARLY, "drive", "boxes", "--robot", str(tmp_path / "robot.yaml"), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, timeout=60.0)  # of all of them
    server.close()
    assert done.returncode == 130
    assert json.loads(done.stdout)["reason"] == "by a signal"


def test_a_drive_whose_terminal_is_gone_stops_and_writes_its_result(tmp_path: Path) -> None:
    """Its end sends SIGHUP, and all that is written into it from then on fails."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "kraft_cli", "run", "boxes", "--realtime", "--out", str(tmp_path / "out")]

    def take_terminal() -> None:
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        command,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
        preexec_fn=take_terminal,  # noqa: PLW1509 - it takes no lock
    )
    os.close(theirs)
    said = b""
    while b"  2.00 s" not in said:
        said += os.read(ours, 4096)
    os.close(ours)
    assert process.wait(30.0) in (2, 128 + signal.SIGHUP)  # the table cannot be printed
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["outcome"] == "interrupted"


WIDE = """name: wide
description: A room in which there is a way round anything

bounds: {x: [-1.5, 3.5], y: [-1.0, 6.0]}
start: {x: 1.0, y: -0.5, heading_deg: 90, speed: 0}
goal: {center: [1.0, 5.0], radius: 0.25}
vehicle: mushr
sensing: {preset: single-tag, camera: [1, 3, 5], rate_hz: 30}
trial: {timeout: 150}
"""


def test_goal_map_and_other_publishers_change_while_the_car_drives(tmp_path: Path) -> None:
    more, scenario = "goal: {topic: /goal}\nmap: {topic: /map}", tmp_path / "wide.yaml"
    scenario.write_text(WIDE, encoding="utf-8")
    with Rig(tmp_path, str(scenario), more=more, give_up=30.0, speed=0.5) as rig:
        shown: dict[str, list[Any]] = {name: [] for name in KINDS}
        for name, kind in KINDS.items():
            rig.link.subscribe(f"/kraft/{name}", kind, lambda message, _, name=name: shown[name].append(message))
        rig.link.advertise("/goal", POSE)

        def newest_plan() -> list[tuple[float, float]]:
            plans = [message.poses for message in shown["plan"] if message.poses]
            return [(each.pose.position.x, each.pose.position.y) for each in plans[-1]] if plans else []

        rig.drive_until(0.5)
        goal = (0.2, 3.2)
        rig.link.publish("/goal", stamped_pose(time.time_ns(), "map", (*goal, 0.0)))
        assert rig.until(lambda: bool(newest_plan()) and math.dist(newest_plan()[-1], goal) < 0.35, 60.0), (
            newest_plan()[-1:]
        )

        car = rig.world.world.pose[:2]
        x, y = next(place for place in newest_plan() if math.dist(place, car) > 1.5)
        info = {"resolution": 0.1, "width": 2, "height": 2, "origin": pose_fields(x - 0.1, y - 0.1, 0.0)}
        rig.link.publish("/map", make(GRID, header=header(1, "map"), info=info, data=[100] * 4))

        def avoids(path: list[tuple[float, float]]) -> bool:
            return bool(path) and path[-1][1] > y and min(max(abs(a - x), abs(b - y)) for a, b in path) > 0.1

        known = len(shown["plan"])
        assert rig.until(lambda: len(shown["plan"]) > known + 1 and avoids(newest_plan()), 60.0)

        with connect(rig.url) as intruder:
            intruder.send(json.dumps({"op": "advertise", "topic": "/drive", "type": ACKERMANN}))
            assert rig.until(lambda: any("somebody else publishes" in event for event in rig.events), 10.0)
            assert rig.stands(5.0)
        out, errors = rig.process.communicate(timeout=120)
        assert rig.world.world.collision is None
        assert json.loads(out)["outcome"] == "success", errors
        assert math.dist(rig.world.world.pose[:2], goal) < 0.4
    assert {marker.ns for message in shown["markers"] for marker in message.markers} == {"state", "tree"}
    assert len(shown["footprint"][-1].polygon.points) == 4
    assert any(message.poses for message in shown["contingency"])


def test_the_car_stands_while_its_newest_map_cannot_be_used(tmp_path: Path) -> None:
    with Rig(tmp_path, more="map: {topic: /map}", give_up=30.0) as rig:
        rig.drive_until(1.0)
        info = {"resolution": 0.1, "width": 2, "height": 2, "origin": pose_fields(-1.4, -0.9, 0.0)}
        rig.link.publish("/map", make(GRID, header=header(1, "odom"), info=info, data=[0] * 4))
        assert rig.stands(6.0)
        assert rig.until(lambda: any("it is in the frame 'odom', expected 'map'" in event for event in rig.events), 1.0)
        rig.link.publish("/map", make(GRID, header=header(1, "map"), info=info, data=[0] * 4))
        assert rig.until(lambda: abs(rig.world.world.speed) > 0.15, 20.0)


def test_the_line_of_a_cycle_names_the_two_parameters_that_were_learned_most() -> None:
    before = {"a": 1.0, "b": 2.0, "c": 0.0, "d": 4.0}
    assert work.learned_text([1.05, 2.0, 0.004, 4.1], before) == ""
    assert work.learned_text([1.2, 2.0, 0.004, 4.1], before) == "  learned a 1.2"
    assert work.learned_text([1.2, 3.0, 0.02, 8.0], before) == "  learned d 8, b 3, 2 other parameters"


def test_a_robot_that_is_elsewhere_is_not_moved(tmp_path: Path) -> None:
    with Rig(tmp_path, arguments=("--set", "start.x=0.1", "--set", "start.y=3.5")) as rig:
        out, errors = rig.process.communicate(timeout=120)
        assert rig.process.returncode == 1
        assert json.loads(out)["outcome"] == "refused"
        assert "start" in errors
        assert rig.world.world.time == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "nothing"], "nothing"),
        (["--robot", "sim", "--method", "kraft"], "--method"),
        (["--robot", "sim", "--vehicle", "unicycle2"], "command.type"),
        (["--robot", "sim", "--bag", "x.bag"], "--bag"),
        (["--robot", "sim", "--seed", "-1"], "--seed"),
    ],
)
def test_what_does_not_fit_together_is_refused_before_anything_moves(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["drive", "boxes", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("robot", "speed"), [("sim", "0"), ("sim", "nan"), ("f1tenth", "0.5")])
def test_a_speed_that_the_other_program_cannot_know_is_refused(
    robot: str, speed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["world", "boxes", "--robot", robot, "--speed", speed]) == 2
    assert "--speed" in capsys.readouterr().err


def test_the_transport_within_a_process_serves_no_two_processes_which_is_known_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(*_: object, **__: object) -> None:
        raise AssertionError("compiled before the transport was checked")

    monkeypatch.setattr("kraft_cli.work.drive.ensure_all_compiled", compiled)
    (tmp_path / "r.yaml").write_text(
        "name: r\ntransport: {kind: loopback}\npose: {topic: /p, type: nav_msgs/msg/Odometry}\ncommand: {topic: /d}\n",
        encoding="utf-8",
    )
    assert main(["drive", "boxes", "--robot", str(tmp_path / "r.yaml")]) == 2
    assert "transport.kind" in capsys.readouterr().err


def test_an_interface_that_the_machine_lacks_is_refused_and_another_one_is_not_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = ROBOT.format(transport="{kind: ros2, interface: nonsense0}", give_up=4.0, more="")
    (tmp_path / "r.yaml").write_text(text, encoding="utf-8")
    assert main(["drive", "boxes", "--robot", str(tmp_path / "r.yaml")]) == 2
    err = capsys.readouterr().err
    assert "r.yaml:2:" in err
    assert "transport.interface" in err


def test_doctor_says_that_nobody_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.yaml").write_text(
        'name: r\ntransport: {kind: rosbridge, url: "ws://localhost:9"}\n'
        "pose: {topic: /p, type: nav_msgs/msg/Odometry}\ncommand: {topic: /d}\n",
        encoding="utf-8",
    )
    assert main(["doctor", "--robot", str(tmp_path / "r.yaml"), "--json"]) == 3
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert {"r: transport": "missing"}.items() <= {f["subject"]: f["state"] for f in findings}.items()


def test_run_on_the_wall_clock_is_a_drive_with_the_robot_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    near = ["--set", "goal.center=[1.7,1.6]", "--set", "trial.timeout=100"]
    assert main(["run", "boxes", "--realtime", "--out", str(out), "--json", *near]) == 0
    printed = capsys.readouterr()
    assert re.search(r"^ +[1-9]\.00 s .* plan +pose \d+ ms old", printed.err, re.MULTILINE)
    content = json.loads(printed.out)
    assert (content["schema"], content["outcome"], content["realtime"]) == ("kraft.run/1", "success", True)
    assert content["min_clearance_m"] > 0.0
    assert content["controller"]["ticks"] > 20
    assert {"steps.csv", "result.json", "manifest.json"} <= {path.name for path in out.iterdir()}
    (log,) = read_logs(out).logs
    assert log.duration == pytest.approx(content["t_ex_s"], abs=6.0)


def test_a_drive_on_the_wall_clock_is_filmed(tmp_path: Path) -> None:
    """In the simulated robot's process, which could draw nothing if the one that it is forked from had drawn."""
    film = tmp_path / "film.webp"
    near = ("--set", "goal.center=[1.7,0.8]", "--set", "trial.timeout=10")
    command = [sys.executable, "-m", "kraft_cli", "run", "boxes", "--realtime", "--video", str(film), *near]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=False)
    assert done.returncode in (0, 1), done.stderr  # other tests may take the whole computer
    assert "drawing the film of " in done.stderr
    (true,) = [line for line in done.stdout.splitlines() if line.startswith("in truth")]
    assert true.endswith(", in the simulated world; the result is by the robot's estimate")
    assert film.stat().st_size > 10_000


def test_run_on_the_wall_clock_refuses_what_has_no_contingency_and_what_draws_a_trial(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "turns", "--realtime", "--method", "kraft"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("--method: is kraft, ")
    assert "adaptive-kraft" in err
    assert main(["run", "turns", "--realtime", "--plot", str(tmp_path / "a.png")]) == 2
    assert "--plot: draws a trial" in capsys.readouterr().err
    assert main(["run", "nowhere", "--realtime", "--method", "adaptive-kraft"]) == 2
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.parametrize("command", [("drive", "boxes", "--robot", "sim"), ("run", "boxes", "--realtime")])
def test_the_problems_of_all_options_are_told_at_once(
    command: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = ("--method", "kraft", "--vehicle", "nothing", "--seed", "-1", "--out", str(tmp_path), "--bag", "drive.txt")
    assert main([*command, *wrong]) == 2
    told = capsys.readouterr().err
    for problem in ("--method: is kraft", "no vehicle 'nothing'", "--seed: is -1", "is there already", "--bag: is"):
        assert problem in told


def test_nobody_at_the_address_is_one_line_and_leaves_neither_folder_nor_bag(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "robot.yaml"
    robot.write_text(ROBOT.format(transport='{kind: rosbridge, url: "ws://localhost:1"}', more="", give_up=2.0))
    arguments = ["--robot", str(robot), "--out", str(tmp_path / "out"), "--bag", str(tmp_path / "drive.mcap"), "-q"]
    assert main(["drive", "boxes", *arguments]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("transport: nobody answers at ws://localhost:1")
    assert list(tmp_path.iterdir()) == [robot]


def test_the_bag_of_an_earlier_drive_is_not_replaced(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "drive.mcap"
    bag.write_bytes(b"an earlier drive")
    assert main(["drive", "boxes", "--robot", "sim", "--bag", str(bag), "-q"]) == 2
    assert capfd.readouterr().err == f"{bag}: is there already; expected a new file for the bag\n"
    assert bag.read_bytes() == b"an earlier drive"


def test_an_interrupt_before_the_drive_begins_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same command can be repeated."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(work, "drive", interrupted)
    assert main(["drive", "boxes", "--robot", "sim", "--out", str(tmp_path / "out"), "-q"]) == 130
    assert list(tmp_path.iterdir()) == []


class Nothing:
    """A display that shows nothing."""

    draws_trees, problem = False, ""

    def __init__(self, *_: object) -> None:
        return None

    def __enter__(self) -> Nothing:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def sensed(self, sense: object) -> None:
        return None

    show = sensed


@pytest.mark.parametrize(
    ("error", "begun", "kept"),
    [
        (Defect("a plan fails verification"), True, True),
        (InputError.of("transport", "is gone", "expected it"), True, True),
        (InputError.of("transport", "is not there", "expected it"), False, False),
    ],
)
def test_what_is_driven_is_never_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, begun: bool, kept: bool
) -> None:
    def driven(spec: Any, *_: Any, **__: Any) -> None:
        if begun:
            (spec.folder / "cycles.jsonl").write_text("{}\n")
        raise error

    for name, replacement in (("drive", driven), ("Display", Nothing), ("ensure_all_compiled", lambda *_, **__: None)):
        monkeypatch.setattr(work, name, replacement)
    request = work.DriveRequest("turns", "sim", out=tmp_path / "out")
    with pytest.raises(type(error), match=str(error)):
        work.drive_robot(request, print, print, print)
    assert (tmp_path / "out" / "manifest.json").exists() == (tmp_path / "out").exists() == kept


def test_a_run_on_the_wall_clock_says_what_it_waits_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextmanager
    def opened(*_: object) -> Iterator[None]:
        assert "starting the simulated robot" in capsys.readouterr().err
        yield None

    def driven(*_: object) -> None:
        assert "the simulated robot is there" in capsys.readouterr().err
        raise InputError.of("here", "ends the test", "expected nothing more")

    monkeypatch.setattr("kraft_cli.work.realtime._world", opened)
    monkeypatch.setattr("kraft_cli.work.realtime.drive_robot", driven)
    assert main(["run", "turns", "--realtime"]) == 2
    assert "here: ends the test" in capsys.readouterr().err
