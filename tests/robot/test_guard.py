"""The brake guard drives instead of the controller, and stops the car when the dead man is released."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from kraft.driving.messages import Estimate, ReferenceKind
from kraft.robot.guard import Guard


def test_it_brakes_once_when_the_dead_man_is_released() -> None:
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
        on_board=on_board, connections=1, take_poses=nothing, publish=nothing, commanded=nothing,
        estimate=lambda now: Estimate(now, np.zeros(4), 0.0), command=lambda *_: (np.zeros(2), reference),
    )  # fmt: skip
    inputs, silent = SimpleNamespace(trouble=""), SimpleNamespace(send=nothing, row=nothing)
    guard = Guard(0.05, tracker, inputs, silent, silent)  # type: ignore[arg-type]
    for now in (1.0, 1.05, 1.1, 1.15):
        inputs.trouble = "the dead man is released" if now > 1.06 else ""
        guard._drive(now)
    assert stops == [1.1]
