"""The brake guard drives instead of the controller, and stops the car when the dead man is released."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from kraft.driving.messages import Estimate, ReferenceKind
from kraft.robot.guard import Guard


def stops_of_a_guard(*, has_own_code: bool, released: float = math.inf) -> list[float]:
    """Times (s) at which the guard stops the vehicle if it drives from 1 s on and the dead man is `released` (s)."""
    stops: list[float] = []
    on_board = SimpleNamespace(is_stopping=False)

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
