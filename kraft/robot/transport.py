"""Transports: how messages travel between kraft and a robot.  A new one is a file with the methods of `Transport`."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

Receive: TypeAlias = Callable[[Any, int], None]
"""Called with each message and its time of arrival (ns of the monotonic clock), from a thread of the transport."""


@dataclass(frozen=True)
class Peers:
    """Names or keys of the other publishers and subscribers of a topic; None if the transport cannot tell."""

    publishers: frozenset[str] | None
    subscribers: frozenset[str] | None


class Transport(Protocol):
    """Publishes and receives messages on topics."""

    @property
    def problem(self) -> str:
        """Why nothing travels now; empty while messages do."""

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages of type `kind`; the last one of a latched topic reaches late subscribers too."""

    def publish(self, topic: str, message: Any) -> None:
        """Send a message on an advertised topic, without waiting: of several that cannot be sent the newest counts."""

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True
    ) -> None:
        """Receive the messages of a topic."""

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic, without this program; it may wait for an answer of the network."""

    def close(self) -> None:
        """Stop; waiting messages are sent before."""


class LoopbackBus:
    """Topics in this process; each `node` is a transport of its own."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}
        self.receivers: dict[str, list[tuple[LoopbackNode, Receive]]] = defaultdict(list)
        self.publishers: dict[str, set[str]] = defaultdict(set)

    def node(self, name: str) -> LoopbackNode:
        """A transport whose publishers and subscribers have a name."""
        return LoopbackNode(self, name)


class LoopbackNode:
    """Transport within the process: messages are delivered by the thread that publishes them."""

    problem: Final = ""

    def __init__(self, bus: LoopbackBus, name: str) -> None:
        self._bus, self.name = bus, name
        self._latched: set[str] = set()

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages."""
        self._bus.publishers[topic].add(self.name)
        if latched:
            self._latched.add(topic)

    def publish(self, topic: str, message: Any) -> None:
        """Deliver a message to all other nodes."""
        if topic in self._latched:
            self._bus.last[topic] = message
        now = time.monotonic_ns()
        for node, receive in list(self._bus.receivers[topic]):
            if node is not self:
                receive(message, now)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True
    ) -> None:
        """Receive the messages of a topic, and the last one of a latched topic at once."""
        self._bus.receivers[topic].append((self, receive))
        if latched and topic in self._bus.last:
            receive(self._bus.last[topic], time.monotonic_ns())

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic, without this node."""
        subscribers = {node.name for node, _ in self._bus.receivers[topic] if node is not self}
        return Peers(frozenset(self._bus.publishers[topic] - {self.name}), frozenset(subscribers))

    def close(self) -> None:
        """Leave the bus."""
        for receivers in self._bus.receivers.values():
            receivers[:] = [each for each in receivers if each[0] is not self]
        for publishers in self._bus.publishers.values():
            publishers.discard(self.name)


LOOPBACK: Final = LoopbackBus()
"""The bus of `transport: {kind: loopback}` in this process."""
