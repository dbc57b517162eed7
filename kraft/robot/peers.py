"""Other publishers of commands, as the transport lists them, told from the processes of the drive."""

from __future__ import annotations

import time as clock

from kraft.robot.transport import Transport


def wait_for_another(transport: Transport, topic: str, before: frozenset[str] | None, seconds: float) -> None:
    """Wait until a topic has one more publisher than `before`; not where the transport cannot tell.

    A process of the drive that is listed later than it is ready would be taken for somebody else.
    """
    until = clock.monotonic() + seconds
    while before is not None and clock.monotonic() < until:
        there = transport.peers(topic).publishers
        if there is None or len(there) > len(before):
            return
        clock.sleep(0.05)


class PeerWatch:
    """Finds a publisher of commands that is none of the drive's own.

    Own clients may have other names after a reconnection; then as many publishers as before are those of the drive.
    """

    def __init__(self, transport: Transport, topic: str) -> None:
        """Take the publishers that are known first for those of the drive: the brake guard, and this one if listed."""
        self._transport, self._topic = transport, topic
        self._own = transport.peers(topic).publishers
        self._connections = transport.connections
        self._renamed = False
        self.foreign = ""
        """who else publishes, for people; empty if nobody does"""

    def reconnected(self) -> None:
        """Note that a process of the drive has connected again."""
        self._renamed = True

    def look(self) -> None:
        """Look once; it may wait for an answer of the network."""
        there = self._transport.peers(self._topic).publishers
        if self._transport.connections != self._connections:
            self._connections, self._renamed = self._transport.connections, True
        if there is None:
            return
        if self._own is None:
            self._own = there
        if self._renamed and len(there) == len(self._own):
            self._own, self._renamed = there, False
        others = there - self._own
        if self._renamed and len(there) < len(self._own):  # some are not connected again yet
            others = frozenset()
        names = ", ".join(sorted(others))
        self.foreign = f"somebody else publishes commands on {self._topic} ({names})" if others else ""
