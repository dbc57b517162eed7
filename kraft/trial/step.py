"""Tick of the controller in a trial."""

from __future__ import annotations

from dataclasses import dataclass

from ompl_ext.arrays import Floats


@dataclass(frozen=True)
class Step:
    """Tick of the controller: true state, estimated state and command."""

    time: float
    pose: tuple[float, float, float]
    speed: float
    estimate: Floats
    command: Floats
    cycle: int
