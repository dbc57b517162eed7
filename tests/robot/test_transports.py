"""Transports carry every message as it is, and say what they cannot do."""

from __future__ import annotations

import itertools
import json
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.sync.server import serve

from kraft.errors import Code, InputError
from kraft.robot.connect import open_transport
from kraft.robot.loopback import LoopbackBus, Wire
from kraft.robot.messages import (
    ACKERMANN,
    GRID,
    MARKERS,
    ODOMETRY,
    POSE,
    from_cdr,
    from_json,
    header,
    make,
    nanoseconds_of,
    odometry,
    pose_fields,
    stamped_pose,
    to_cdr,
    to_json,
    yaw_of,
)
from kraft.robot.robot_file import Robot, Ros2, Rosbridge
from kraft.robot.ros2 import dds_topic, dds_type, domain_number
from kraft.robot.rosbridge import RosbridgeClient, RosbridgeServer
from kraft.robot.transport import Answers, Outbox, Transport

DOMAINS = itertools.count(100 + threading.get_native_id() % 100)
COMMAND = make(ACKERMANN, header=header(5, "base_link"), drive={"speed": 0.5, "steering_angle": -0.25})


def free_port() -> int:
    with socket.socket() as opened:
        opened.bind(("localhost", 0))
        return int(opened.getsockname()[1])


def robot(transport: dict[str, Any]) -> Robot:
    return Robot.model_validate(
        {"name": "r", "transport": transport, "pose": {"topic": "/pose", "type": POSE}, "command": {"topic": "/drive"}}
    )


def eventually(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(0.01)
    return condition()


@pytest.fixture(params=["loopback", "socket", "rosbridge", "ros1", "ros2"])
def ends(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Transport, Transport]]:
    """The robot's end of a transport, and kraft's."""
    if request.param == "loopback":
        bus = LoopbackBus()
        yield bus.node("robot"), bus.node("kraft")
        return
    if request.param == "socket":
        settings: dict[str, Any] = {"kind": "loopback", "socket": str(tmp_path / "socket")}
    elif request.param == "ros2":
        settings = {"kind": "ros2", "domain": next(DOMAINS) % 230, "interface": "lo"}
    else:
        ros = 1 if request.param == "ros1" else 2
        settings = {"kind": "rosbridge", "url": f"ws://localhost:{free_port()}", "ros": ros}
    described = robot(settings)
    there = open_transport(described, "robot")
    here = open_transport(described)
    yield there, here
    here.close()
    there.close()


def messages() -> dict[str, Any]:
    covered = odometry(10**18 + 7, "map", "base_link", (1.0, -2.0, 3.0), 0.5)
    covered.pose.covariance[:] = np.arange(36)
    marker = {"ns": "tree", "points": [{"x": 1.5}, {"y": -0.1}], "text": "ü", "colors": [{"a": 1.0}]}
    return {
        ACKERMANN: COMMAND,
        ODOMETRY: covered,
        MARKERS: make(MARKERS, markers=[marker]),
        GRID: make(GRID, info={"width": 3, "height": 1, "resolution": 0.05}, data=[0, 100, -1]),
    }


@pytest.mark.parametrize("kind", messages())
def test_a_message_arrives_as_it_was_sent(ends: tuple[Transport, Transport], kind: str) -> None:
    there, here = ends
    message, got = messages()[kind], list[Any]()
    there.subscribe("/topic", kind, lambda received, _: got.append(received))
    here.advertise("/topic", kind)

    def sent() -> bool:
        here.publish("/topic", message)
        return bool(got)

    assert eventually(sent)
    assert to_cdr(got[0]) == to_cdr(message)


def test_latched_messages_reach_those_who_come_late(ends: tuple[Transport, Transport]) -> None:
    there, here = ends
    there.advertise("/map", GRID, latched=True)
    there.publish("/map", messages()[GRID])
    got: list[Any] = []
    here.subscribe("/map", GRID, lambda received, _: got.append(received), latched=True)
    assert eventually(lambda: len(got) == 1)


def test_peers_are_counted_without_oneself(ends: tuple[Transport, Transport]) -> None:
    there, here = ends
    there.advertise("/pose", POSE)
    there.subscribe("/drive", ACKERMANN, lambda *_: None)
    assert eventually(lambda: len(here.peers("/pose").publishers or ()) == 1)
    assert eventually(lambda: len(here.peers("/drive").subscribers or ()) == 1)
    assert not here.peers("/drive").publishers
    assert not here.peers("/nothing").publishers


