"""Decomposition of a simple polygon: itself if it is convex, else the triangles of ear clipping."""

from __future__ import annotations

from fractions import Fraction
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats, Matrix

ROUNDING: Final = 3.4e-16
"""Error of a computed determinant over the sum of its two products."""
SLIVER: Final = 1e-9
"""Height up to which a triangle is left out: between corners that only rounding keeps off a line, m."""


def triangles(vertices: Matrix) -> list[Matrix]:
    """Convex pieces, each with counter-clockwise corners, of the simple polygon `vertices` (n, 2).

    Raises:
        ValueError: the polygon has no area or is not simple.
    """
    points, cross = counter_clockwise(vertices)
    if np.all(cross >= 0.0):
        return [points]
    remaining, pieces = list(range(len(points))), []
    while len(remaining) > 3:
        ear = next((k for k in range(len(remaining)) if _is_ear(points, remaining, k)), None)
        if ear is None:
            raise ValueError("a polygon may not cross itself")
        pieces.append(points[[remaining[ear - 1], remaining[ear], remaining[(ear + 1) % len(remaining)]]])
        del remaining[ear]
    if _turn(*points[remaining]) < 0:
        raise ValueError("a polygon may not cross itself")
    return [piece for piece in (*pieces, points[remaining]) if _height(piece) > SLIVER]


def counter_clockwise(vertices: Matrix) -> tuple[Matrix, Floats]:
    """Corners of a polygon counter-clockwise, none twice in a row, and the cross products of successive sides.

    Raises:
        ValueError: the polygon has no area, or its sides do not turn once around, so that some of them cross.
    """
    points = np.asarray(vertices, dtype=float)
    points = points[np.any(points != _following(points), axis=1)]  # drop repeated vertices
    if len(points) < 3:
        raise ValueError("a polygon needs an area")
    x, y = (points - points[0]).T  # far from the origin the products would lose digits
    area = 0.5 * float(np.sum(x * _following(y) - _following(x) * y))
    if area == 0.0:
        raise ValueError("a polygon needs an area")
    if area < 0.0:
        points = points[::-1]
    cross, turned = _turning(points)
    if abs(turned - 2.0 * np.pi) > 1e-6:
        raise ValueError("a polygon may not cross itself: its sides must turn once around")
    return points, cross


def _following(rows: Floats) -> Floats:
    """The row after each of some rows (n, ...), the first one after the last; `np.roll` takes ten times as long."""
    return np.concatenate([rows[1:], rows[:1]])


def _turning(points: Matrix) -> tuple[Floats, float]:
    """Cross products of successive sides, and the total turning angle (rad)."""
    sides = _following(points) - points
    following = _following(sides)
    cross = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    return cross, float(np.arctan2(cross, np.sum(sides * following, axis=1)).sum())


def _height(triangle: Matrix) -> float:
    """Smallest height of a triangle, m."""
    (a, b, c), sides = triangle, np.hypot(*(_following(triangle) - triangle).T)
    return float(((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / sides.max())


def _turn(a: Matrix, b: Matrix, c: Matrix) -> int:
    """1 if a triangle turns left, -1 if it turns right, 0 if its corners are on a line, without rounding.

    Where the determinant is within its rounding error (Shewchuk: Adaptive precision floating-point arithmetic, 1997,
    Sec. 4.1), it is computed in fractions: an ear that only rounding makes one covers what the polygon does not.
    """
    left, right = (b[0] - a[0]) * (c[1] - a[1]), (b[1] - a[1]) * (c[0] - a[0])
    cross = left - right
    if abs(cross) <= ROUNDING * (abs(left) + abs(right)):
        ax, ay, bx, by, cx, cy = (Fraction(float(value)) for corner in (a, b, c) for value in corner)
        cross = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return int(cross > 0) - int(cross < 0)


def _is_ear(points: Matrix, remaining: list[int], k: int) -> bool:
    """Whether corner k can be cut off: it is convex and no other corner lies in its triangle."""
    a, b, c = points[remaining[k - 1]], points[remaining[k]], points[remaining[(k + 1) % len(remaining)]]
    if _turn(a, b, c) <= 0:
        return False
    others = [points[i] for i in remaining if not any(np.array_equal(points[i], corner) for corner in (a, b, c))]
    return not any(_turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0 for p in others)
