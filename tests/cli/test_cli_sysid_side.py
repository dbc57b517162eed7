"""What `kraft sysid` says of a tracked point beside the middle of the vehicle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.sysid import estimated, fake_identification, fake_log

from kraft_cli.work.sysid_notes import beside_the_middle


@pytest.mark.parametrize(("side", "where"), [(0.08, "0.080 m to the left"), (-0.05, "0.050 m to the right")])
def test_a_tracked_point_beside_the_middle_is_told_with_the_footprint_that_covers_the_vehicle(
    side: float, where: str
) -> None:
    found = fake_identification((fake_log("a"),))
    assert beside_the_middle(None, found) == ()
    known = {**found.parameters, "side": estimated(side, 0.001)}
    (warning,) = beside_the_middle(Path("my.yaml"), replace(found, parameters=known, auxiliary=("delay", "side")))
    assert where in warning
    assert warning.endswith(f"a footprint that is {2 * abs(side):.3f} m wider in my.yaml")
