"""Loopback transport: topics within a process, and between processes of one machine through a socket.

A frame on the socket is its length (4 bytes), a line of JSON, the operation, and for messages the CDR bytes after it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import struct
import threading
import time
from collections import defaultdict
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.robot.messages import from_cdr, to_cdr
from kraft.robot.transport import SEND_BUFFER, Answers, Outbox, Peers, Receive, Receiver, Refused

LENGTH: Final = struct.Struct("<I")
ANSWER_TIME: Final = 1.0
"""Time to wait for an answer of the robot's end, s."""


class LoopbackBus:
    """Topics in this process; each `node` is a transport of its own."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}
        self.receivers: dict[str, list[tuple[LoopbackNode, Receive]]] = defaultdict(list)
        self.publishers: dict[str, set[str]] = defaultdict(set)
        self.lock = threading.Lock()
        """for the receivers and publishers, which every client's thread changes; messages are delivered without it"""

    def node(self, name: str) -> LoopbackNode:
        """A transport whose publishers and subscribers have a name."""
        return LoopbackNode(self, name)


class LoopbackNode:
    """Transport within the process: messages are delivered by the thread that publishes them."""

    problem: Final = ""
    connections: Final = 1

    def __init__(self, bus: LoopbackBus, name: str) -> None:
        self._bus, self.name = bus, name
        self._latched: set[str] = set()

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages."""
        with self._bus.lock:
            self._bus.publishers[topic].add(self.name)
        if latched:
            self._latched.add(topic)

    def publish(self, topic: str, message: Any) -> None:
        """Deliver a message to all other nodes."""
        if topic in self._latched:
            self._bus.last[topic] = message
        now = time.monotonic_ns()
        with self._bus.lock:
            receivers = list(self._bus.receivers[topic])
        for node, receive in receivers:
            if node is not self:
                receive(message, now)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive the messages of a topic, and the last one of a latched topic at once."""
        with self._bus.lock:
            self._bus.receivers[topic].append((self, receive))
        if latched and topic in self._bus.last:
            receive(self._bus.last[topic], time.monotonic_ns())

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic, without this node."""
        with self._bus.lock:
            subscribers = {node.name for node, _ in self._bus.receivers[topic] if node is not self}
            return Peers(frozenset(self._bus.publishers[topic] - {self.name}), frozenset(subscribers))

    def close(self) -> None:
        """Leave the bus."""
        with self._bus.lock:
            for receivers in self._bus.receivers.values():
                receivers[:] = [each for each in receivers if each[0] is not self]
            for publishers in self._bus.publishers.values():
                publishers.discard(self.name)


LOOPBACK: Final = LoopbackBus()
"""The bus of `transport: {kind: loopback}` in this process."""


class Wire:
    """Frames over a connected socket; one thread may receive while another one sends, and any may shut it down."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._file = connected.makefile("rb")

    def send(self, frame: bytes) -> None:
        """Send a frame; an OSError if the other end is gone."""
        self._socket.sendall(LENGTH.pack(len(frame)) + frame)

    def receive(self) -> bytes | None:
        """Wait for a frame; None if the other end is gone, or after `shut_down`."""
        try:
            head = self._file.read(LENGTH.size)
            size = LENGTH.unpack(head)[0] if len(head) == LENGTH.size else 0
            frame = self._file.read(size)
        except OSError:
            return None
        return frame if size and len(frame) == size else None

    def shut_down(self) -> None:
        """End both directions; the thread that receives closes the socket."""
        with contextlib.suppress(OSError):  # the other end may be gone
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the socket."""
        self._file.close()
        self._socket.close()


class LoopbackServer(LoopbackNode):
    """The robot's end of a socket: a bus in this process, on which every client is a node."""

    def __init__(self, path: str) -> None:
        """Listen.

        Raises:
            InputError: if no socket can be made there.
        """
        super().__init__(LoopbackBus(), "robot")
        self._listener = socket.socket(socket.AF_UNIX)
        try:
            self._listener.bind(path)
            self._listener.listen()
        except OSError as error:
            self._listener.close()
            problem = f"nothing can listen at {path} ({error.strerror or error})"
            raise InputError.of("transport.socket", problem, "expected a new file", Code.EXISTS) from error
        self._path = path
        self._wires: list[Wire] = []
        threading.Thread(target=self._accept, name="loopback server", daemon=True).start()

    def close(self) -> None:
        """Disconnect all clients."""
        super().close()
        with contextlib.suppress(OSError):  # wakes the thread that accepts
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self._path)
        for wire in self._wires:
            wire.shut_down()

    def _accept(self) -> None:
        for number in itertools.count():
            try:
                connected, _ = self._listener.accept()
            except OSError:
                return  # it is closed
            wire, name = Wire(connected), f"client {number}"
            self._wires.append(wire)
            threading.Thread(target=self._serve, args=(wire, self._bus.node(name)), name=name, daemon=True).start()

    def _serve(self, wire: Wire, node: LoopbackNode) -> None:
        """Serve one client until it disconnects, which the multiplexer of the robot answers."""
        outbox, kinds = Outbox[bytes, Any](), dict[str, str]()
        sender = threading.Thread(target=_send, args=(wire, outbox), name="loopback sender", daemon=True)
        sender.start()
        try:
            while (frame := wire.receive()) is not None:
                operation, topic, *more = _operation(frame)
                if operation == "publish":
                    node.publish(topic, from_cdr(_content(frame), kinds[topic]))
                elif operation == "advertise":
                    kinds[topic], latched = more
                    node.advertise(topic, kinds[topic], latched=latched)
                elif operation == "subscribe":
                    kind, latched = more
                    node.subscribe(topic, kind, _into(outbox, topic), latched=latched)
                else:
                    peers = node.peers(topic)
                    names = [sorted(each or ()) for each in (peers.publishers, peers.subscribers)]
                    outbox.operate(_frame("peers", *more, *names))
        finally:
            node.close()
            outbox.close()
            wire.shut_down()
            sender.join()
            wire.close()


