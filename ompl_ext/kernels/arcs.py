"""Deviations of poses from arcs: motions at a constant velocity of the body."""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Floats
from ompl_ext.jit import compiled, inlined
from ompl_ext.trigonometry import cos, sin

OVER = 0.2  # share of an arc by which a pose may be before its beginning or beyond its end
PASSES = 2  # of Newton's method for the nearest pose


@inlined
def _chord(half: float) -> float:
    """Chord of an arc over its length; `half` is half its turn (rad)."""
    return sin(half) / half if abs(half) > 1e-6 else 1.0


@compiled
def _cross_track(poses: Floats, begin: Floats, screw: Floats, reach: float, found: Floats) -> None:
    length = math.sqrt(screw[0] ** 2 + screw[1] ** 2 + (reach * screw[2]) ** 2)
    c, s = cos(begin[2] + 0.5 * screw[2]), sin(begin[2] + 0.5 * screw[2])
    chord = _chord(0.5 * screw[2])
    x, y, turn = chord * (c * screw[0] - s * screw[1]), chord * (s * screw[0] + c * screw[1]), reach * screw[2]
    for i in range(poses.shape[0]):
        for j in range(poses.shape[1]):
            dx, dy, dt = poses[i, j, 0] - begin[0], poses[i, j, 1] - begin[1], reach * (poses[i, j, 2] - begin[2])
            share = min(max((dx * x + dy * y + dt * turn) / (length * length), -OVER), 1.0 + OVER)
            for step in range(PASSES + 1):
                half = 0.5 * share * screw[2]
                c, s, chord = cos(begin[2] + half), sin(begin[2] + half), share * _chord(half)
                ex = dx - chord * (c * screw[0] - s * screw[1])
                ey = dy - chord * (s * screw[0] + c * screw[1])
                et = dt - 2.0 * reach * half
                c, s = cos(begin[2] + 2.0 * half), sin(begin[2] + 2.0 * half)
                ax, ay = (c * screw[0] - s * screw[1]) / length, (s * screw[0] + c * screw[1]) / length
                along = ex * ax + ey * ay + et * turn / length
                if step < PASSES:
                    share += along / length
            found[i, j, 0], found[i, j, 1] = ex - along * ax, ey - along * ay
            found[i, j, 2] = et - along * turn / length


def cross_track(poses: Floats, begin: Floats, screw: Floats, reach: float) -> Floats:
    """Deviations (k, m, 3) of poses (k, m, 3) from an arc, across its direction (m).

    Args:
        poses: positions (m) and headings, continuous with that of `begin`.
        begin: pose at which the arc begins.
        screw: motion of the body along the whole arc (m, m, rad).
        reach: what a radian counts as (m).
    """
    found = np.empty(poses.shape)
    _cross_track(poses, begin, screw, reach, found)
    return found
