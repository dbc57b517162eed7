"""What a vehicle is seen to be capable of in simulated motions of its model."""

from __future__ import annotations

import numpy as np
import pytest

from ompl_ext.arrays import Floats
from ompl_ext.motion import motion_of
from ompl_ext.vehicle import Footprint, Vehicle


def flying(x: Floats, u: Floats, p: Floats) -> tuple[float, float, float]:
    """Derivative of a point that flies along x, at the speed x[2], and is accelerated by u[0]."""
    return x[2], 0.0, u[0]


def test_a_vehicle_that_cannot_stand_is_simulated_from_its_lowest_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    def advance(state: Floats, control: Floats, parameters: Floats, h: float, after: Floats) -> None:
        after[:] = state + h * np.array(flying(state, control, parameters))

    monkeypatch.setattr("ompl_ext.motion.model_step", lambda _: advance)
    motion = motion_of(
        Vehicle(
            "glider", flying, ("x", "y", "v"), {"a": (-1.0, 1.0)}, Footprint(1.0, 1.0), 2.0, limits={"v": (0.5, 2.0)}
        )
    )
    assert motion.low[2] == 0.5
    assert 1.9 < motion.high[2] <= 2.0
    assert motion.twists[:, 0].min() == pytest.approx(0.5)
    assert motion.rate[2] == pytest.approx(1.0)
