"""A tracked point beside the middle of the vehicle."""

from __future__ import annotations

import pytest

from benchmarks.synthetic_logs import synthetic_logs
from kraft.sysid.terms import identify_terms
from kraft.vehicles.config import load_vehicle_config


@pytest.mark.parametrize("side", [-0.06, 0.0])
def test_a_tracked_point_beside_the_middle_is_found_without_being_asked_for(side: float) -> None:
    robot = load_vehicle_config("differential")
    logs = synthetic_logs(robot, {"side": side, "track": 0.5}, range(6), seconds=12.0, noise=(0.002, 0.003))
    found = identify_terms(robot, logs).identification
    assert ("side" in found.auxiliary) == (side != 0.0)
    assert found.values.get("side", 0.0) == pytest.approx(side, abs=0.005)
    assert found.values["track"] == pytest.approx(0.5, rel=0.02)