class LoopbackClient:
    """Transport through the socket of a robot's end on this machine."""

    def __init__(self, path: str) -> None:
        """Connect.

        Raises:
            InputError: if nobody listens there.
        """
        connected = socket.socket(socket.AF_UNIX)
        try:
            connected.connect(path)
        except OSError as error:
            connected.close()
            problem = f"nobody listens at {path} ({error.strerror or error})"
            raise InputError.of(
                "transport.socket", problem, "expected the socket of kraft world", Code.NOT_FOUND
            ) from error
        self.connections: Final = 1
        self._problem = ""
        self._path, self._wire = path, Wire(connected)
        self._subscriptions: dict[str, tuple[str, Receive]] = {}
        self._answers = Answers[Peers]()
        self._outbox = Outbox[bytes, Any]()
        self._sender = threading.Thread(
            target=_send, args=(self._wire, self._outbox), name="loopback sender", daemon=True
        )
        self._sender.start()
        self._receiver = Receiver(self._receive, "loopback receiver")

    @property
    def problem(self) -> str:
        """Why nothing travels now; empty while messages do."""
        return self._receiver.defect or self._problem

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages."""
        self._outbox.operate(_frame("advertise", topic, kind, latched))

    def publish(self, topic: str, message: Any) -> None:
        """Hand a message to the sender, which drops an older one of the topic that still waits."""
        self._outbox.put(topic, message)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive the messages of a topic, and the last one of a latched topic."""
        self._subscriptions[topic] = kind, receive
        self._outbox.operate(_frame("subscribe", topic, kind, latched))

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic, without this client."""
        answer = self._answers.ask(lambda number: self._outbox.operate(_frame("peers", topic, number)), ANSWER_TIME)
        return answer or Peers(None, None)

    def close(self) -> None:
        """Send what waits and disconnect."""
        self._outbox.close()
        self._sender.join(timeout=1.0)
        self._wire.shut_down()
        if self._receiver.defect:  # otherwise the receiver closes it
            self._wire.close()

    def _receive(self) -> None:
        while (frame := self._wire.receive()) is not None:
            arrival = time.monotonic_ns()
            operation, *content = _operation(frame)
            if operation == "publish":
                kind, receive = self._subscriptions[content[0]]
                receive(from_cdr(_content(frame), kind), arrival)
            else:
                number, publishers, subscribers = content
                self._answers.put(number, Peers(frozenset(publishers), frozenset(subscribers)))
        if not self._outbox.closed:
            self._problem = f"the connection to {self._path} is lost"
            self._outbox.close()
        self._wire.shut_down()
        self._sender.join()
        self._wire.close()


def _into(outbox: Outbox[bytes, Any], topic: str) -> Receive:
    return lambda message, _: outbox.put(topic, message)


def _send(wire: Wire, outbox: Outbox[bytes, Any]) -> None:
    """Send what an outbox holds, until it is closed or the other end is gone, which the receiver notices."""
    while (waiting := outbox.take()) is not None:
        operations, messages = waiting
        try:
            for frame in operations:
                wire.send(frame)
            for topic, message in messages:
                wire.send(_frame("publish", topic) + b"\n" + to_cdr(message))
        except OSError:
            return


def _frame(*operation: Any) -> bytes:
    return json.dumps(operation).encode()


def _operation(frame: bytes) -> list[Any]:
    operation: list[Any] = json.loads(frame.partition(b"\n")[0])
    return operation


def _content(frame: bytes) -> bytes:
    return frame.partition(b"\n")[2]