def test_not_a_number_survives_every_form() -> None:
    message = stamped_pose(5, "map", (math.nan, math.inf, 0.0))
    assert math.isnan(from_cdr(to_cdr(message), POSE).pose.position.x)
    text = json.dumps(to_json(message), allow_nan=False)
    back = from_json(json.loads(text), POSE)
    assert math.isnan(back.pose.position.x)
    assert math.isnan(back.pose.position.y)


def test_an_orientation_that_is_no_rotation_has_no_yaw() -> None:
    assert math.isnan(yaw_of(stamped_pose(0, "map", (0, 0, 0)).pose.orientation.__class__(0.0, 0.0, 0.0, 0.0)))
    turned = stamped_pose(0, "map", (0, 0, -3.0)).pose.orientation
    assert yaw_of(turned) == pytest.approx(-3.0)
    for factor in (0.96, 1.04):
        rounded = turned.__class__(*(factor * getattr(turned, name) for name in "xyzw"))
        assert yaw_of(rounded) == pytest.approx(-3.0)


def test_the_names_in_dds_are_those_of_ros_2() -> None:
    assert dds_type(ACKERMANN) == "ackermann_msgs::msg::dds_::AckermannDriveStamped_"
    assert dds_topic("/drive") == "rt/drive"


def test_the_domain_is_that_of_the_file_or_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert domain_number(Ros2(kind="ros2")) == 42
    assert domain_number(Ros2(kind="ros2", domain=7)) == 7
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(InputError) as error:
        domain_number(Ros2(kind="ros2"))
    assert error.value.diagnostics[0].file == "ROS_DOMAIN_ID"


def test_an_independent_dds_understands_the_messages_both_ways() -> None:
    roswell = pytest.importorskip("roswell")
    domain = next(DOMAINS) % 230
    here = open_transport(robot({"kind": "ros2", "domain": domain}))
    node = roswell.Node("other", domain=domain)
    posed = node.load_type("geometry_msgs/msg/PoseStamped")
    here.advertise("/pose", POSE)
    heard: list[Any] = []
    here.subscribe("/goal", POSE, lambda received, _: heard.append(received))
    subscription, publisher = node.subscribe("/pose", posed), node.publisher("/goal", posed)
    taken: list[tuple[float, str, int]] = []

    def exchanged() -> bool:
        here.publish("/pose", stamped_pose(3 * 10**9 + 5, "map", (1.25, -2.0, 0.5)))
        theirs = publisher.new()
        theirs.header.frame_id, theirs.pose.position.x, theirs.header.stamp.nanosec = "odom", 7.5, 9
        publisher.publish(theirs)
        while (message := subscription.take()) is not None:
            taken.append((message.pose.position.x, message.header.frame_id, message.header.stamp.nanosec))
        return bool(taken and heard)

    assert eventually(exchanged, 30.0)
    assert taken[0] == (1.25, "map", 5)
    assert (heard[0].pose.position.x, heard[0].header.frame_id, nanoseconds_of(heard[0].header.stamp)) == (
        7.5,
        "odom",
        9,
    )
    node.close()
    here.close()


def test_the_client_speaks_as_the_protocol_demands() -> None:
    """ROSBRIDGE_PROTOCOL.md, 3.3 to 3.4: the fields of each operation, and one JSON object a frame."""
    frames: list[dict[str, Any]] = []
    port = free_port()

    def handle(connection: Any) -> None:
        for text in connection:
            frames.append(json.loads(text))
            if frames[-1]["op"] == "subscribe":
                pose = {"header": {"stamp": {"secs": 1, "nsecs": 2}, "frame_id": "map"}, "pose": pose_fields(1, 2, 0)}
                connection.send(json.dumps({"op": "publish", "topic": "/pose", "msg": pose}))

    with serve(handle, "localhost", port) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = RosbridgeClient(Rosbridge(kind="rosbridge", url=f"ws://localhost:{port}", ros=1))
        got: list[Any] = []
        client.advertise("/drive", ACKERMANN)
        client.subscribe("/pose", POSE, lambda message, _: got.append(message))
        assert eventually(lambda: bool(got))
        client.publish("/drive", COMMAND)
        assert eventually(lambda: len(frames) == 3)
        client.close()
        server.shutdown()
    assert nanoseconds_of(got[0].header.stamp) == 1_000_000_002
    advertised, subscribed, published = frames
    assert advertised == {
        "op": "advertise", "topic": "/drive", "type": "ackermann_msgs/AckermannDriveStamped", "latch": False,
    }  # fmt: skip
    assert (subscribed["topic"], subscribed["type"]) == ("/pose", "geometry_msgs/PoseStamped")
    assert set(published) == {"op", "topic", "msg"}
    assert published["msg"]["header"]["stamp"] == {"secs": 0, "nsecs": 5}
    assert set(published["msg"]["drive"]) == {
        "steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk",
    }  # fmt: skip


