"""The controller of a drive and the brake guard that drives beside it."""

from __future__ import annotations

import re
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from support.control import control_and_guard

from kraft.robot.control import ControlLoop
from kraft.robot.protocol import Beat, Guarded
from kraft.robot.transport import Peers


def take_guarded(control: ControlLoop, now: float) -> int:
    """Number of the commands that the guard has sent, as soon as one has arrived."""
    until = time.monotonic() + 5.0
    while (found := control._take_guarded(now)) == 0 and time.monotonic() < until:
        time.sleep(0.001)
    return found


def test_a_command_of_the_guard_that_is_newer_than_the_tick_counts_from_the_tick() -> None:
    """The guard may send one between the beginning of a tick and the look at its messages."""
    control, tracker, guard = control_and_guard()
    guard.send(Guarded(1.3, np.array([0.5, 0.1])))
    assert take_guarded(control, 1.2) == 1
    assert tracker.last_sent == 1.2
    tracker.commanded(1.2, np.zeros(2))


def test_a_guard_that_has_driven_is_told_again_what_is_on_board() -> None:
    """It may have stopped meanwhile, and would go on from where the vehicle was then if it had to drive again."""
    control, _, guard = control_and_guard()
    told = []
    for now in (1.0, 1.1, 1.2):
        if now == 1.2:
            guard.send(Guarded(1.15, np.zeros(2)))
            assert take_guarded(control, now) == 1
        control._tell_guard(now, np.zeros(2), ())
        assert guard.poll(5.0)
        beat = guard.recv()
        assert isinstance(beat, Beat)
        told.append(beat.commitment is not None)
    assert told == [True, False, True]


def test_of_a_pause_in_which_the_multiplexer_stopped_the_wheels_are_known_as_they_were() -> None:
    control, tracker, _ = control_and_guard()
    tracker.commanded(0.9, np.array([0.5, 0.3]))
    control._last_tick = 0.9
    control._hold_up(2.0)
    sent = [(round(when, 6), *command.tolist()) for when, command, _ in control._sensed().ticks]
    assert sent == [(0.9 + control._spec.robot.command.timeout, 0.0, 0.3)]


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_a_decision_is_asked_for_its_lead_before_commands_act_in_its_cycle(
    delay: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the time at which commands are sent, a delay as long as the lead left no time to decide."""
    control, tracker, _ = control_and_guard()
    monkeypatch.setattr(tracker, "_estimator", SimpleNamespace(horizon=delay))
    monkeypatch.setattr(control, "_mailbox", SimpleNamespace(closed=False, send=lambda _: None))
    asked, settings = [], tracker.settings
    for number in range(3):
        times = ((number - 1) * settings.cycle - delay + 0.001 * k for k in range(2000))
        asked.append(next(now for now in times if control._request(now) or control._requests._asked is not None))
        control._requests.answered(control._acts(asked[-1] + 0.01))
    assert asked == pytest.approx([k * settings.cycle - settings.lead - delay for k in range(3)], abs=0.002)


def test_a_network_that_is_slow_to_tell_who_publishes_does_not_count_as_a_pause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A rosbridge without rosapi does not answer at all."""
    control, _, _guard = control_and_guard()  # its planner has ended, and so does the drive
    events, peers = list[str](), control._transport.peers

    def slow(topic: str) -> Peers:
        if threading.current_thread() is threading.main_thread():
            time.sleep(1.0)
        return peers(topic)

    tables = SimpleNamespace(
        row=lambda name, *values: events.append(values[-1]) if name == "events" else None, problem=""
    )
    monkeypatch.setattr(control, "_tables", tables)
    monkeypatch.setattr(control._transport, "peers", slow)
    monkeypatch.setattr("kraft.robot.control.shorten_collections", lambda: None)
    assert control.run().reason == "the planner has ended"
    assert events[-1] == "stopped: the planner has ended"
    held_up = [float(found[1]) for event in events if (found := re.search(r"held up for ([\d.]+) s", event))]
    assert all(seconds < 0.9 for seconds in held_up), "a busy machine may hold it up by itself"
