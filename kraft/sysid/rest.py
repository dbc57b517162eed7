"""Whether a part of a log begins at rest: only then its hidden state, and what was commanded before it, are known.

What counts is the speed at the first pose, extrapolated from the poses after it: a car that starts at once has covered
some way a moment later, and one that was cut out of a drive may be slow compared with what follows.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.smoothing import measured_noise
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Part

GLIMPSE: Final = 0.2
"""Time over which the speeds of a drive are taken, s."""
SLOW: Final = 0.1
"""Share of a part's high speeds that counts as standing."""
CERTAIN: Final = 3.0
"""Standard deviations of the speed at the first pose: what is within them may be standing."""
TELLING: Final = 0.25
"""Most that these may be, as a share of the high speeds, to tell standing from driving."""
ROUNDS: Final = 10
"""Of the fit that outliers do not pull."""
SPANS: Final = (0.25, 0.5, 0.75, 1.0)
"""Over which the speed at the first pose is sought, s: the shortest that tells, since a start bends the path."""


def begins_at_rest(part: Part) -> bool:
    """Whether the poses show that the part begins at rest; not if they are too few or too noisy to tell."""
    times, poses = part.pose_times, part.poses
    if len(times) < 2:
        return False
    interval = float(np.median(np.diff(times)))
    high = _high_speed(part, max(1, round(GLIMPSE / interval)))
    sigma = measured_noise([times], [poses]).position
    for span in SPANS:
        count = 1 + round(span / interval)
        if not 3 <= count <= len(times):
            continue
        basis = np.vander(times[:count] - times[0], 3, increasing=True)
        noise = CERTAIN * sigma * _slope_noise(basis)
        if noise <= TELLING * high:
            return _first_speed(basis, poses[:count, :2], sigma) <= max(SLOW * high, noise)
    return False


def _high_speed(part: Part, apart: int) -> float:
    """Speed that a tenth of the poses `apart` from each other exceed, m/s."""
    if len(part.pose_times) <= apart:
        return 0.0
    way = part.poses[apart:, :2] - part.poses[:-apart, :2]
    speeds: Floats = np.hypot(way[:, 0], way[:, 1]) / (part.pose_times[apart:] - part.pose_times[:-apart])
    return float(np.quantile(speeds, 0.9))


def _slope_noise(basis: Matrix) -> float:
    """Standard deviation of a parabola's slope at its beginning (1/s), per m of that of a pose's x or y."""
    return float(np.linalg.norm(np.linalg.pinv(basis)[1]))


def _first_speed(basis: Matrix, places: Matrix, sigma: float) -> float:
    """Speed at the first of the places (n, 2), m/s; negative if against the way that they go.

    Outliers hardly count: Huber's loss, from `sigma` (m) on.
    """
    weight, fit = np.ones(len(places)), np.zeros((3, 2))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        fit[:] = np.linalg.lstsq(root * basis, root * places, rcond=None)[0]
        off = np.hypot(*(places - basis @ fit).T)
        weight = 1.0 / np.maximum(off, sigma)
    way = (basis[-1] - basis[0]) @ fit
    return float(fit[1] @ way) / max(math.hypot(*way), 1e-9)