@pytest.mark.parametrize(
    "frame",
    ["no json", "[]", '{"op": "fly"}', '{"op": "publish", "topic": "/drive", "msg": {}}', '{"op": "advertise"}',
     '{"op": "advertise", "topic": "/a", "type": "nothing/Known"}'],
)  # fmt: skip
def test_the_server_answers_nonsense_with_an_error_and_goes_on(frame: str) -> None:
    server = RosbridgeServer(Rosbridge(kind="rosbridge", url=f"ws://localhost:{free_port()}"))
    with connect(f"ws://localhost:{server.port}") as client:
        client.send(frame)
        answer = json.loads(client.recv(timeout=5))
        assert (answer["op"], answer["level"]) == ("status", "error")
        client.send(
            json.dumps({"op": "call_service", "id": "1", "service": "/rosapi/subscribers", "args": {"topic": "/x"}})
        )
        assert json.loads(client.recv(timeout=5))["values"] == {"subscribers": []}
    server.close()


def test_a_lost_connection_is_reported_and_made_again() -> None:
    settings = Rosbridge(kind="rosbridge", url=f"ws://localhost:{free_port()}")
    server = RosbridgeServer(settings)
    client = RosbridgeClient(settings)
    got: list[Any] = []
    client.subscribe("/pose", POSE, lambda message, _: got.append(message))
    server.close()
    assert eventually(lambda: "is lost" in client.problem)
    server = RosbridgeServer(settings)
    before = client._socket
    assert eventually(lambda: client.problem == "")
    client._lost(object())  # the connection before
    assert client.problem == ""
    assert client._socket is not before

    def heard() -> bool:
        server.publish("/pose", stamped_pose(1, "map", (0, 0, 0)))
        return bool(got)

    assert eventually(heard)
    client.close()
    server.close()


def test_nobody_at_the_address_and_a_taken_port_are_refused() -> None:
    settings = robot({"kind": "rosbridge", "url": f"ws://localhost:{free_port()}"})
    with pytest.raises(InputError) as nobody:
        open_transport(settings)
    assert nobody.value.diagnostics[0].code is Code.NOT_FOUND
    server = open_transport(settings, "robot")
    with pytest.raises(InputError) as taken:
        open_transport(settings, "robot")
    assert taken.value.diagnostics[0].code is Code.EXISTS
    server.close()


def test_a_socket_that_is_lost_nowhere_or_taken_is_reported(tmp_path: Path) -> None:
    described = robot({"kind": "loopback", "socket": str(tmp_path / "socket")})
    with pytest.raises(InputError) as nobody:
        open_transport(described)
    assert nobody.value.diagnostics[0].code is Code.NOT_FOUND
    server, client = open_transport(described, "robot"), open_transport(described)
    with pytest.raises(InputError) as taken:
        open_transport(described, "robot")
    assert taken.value.diagnostics[0].code is Code.EXISTS
    server.advertise("/pose", POSE)
    assert eventually(lambda: client.peers("/pose").publishers == {"robot"})
    server.close()
    assert eventually(lambda: "is lost" in client.problem)
    assert client.peers("/pose").publishers is None
    client.close()


