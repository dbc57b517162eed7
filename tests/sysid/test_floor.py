"""A floor that leans is told from what commands explain."""

from __future__ import annotations

import pytest

from benchmarks.synthetic_logs import synthetic_logs
from kraft.logs.log import Log
from kraft.sysid.floor import leaning_floor
from kraft.vehicles.config import load_vehicle_config


def drives(a_x: float, a_y: float) -> list[Log]:
    truth = {"v_delta": 1.2, "tau": 0.5, "a_x": a_x, "a_y": a_y}
    return synthetic_logs(load_vehicle_config("mushr-force"), truth, range(6), seconds=15.0)


@pytest.mark.parametrize(("a_x", "a_y", "direction"), [(0.4, 0.0, 0.0), (0.0, -0.4, -90.0), (-0.3, 0.3, 135.0)])
def test_a_floor_that_leans_is_said_with_its_direction(a_x: float, a_y: float, direction: float) -> None:
    said = leaning_floor(drives(a_x, a_y))
    assert float(said.split("direction ")[1].split(" deg")[0]) == pytest.approx(direction, abs=15.0)
    assert float(said.split("about ")[1].split(" m/s^2")[0]) == pytest.approx((a_x**2 + a_y**2) ** 0.5, rel=0.3)


def test_a_level_floor_is_not_said_to_lean() -> None:
    assert not leaning_floor(drives(0.0, 0.0))
    assert not leaning_floor([])
