"""What waits to be sent by the thread of a transport that may have to wait for its peer."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

SEND_BUFFER: Final = 32 * 1024
"""Size of a socket's buffer for sending, bytes: after a pause of its receiver few old messages are delivered."""
Operation = TypeVar("Operation")
Content = TypeVar("Content")


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
            self.newest[topic] = content
            self.changed.notify()

    def operate(self, operation: Operation) -> None:
        """Add an operation, which is sent before all messages that wait."""
        with self.changed:
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
