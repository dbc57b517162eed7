"""The rosbridge protocol (v2): JSON over a websocket, as client, and as the server of the simulated robot.

https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
"""

from __future__ import annotations

import json
import socket
import threading
import time
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import urlparse

from kraft.errors import Code, InputError, MissingDependency
from kraft.provenance import install_command
from kraft.robot.messages import from_json, is_known, to_json
from kraft.robot.robot_file import Rosbridge
from kraft.robot.transport import SEND_BUFFER, Answers, Outbox, Peers, Receive, Receiver, Refused

CONNECT_TIME: Final = 5.0
"""Time to wait for a connection, s."""
ANSWER_TIME: Final = 1.0
"""Time to wait for the answer of a service, s."""
RETRY_TIME: Final = 0.5
"""Time between two attempts to connect again, s."""
REQUEST: Final = "kraft"
"""Beginning of the name of a request, before its number."""
MESSAGE_MAX: Final = 256 * 2**20
"""Largest message, bytes: maps are long."""


def check_library() -> None:
    """Check that websockets is there.

    Raises:
        MissingDependency: if it is not.
    """
    _websockets()


def _websockets() -> Any:
    try:
        import websockets.sync.client
        import websockets.sync.server
    except ImportError as error:
        problem = f"transport: rosbridge needs websockets: {install_command('rosbridge')}"
        raise MissingDependency(problem) from error
    return websockets


@dataclass
class _Subscription:
    kind: str
    receive: Receive
    refused: Refused | None = None


