"""Warning of a camera that is farther from where the vehicle drives than the errors of its poses were measured."""

from __future__ import annotations

import math
from typing import Final

from kraft.scenario import Scenario
from kraft.scenario.schema import MARKER_HEIGHT

FARTHEST_MEASURED: Final = 7.6
"""Distance from the camera up to which the errors of `single-tag` were measured, m."""


def far_camera(scenario: Scenario, *, anywhere: bool = False) -> str:
    """What to say of a camera whose poses are worse than any that were measured; else empty.

    The poses are those at start and goal, or with `anywhere` those of a vehicle in any corner of the bounds.
    """
    sensing, start, bounds = scenario.sensing, scenario.start, scenario.bounds
    if sensing.preset != "single-tag":
        return ""
    x, y, height = sensing.camera
    above = height - MARKER_HEIGHT
    if anywhere:
        corners = ((cx, cy) for cx in bounds.x for cy in bounds.y)
        places = {"farthest corner": max(corners, key=lambda corner: math.dist(corner, (x, y)))}
    else:
        places = {"start": (start.x, start.y), "goal": scenario.goal.center}
    away = {name: math.hypot(place[0] - x, place[1] - y) for name, place in places.items()}
    far = {name: level for name, level in away.items() if math.hypot(level, above) > FARTHEST_MEASURED}
    if not far:
        return ""
    from kraft.simulation.camera import PRESETS  # loads the simulator

    noise, listed = PRESETS[sensing.preset], []
    for name, level in far.items():
        distance, phi = math.hypot(level, above), math.atan2(level, above)
        error = sensing.noise_scale * noise.position_error(distance, phi)
        listed.append(f"{error:.2g} m at the {name} ({distance:.2g} m from the camera)")
    return (
        f"poses of a tag are wrong by about {' and '.join(listed)}: errors grow with the distance, and "
        f"are measured up to {FARTHEST_MEASURED:g} m; place the camera nearer (sensing.camera), or state other sensing "
        "(sensing.preset: planar)"
    )
