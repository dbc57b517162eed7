"""What is said of a connection to the robot that is lost, and of one that is back."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from kraft.robot.link import Link


def test_a_loss_is_told_with_its_duration_and_with_what_the_vehicle_was_told(monkeypatch: pytest.MonkeyPatch) -> None:
    now, transport = 50.0, SimpleNamespace(problem="")
    monkeypatch.setattr(time, "monotonic", lambda: now)
    link = Link(transport, 0.2)  # type: ignore[arg-type]
    assert (link.look(), link.explained("by a signal")) == ("", "by a signal")
    transport.problem = "the connection is lost"
    assert link.look() == ""
    now = 53.0
    assert link.look() == ""
    lost = (
        "the connection is lost, and did not come back within 3.0 s: the vehicle could not be told to brake; "
        "its multiplexer stops it 0.2 s after the last command"
    )
    assert link.explained("the connection is lost") == link.explained("") == lost
    assert link.explained("by a signal") == f"by a signal; {lost}"
    transport.problem, now = "", 54.5
    assert link.look() == "the robot is connected again after 4.5 s: it is told to brake"
    assert (link.look(), link.explained("by a signal")) == ("", "by a signal")