class RosbridgeClient:
    """Transport through a rosbridge server.  It connects again after a loss, and says so until then."""

    def __init__(self, settings: Rosbridge) -> None:
        """Connect.

        Raises:
            MissingDependency: if websockets is missing.
            InputError: if nobody answers at the address.
        """
        self._settings, self._library = settings, _websockets()
        self._subscriptions: dict[str, _Subscription] = {}
        self._announced: dict[str, dict[str, Any]] = {}
        self._answers = Answers[dict[str, Any]]()
        self._outbox = Outbox[str, dict[str, Any]]()
        self._lock = threading.Lock()
        self._problem, self.connections = "", 1
        try:
            self._socket = self._connect()
        except OSError as error:
            problem = f"nobody answers at {settings.url} ({error})"
            raise InputError.of(
                "transport", problem, "expected a rosbridge server, or kraft world, there", Code.NOT_FOUND
            ) from error
        self._receiver = Receiver(self._receive, "rosbridge receiver")
        self._sender = threading.Thread(target=self._send, name="rosbridge sender", daemon=True)
        self._sender.start()

    @property
    def problem(self) -> str:
        """Why nothing travels now; empty while messages do."""
        return self._receiver.defect or self._problem

    def _connect(self) -> Any:
        try:
            opened = self._library.sync.client.connect(
                self._settings.url, open_timeout=CONNECT_TIME, max_size=MESSAGE_MAX, compression=None, close_timeout=1.0
            ).__enter__()  # it stays open until `close`
        except (self._library.exceptions.WebSocketException, ValueError) as error:  # ValueError for a port that is none
            raise OSError(str(error)) from error
        opened.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        return opened

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages."""
        self._announced[topic] = {"op": "advertise", "topic": topic, "type": self._type(kind), "latch": latched}
        self._outbox.operate(json.dumps(self._announced[topic]))

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to the sender, which drops an older one of the topic that still waits."""
        content = {"op": "publish", "topic": topic, "msg": message}
        self._outbox.put(topic, content)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive the messages of a topic; the server replays latched ones."""
        self._subscriptions[topic] = _Subscription(kind, receive, refused)
        self._outbox.operate(json.dumps(self._subscription(topic)))

    def peers(self, topic: str) -> Peers:
        """Nodes that publish and subscribe, as rosapi knows them; rosbridge itself is one of them."""
        return Peers(
            self._names("/rosapi/publishers", topic, "publishers"),
            self._names("/rosapi/subscribers", topic, "subscribers"),
        )

    def _names(self, service: str, topic: str, key: str) -> frozenset[str] | None:
        request = {"op": "call_service", "service": service, "args": {"topic": topic}}
        answer = self._answers.ask(
            lambda number: self._outbox.operate(json.dumps({**request, "id": f"{REQUEST}{number}"})), ANSWER_TIME
        )
        values = answer.get("values") if answer is not None and answer.get("result") is not False else None
        names = values.get(key, ()) if isinstance(values, dict) else None
        return frozenset(map(str, names)) if isinstance(names, (list, tuple)) else None

    def close(self) -> None:
        """Send what waits and disconnect."""
        self._outbox.close()
        self._sender.join(timeout=1.0)
        self._socket.close()

    def _type(self, kind: str) -> str:
        return kind.replace("/msg/", "/") if self._settings.ros == 1 else kind

    def _subscription(self, topic: str) -> dict[str, Any]:
        kind = self._type(self._subscriptions[topic].kind)
        return {"op": "subscribe", "topic": topic, "type": kind, "queue_length": 1, "throttle_rate": 0}

    def _send(self) -> None:
        while (waiting := self._outbox.take()) is not None:
            operations, contents = waiting
            used = self._socket
            try:
                for text in operations:
                    used.send(text)
                for _, content in contents:
                    used.send(_text(content, self._settings.ros))
            except (OSError, self._library.exceptions.WebSocketException):
                self._lost(used)

    def _receive(self) -> None:
        while not self._outbox.closed:
            try:
                for text in self._socket:
                    self._take(text, time.monotonic_ns())
                raise OSError("closed by the server")
            except (OSError, self._library.exceptions.WebSocketException):
                if self._outbox.closed:
                    return
                self._lost(self._socket)
                self._reconnect()

    def _lost(self, used: Any) -> None:
        """Note a loss of the connection, unless there is another one by now."""
        with self._lock:
            if used is self._socket and not self._outbox.closed:
                self._problem = f"the connection to {self._settings.url} is lost"

    def _reconnect(self) -> None:
        while not self._outbox.closed:
            try:
                opened = self._connect()
            except OSError:
                time.sleep(RETRY_TIME)
                continue
            with self._lock:
                self._socket, self._problem = opened, ""
                self.connections += 1
            for content in list(self._announced.values()):  # another thread may add to both
                self._outbox.operate(json.dumps(content))
            for topic in list(self._subscriptions):
                self._outbox.operate(json.dumps(self._subscription(topic)))
            return

    def _take(self, text: str | bytes, arrival: int) -> None:
        try:
            content = json.loads(text)
        except ValueError:
            return  # a frame that is no JSON is none of ours
        if not isinstance(content, dict):
            return
        if content.get("op") == "service_response":
            number = str(content.get("id")).removeprefix(REQUEST)
            if number.isdecimal():
                self._answers.put(int(number), content)
        subscription = self._subscriptions.get(str(content.get("topic")))
        if content.get("op") != "publish" or subscription is None:
            return
        try:
            message = from_json(content["msg"], subscription.kind)
        except (ValueError, KeyError, RecursionError) as error:  # of another type than was asked for
            if subscription.refused is not None:
                subscription.refused(str(error))
            return
        subscription.receive(message, arrival)


def _text(content: dict[str, Any], ros: int) -> str:
    return json.dumps({**content, "msg": to_json(content["msg"], ros)}, allow_nan=False)


class RosbridgeServer:
    """Transport of a simulated robot: a rosbridge server in this process, which also forwards between its clients."""

    problem: Final = ""
    connections: Final = 1

    def __init__(self, settings: Rosbridge) -> None:
        """Listen at the host and port of the address.

        Raises:
            MissingDependency: if websockets is missing.
            InputError: if the port is taken.
        """
        library = _websockets()
        self._library, self._ros = library, settings.ros
        self._clients: dict[Any, _Client] = {}
        self._lock = threading.RLock()
        self._own: dict[str, _Subscription] = {}
        self._types: dict[str, str] = {}
        self._latched: set[str] = set()
        self._last: dict[str, str] = {}
        address = urlparse(settings.url)
        host, port = address.hostname or "localhost", address.port or 9090
        try:
            self._server = library.sync.server.serve(
                self._serve, host, port, max_size=MESSAGE_MAX, compression=None, close_timeout=1.0
            )
        except OSError as error:
            problem = f"nothing can listen at {settings.url} ({error.strerror})"
            raise InputError.of("transport", problem, "expected a free port", Code.EXISTS) from error
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="rosbridge server", daemon=True)
        self._thread.start()

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages of the robot."""
        with self._lock:
            self._types[topic] = kind
            if latched:
                self._latched.add(topic)

    def publish(self, topic: str, message: Any) -> None:
        """Send a message of the robot to every client that subscribes."""
        self._forward(topic, message, None)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive what clients publish on a topic."""
        with self._lock:
            self._own[topic] = _Subscription(kind, receive)

    def peers(self, topic: str) -> Peers:
        """Clients that publish and subscribe."""
        with self._lock:
            publishers = {each.name for each in self._clients.values() if topic in each.published}
            subscribers = {each.name for each in self._clients.values() if topic in each.subscribed}
        return Peers(frozenset(publishers), frozenset(subscribers))

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.shutdown()
        with self._lock:
            clients = list(self._clients)
        for each in clients:
            each.close()

    def _forward(self, topic: str, message: Any, source: Any) -> None:
        content = {"op": "publish", "topic": topic, "msg": message}
        with self._lock:
            if topic in self._latched:
                self._last[topic] = _text(content, self._ros)
            for client in self._clients.values():
                if topic in client.subscribed and client.socket is not source:
                    client.outbox.put(topic, content)

    def _serve(self, connection: Any) -> None:
        """Serve one client until it disconnects."""
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection, f"/client_{connection.remote_address[1]}")
        with self._lock:
            self._clients[connection] = client
        sender = threading.Thread(target=self._send, args=(client,), name="rosbridge sender", daemon=True)
        sender.start()
        try:
            for text in connection:
                self._operate(client, text, time.monotonic_ns())
        except self._library.exceptions.WebSocketException:
            pass  # the client is gone, which its mux timeout answers
        finally:
            with self._lock:
                self._clients.pop(connection, None)
            client.outbox.close()

    def _send(self, client: _Client) -> None:
        while (waiting := client.outbox.take()) is not None:
            operations, contents = waiting
            try:
                for text in operations:
                    client.socket.send(text)
                for _, content in contents:
                    client.socket.send(_text(content, self._ros))
            except (OSError, self._library.exceptions.WebSocketException):
                return  # it is disconnected; the receiver removes it

    def _operate(self, client: _Client, text: str | bytes, arrival: int) -> None:
        """One operation of a client; what is wrong with it is answered with a status, as rosbridge does."""
        try:
            content = json.loads(text)
            operation, topic = content["op"], str(content.get("topic", ""))
            if operation == "publish":
                self._published(client, topic, content["msg"], arrival)
            elif operation == "advertise":
                kind = _kind(content["type"])
                with self._lock:
                    self._types.setdefault(topic, kind)
                    client.published.add(topic)
            elif operation == "unadvertise":
                client.published.discard(topic)
            elif operation == "subscribe":
                client.subscribed.add(topic)
                if topic in self._last:
                    client.outbox.operate(self._last[topic])
            elif operation == "unsubscribe":
                client.subscribed.discard(topic)
            elif operation == "call_service":
                client.outbox.operate(json.dumps(self._answer(content)))
            else:
                raise ValueError(f"unknown operation {operation!r}")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            client.outbox.operate(json.dumps({"op": "status", "level": "error", "msg": f"{error}"}))

    def _published(self, client: _Client, topic: str, content: Any, arrival: int) -> None:
        if topic not in client.published:
            raise ValueError(f"{topic} is not advertised")
        message = from_json(content, self._types[topic])
        own = self._own.get(topic)
        if own is not None:
            if own.kind != self._types[topic]:
                raise ValueError(f"{topic} is of type {own.kind}")
            own.receive(message, arrival)
        self._forward(topic, message, client.socket)

    def _answer(self, content: dict[str, Any]) -> dict[str, Any]:
        """Answer of the two services of rosapi that tell who publishes and subscribes."""
        service, topic = str(content["service"]), str(content.get("args", {}).get("topic", ""))
        peers = self.peers(topic)
        answer: dict[str, Any] = {"op": "service_response", "service": service, "result": True}
        if "id" in content:
            answer["id"] = content["id"]
        if service == "/rosapi/publishers":
            own = {"/robot"} if topic in self._types and topic not in self._own else set()
            answer["values"] = {"publishers": sorted((peers.publishers or frozenset()) | own)}
        elif service == "/rosapi/subscribers":
            own = {"/robot"} if topic in self._own else set()
            answer["values"] = {"subscribers": sorted((peers.subscribers or frozenset()) | own)}
        else:
            answer.update(result=False, values=f"there is no service {service}")
        return answer


@dataclass
class _Client:
    """A client of the server."""

    socket: Any
    name: str
    published: set[str] = field(default_factory=set)
    subscribed: set[str] = field(default_factory=set)
    outbox: Outbox[str, dict[str, Any]] = field(default_factory=Outbox)


def _kind(text: str) -> str:
    """Type as this package writes it, from ``package/Type`` or ``package/msg/Type``.

    Raises:
        ValueError: if there is no such type.
    """
    kind = text if text.count("/") == 2 else text.replace("/", "/msg/", 1)
    if not is_known(kind):
        raise ValueError(f"unknown type {text!r}")
    return kind
