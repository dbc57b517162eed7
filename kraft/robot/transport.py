"""Transports: how messages travel between kraft and a robot.  A new one is a file with the methods of `Transport`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

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
