"""Transports: how messages travel between kraft and a robot.  A new one is a file with the methods of `Transport`.

A transport whose peer may be slow sends from a thread of its own what waits in an `Outbox`.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

Receive: TypeAlias = Callable[[Any, int], None]
"""Called with each message and its time of arrival (ns of the monotonic clock), from a thread of the transport."""
Refused: TypeAlias = Callable[[str], None]
"""Called with why a message is none of the type that was asked for, from a thread of the transport."""


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

    @property
    def connections(self) -> int:
        """Number of connections that were made; after another one this program may have another name for its peers."""

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages of type `kind`; the last one of a latched topic reaches late subscribers too."""

    def publish(self, topic: str, message: Any) -> None:
        """Send a message on an advertised topic, without waiting: of several that cannot be sent the newest counts."""

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive the messages of a topic; `refused` is called with why a message is none of type `kind`."""

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic, without this program; it may wait for an answer of the network."""

    def close(self) -> None:
        """Stop; waiting messages are sent before."""


SEND_BUFFER: Final = 32 * 1024
"""Size of a socket's buffer for sending, bytes: after a pause of its receiver few old messages are delivered."""
Operation = TypeVar("Operation")
Content = TypeVar("Content")
Answer = TypeVar("Answer")


@dataclass
class Outbox(Generic[Operation, Content]):
    """Messages that wait to be sent: of each topic the newest; operations in their order."""

    operations: list[Operation] = field(default_factory=list)
    newest: dict[str, Content] = field(default_factory=dict)
    changed: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False

    def put(self, topic: str, content: Content) -> None:
        """Add a message, which replaces an older one of the topic that still waits."""
        with self.changed:
            if not self.closed:
                self.newest[topic] = content
                self.changed.notify()

    def operate(self, operation: Operation) -> None:
        """Add an operation, which is sent before all messages that wait."""
        with self.changed:
            if not self.closed:
                self.operations.append(operation)
                self.changed.notify()

    def close(self) -> None:
        """Accept nothing more; what waits can still be taken."""
        with self.changed:
            self.closed = True
            self.changed.notify()

    def take(self) -> tuple[list[Operation], list[tuple[str, Content]]] | None:
        """Wait for something to send: operations, and messages with their topics; None if it is closed and empty."""
        with self.changed:
            while not self.operations and not self.newest:
                if self.closed:
                    return None
                self.changed.wait()
            operations, self.operations = self.operations, []
            contents, self.newest = list(self.newest.items()), {}
            return operations, contents


class Answers(Generic[Answer]):
    """Answers to numbered requests, each of which is waited for; one that comes too late is dropped."""

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._expected: dict[int, queue.SimpleQueue[Answer]] = {}

    def ask(self, send: Callable[[int], None], seconds: float) -> Answer | None:
        """Send a request with a new number and wait for its answer; None if none comes in a time (s)."""
        number = next(self._numbers)
        self._expected[number] = queue.SimpleQueue()
        try:
            send(number)
            return self._expected[number].get(timeout=seconds)
        except queue.Empty:
            return None
        finally:
            del self._expected[number]

    def put(self, number: int, answer: Answer) -> None:
        """Take an answer, from the thread that receives it."""
        expected = self._expected.get(number)
        if expected is not None:
            expected.put(answer)


class Receiver:
    """Thread that receives the messages of a transport.

    `defect` says which exception that no transport expects has ended it; it is empty while there is none.
    """

    def __init__(self, receive: Callable[[], None], name: str) -> None:
        """Run `receive` in a new thread of that name."""
        self._receive, self.defect = receive, ""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def join(self, timeout: float) -> None:
        """Wait for the end of the thread, or for a time (s)."""
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:
            self.defect = f"nothing is received any more, because of a defect: {type(error).__name__}: {error}"
            raise  # with its traceback on stderr
