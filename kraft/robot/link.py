"""The connection of the controller to the robot: since when nothing travels over it, and what that means."""

from __future__ import annotations

import time

from kraft.robot.transport import Transport


class Link:
    """Watches a transport by the machine's clock, as that of a simulation stands when its messages stay away.

    Args:
        transport: that of the controller.
        timeout: time after which the robot's multiplexer stops the vehicle without commands, s.
    """

    def __init__(self, transport: Transport, timeout: float) -> None:
        self._transport, self._timeout = transport, timeout
        self._since: float | None = None

    @property
    def trouble(self) -> str:
        """Why nothing travels now; empty while messages do."""
        return self._transport.problem

    def look(self) -> str:
        """Note whether messages travel, in every tick; what to tell if they do again, else empty."""
        now = time.monotonic()
        if self.trouble:
            self._since = now if self._since is None else self._since
            return ""
        since, self._since = self._since, None
        return "" if since is None else f"the robot is connected again after {now - since:.1f} s: it is told to brake"

    def explained(self, reason: str) -> str:
        """Why a drive ends, with what the vehicle could not be told if nothing travels; `reason` itself otherwise."""
        if not (trouble := self.trouble):
            return reason
        for_how_long = 0.0 if self._since is None else time.monotonic() - self._since
        untold = (
            f"{trouble}, and did not come back within {for_how_long:.1f} s: the vehicle could not be told to brake; "
            f"its multiplexer stops it {self._timeout:g} s after the last command"
        )
        return untold if reason in ("", trouble) else f"{reason}; {untold}"
