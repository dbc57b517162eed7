"""The brake guard drives instead of the controller, and stops the car when the dead man is released."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.control import control_and_guard

from kraft.driving.messages import Commitment, Estimate, Reference, ReferenceKind
from kraft.robot.control import STOPPED
from kraft.robot.guard import LONGEST, Guard


def stops_of_a_guard(*, has_own_code: bool, released: float = math.inf) -> list[float]:
    """Times (s) at which the guard stops the vehicle if it drives from 1 s on and the dead man is `released` (s)."""
    stops: list[float] = []
    on_board = SimpleNamespace(is_stopping=False, end=9.0)

    def stop(estimate: Estimate) -> None:
        stops.append(estimate.time)
        on_board.is_stopping = True

    def nothing(*_: Any) -> None:
        pass

    on_board.stop = stop
    reference = SimpleNamespace(kind=ReferenceKind.PLAN, end=9.0)
    tracker = SimpleNamespace(
        on_board=on_board, connections=1, has_own_code=has_own_code, take_poses=nothing, publish=nothing, commanded=nothing,
        estimate=lambda now: Estimate(now, np.zeros(4), 0.0), command=lambda *_: (np.zeros(2), reference),
    )  # fmt: skip
    inputs, silent = SimpleNamespace(trouble=""), SimpleNamespace(send=nothing, row=nothing)
    guard = Guard(0.05, tracker, inputs, silent, silent)  # type: ignore[arg-type]
    for now in (1.0, 1.05, 1.1, 1.15):
        inputs.trouble = "the dead man is released" if now >= released else ""
        guard._drive(now)
    return stops


def test_it_brakes_once_when_the_dead_man_is_released() -> None:
    assert stops_of_a_guard(has_own_code=False, released=1.1) == [1.1]


def test_it_brakes_at_once_instead_of_a_command_of_the_users_that_may_have_held_up_the_controller() -> None:
    assert stops_of_a_guard(has_own_code=True) == [1.0]
    assert stops_of_a_guard(has_own_code=False) == []


@pytest.mark.parametrize("kind", [ReferenceKind.CONTINGENCY, ReferenceKind.PLAN])
def test_a_vehicle_that_brakes_for_long_is_driven_until_it_stands(kind: ReferenceKind) -> None:
    """12 s, as of a heavy one; without a contingency at the end, the guard ends some time after the plan."""
    _, tracker, _guard = control_and_guard()
    states = np.zeros((2, 4))
    tracker.on_board.mirror(
        Commitment(Reference(kind, np.array([1.0, 13.0]), states, np.zeros((1, 2)), np.zeros(2))), 1.0
    )
    silent = SimpleNamespace(send=lambda *_: None, row=lambda *_: None, closed=False)
    guard = Guard(0.05, tracker, SimpleNamespace(trouble="", take_poses=list), silent, silent)  # type: ignore[arg-type]
    tracker.take_poses, tracker.publish = lambda _: [], lambda *_: None  # type: ignore[method-assign]
    tracker.on_board._must_stop = lambda *_: False  # type: ignore[method-assign]
    now = 1.0
    while not guard._is_done:
        guard._drive(now)
        now += 0.05
    assert now == pytest.approx(14.0 if kind is ReferenceKind.CONTINGENCY else 13.0 + LONGEST, abs=0.2)


def test_a_drive_that_is_to_end_is_not_over_while_the_vehicle_still_brakes() -> None:
    control, tracker, _guard = control_and_guard()
    states = np.zeros((2, 4))
    stop = Reference(ReferenceKind.CONTINGENCY, np.array([1.0, 13.0]), states, np.zeros((1, 2)), np.zeros(2))
    tracker.on_board.mirror(Commitment(stop), 1.0)
    control._ending, control._ended_at = ("success", ""), 1.0
    assert not control._is_over(12.9, tracker.estimate(12.9))
    control._stood = STOPPED
    assert control._is_over(14.0, tracker.estimate(14.0))
