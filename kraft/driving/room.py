"""Room of a vehicle by its estimated place: places nearby that have more, and what a plan from such a place must keep.

By its estimate a vehicle at rest may have too little clearance for any plan, or none.  It is taken to stand at a place
nearby that has more.  The estimate may be right, however: a vehicle that cannot go back as it came drives a plan from
there only if that leads away from the obstacle from the estimated place too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from kraft.driving.levels import NEAR
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Plan
from ompl_ext.poses import pose_of, poses_of
from ompl_ext.solver import DirtSolver

ROOM: Final = 0.02
"""Clearance that the place of a vehicle at rest is taken to have, so that it can leave, m."""
NEARBY: Final = 0.06
"""Distance from the estimated place within which such a place is looked for: the error of an estimate, m."""
FARTHEST: Final = 0.3
"""Distance within which a free place is looked for if the estimated one is in an obstacle, m."""
RING: Final = 0.02
"""Distance between two rings of places, m."""
PLACES: Final = 24
"""Number of places in a ring."""
NEARER: Final = 0.001
"""How much nearer to an obstacle than it stands a plan may lead a vehicle that cannot go back, m."""
BACKWARDS: Final = 0.01
"""Speed by which a command must be slower than none for a vehicle that can go back, m/s."""
STARTING: Final = 1.0
"""Time in which it must be, s."""


def nearest_free(dirt: DirtSolver, state: Floats) -> Floats:
    """Nearest collision-free state (nx,) within `FARTHEST`: a vehicle that still drives has not collided."""
    if free_by(dirt, state) >= 0.0:
        return state
    return next((other for other in _around(dirt, state, FARTHEST) if free_by(dirt, other) >= 0.0), state)


def place_with_room(dirt: DirtSolver, state: Floats) -> Floats:
    """State (nx,) of a vehicle at rest, moved to the nearest place with `ROOM`, or to that with the most `NEARBY`."""
    best, most = state, free_by(dirt, state)
    for other in _around(dirt, state, NEARBY):
        if most >= ROOM:
            break
        room = free_by(dirt, other)
        if room > most:
            best, most = other, room
    return best


def free_by(dirt: DirtSolver, state: Floats) -> float:
    """Lower bound of the clearance of a state (nx,), m; minus infinity outside the workspace."""
    (x0, x1), (y0, y1) = dirt.workspace.bounds
    x, y, theta = pose_of(state, dirt.vehicle)
    inside = x0 <= x <= x1 and y0 <= y <= y1
    return dirt.pose_slack(x, y, theta) if inside else -math.inf


def can_go_back(dirt: DirtSolver, state: Floats) -> bool:
    """Whether some command moves a vehicle that stands in a state (nx,) backwards, so that it can leave as it came."""
    speed, limits = dirt.vehicle.rest_indices[0], list(dirt.vehicle.controls.values())

    def reached(control: tuple[float, ...]) -> float:
        samples, _ = dirt.edge(state, np.array(control), STARTING)
        return float(samples[-1, speed])

    none = reached(tuple(min(max(0.0, low), high) for low, high in limits))
    return min(map(reached, itertools.product(*limits))) < none - BACKWARDS


def refusal(dirt: DirtSolver, estimated: Floats, moved: Floats, plan: Plan, driven: Matrix) -> str | None:
    """Why a plan from a `moved` state (nx,) is not driven by a vehicle that may stand in its `estimated` one (nx,).

    A vehicle that stands in front of an obstacle and cannot go back would touch it after some cycles: its plans lead
    nearer to it, and in each cycle it would be moved back to where it has room.  So the first `NEAR` seconds of the
    plan, and the states (n, nx) that the closed loop is predicted to have, come no nearer to an obstacle from the
    estimated place than that is, and lead farther than the vehicle was moved.
    """
    if can_go_back(dirt, estimated):
        return None
    place = [dirt.vehicle.index("x"), dirt.vehicle.index("y")]
    offset, ahead = estimated - moved, plan.trajectory[plan.times <= NEAR]
    start = dirt.least_distance(poses_of(estimated[None, :], dirt.vehicle))
    nearer = start - dirt.least_distance(poses_of(np.vstack([ahead, driven]) + offset, dirt.vehicle))
    if nearer > NEARER:
        return f"the plan leads {nearer:.3f} m nearer to an obstacle than the vehicle stands"
    if np.hypot(*(ahead - moved)[:, place].T).max() <= math.hypot(*offset[place]):
        return "the plan does not lead away from the obstacle at which the vehicle stands"
    return None


def _around(dirt: DirtSolver, state: Floats, farthest: float) -> Iterator[Floats]:
    """The state at places in rings around its own, the nearest ones first."""
    place = [dirt.vehicle.index("x"), dirt.vehicle.index("y")]
    for ring in range(1, round(farthest / RING) + 1):
        for k in range(PLACES):
            moved, angle = state.copy(), k * math.tau / PLACES
            moved[place] += RING * ring * np.array([math.cos(angle), math.sin(angle)])
            yield moved