def test_a_client_of_a_socket_that_reads_nothing_holds_up_nobody(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    server = open_transport(robot({"kind": "loopback", "socket": path}), "robot")
    with socket.socket(socket.AF_UNIX) as silent:
        silent.connect(path)
        Wire(silent).send(json.dumps(["subscribe", "/map", GRID, False]).encode())
        cells = make(GRID, info={"width": 1000, "height": 1000}, data=[0] * 1_000_000)
        assert eventually(lambda: bool(server.peers("/map").subscribers))
        began = time.monotonic()
        for _ in range(20):
            server.publish("/map", cells)
        assert time.monotonic() - began < 2.0
    server.close()


def test_a_package_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import sys

    from kraft.errors import MissingDependency

    monkeypatch.setitem(sys.modules, "websockets.sync.client", None)
    with pytest.raises(MissingDependency, match="websockets"):
        open_transport(robot({"kind": "rosbridge", "url": "ws://localhost:1"}))


def test_clients_that_come_and_go_at_once_lose_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that leaves looks at the topics of all, while another one adds some."""
    bus, problems = LoopbackBus(), list[BaseException]()
    monkeypatch.setattr(threading, "excepthook", lambda failed: problems.append(failed.exc_value))
    topics, before = [f"/{k}" for k in range(2000)], sys.getswitchinterval()

    def come() -> None:
        node = bus.node("one")
        for topic in topics:
            node.subscribe(topic, POSE, lambda *_: None)

    def go() -> None:
        while coming.is_alive():
            bus.node("other").close()

    coming, going = threading.Thread(target=come), threading.Thread(target=go)
    sys.setswitchinterval(1e-6)
    try:
        coming.start()
        going.start()
        coming.join()
        going.join()
    finally:
        sys.setswitchinterval(before)
    assert problems == []
    assert [topic for topic in topics if len(bus.receivers[topic]) != 1] == []


def test_what_is_announced_while_a_rosbridge_is_connected_again_does_not_end_its_receiver() -> None:
    """The check list announces the commands, and the connection may have been lost just before."""
    client = RosbridgeClient.__new__(RosbridgeClient)
    client._announced, client._subscriptions, client._lock = {"/a": {"op": "advertise"}}, {}, threading.Lock()
    client._problem, client.connections = "lost", 1

    def announce(_: str) -> None:
        client._announced["/drive"] = {"op": "advertise"}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(client, "_outbox", SimpleNamespace(closed=False, operate=announce), raising=False)
        patch.setattr(client, "_connect", lambda: None)
        client._reconnect()
    assert (client._problem, client.connections) == ("", 2)


def test_an_outbox_that_is_closed_accepts_nothing_more() -> None:
    """Nobody takes from that of a connection that is lost, which a controller asks once a second who publishes."""
    outbox = Outbox[str, int]()
    outbox.put("/a", 1)
    outbox.close()
    outbox.put("/b", 2)
    outbox.operate("peers")
    assert outbox.take() == ([], [("/a", 1)])
    assert outbox.take() is None


def test_an_answer_that_comes_too_late_is_dropped() -> None:
    answers, asked = Answers[str](), list[int]()
    assert answers.ask(asked.append, 0.01) is None
    answers.put(asked[0], "late")
    assert answers.ask(lambda number: answers.put(number, f"answer {number}"), 1.0) == "answer 1"
    assert not answers._expected, "nothing is kept of either"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("kind", ["loopback", "rosbridge", "ros2"])
def test_a_defect_in_what_takes_a_message_is_a_problem_of_the_transport(kind: str, tmp_path: Path) -> None:
    """Without it the poses would only grow old."""
    settings = {
        "loopback": {"kind": kind, "socket": str(tmp_path / "socket")},
        "rosbridge": {"kind": kind, "url": f"ws://localhost:{free_port()}"},
        "ros2": {"kind": kind, "domain": next(DOMAINS), "interface": "lo"},
    }[kind]

    def fail(message: Any, arrival: int) -> None:
        raise ZeroDivisionError("of a subscriber")

    there = open_transport(robot(settings), "robot")
    here = open_transport(robot(settings))
    there.advertise("/pose", POSE)
    here.subscribe("/pose", POSE, fail)

    def noticed() -> bool:
        there.publish("/pose", stamped_pose(1, "map", (0, 0, 0)))
        return "ZeroDivisionError: of a subscriber" in here.problem

    assert eventually(noticed)
    here.advertise("/drive", ACKERMANN)
    here.publish("/drive", COMMAND)
    assert "ZeroDivisionError" in here.problem, "what can be sent does not end it"
    here.close()
    there.close()
