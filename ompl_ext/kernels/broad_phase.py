"""Broad phase of exact clearances: lower bounds of the distances between a rectangle and convex pieces.

The bound is the larger of the distances between the bounding boxes in the rectangle's frame and in the world's.
Poses are treated in chunks: a piece farther from a chunk's centre than the nearest one by more than the chunk's
diameter is nearest at none of its poses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ompl_ext.arrays import Floats, IntMatrix32, Ints32, Matrix
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.distance import Shapes, near_shapes
from ompl_ext.vehicle import Footprint

CHUNK, CHUNKS = 16, 16  # poses of a chunk, chunks that are treated together


class Body(NamedTuple):
    """Rectangle of a footprint: half its length and width, its offset and its reach, m."""

    half_length: float
    half_width: float
    offset: float
    reach: float


def body_of(footprint: Footprint) -> Body:
    """Rectangle of a footprint."""
    return Body(footprint.length / 2, footprint.width / 2, footprint.offset, footprint.reach)


@inlined
def _gap(low: float, high: float, other_low: float, other_high: float) -> float:
    """Distance between two intervals, 0 if they meet."""
    return max(other_low - high, low - other_high, 0.0)


@inlined
def _piece_bound(pieces: Shapes, piece: int, body: Body, x: float, y: float, c: float, s: float) -> float:
    """Lower bound of the distance from the body at a pose to a piece (m)."""
    first, end = pieces.start[piece], pieces.start[piece + 1]
    low_u = low_v = low_x = low_y = math.inf
    high_u = high_v = high_x = high_y = -math.inf
    for k in range(first, end):
        px, py = pieces.points[k, 0], pieces.points[k, 1]
        dx, dy = px - x, py - y
        u, v = dx * c + dy * s - body.offset, dy * c - dx * s
        low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
        low_x, high_x, low_y, high_y = min(low_x, px), max(high_x, px), min(low_y, py), max(high_y, py)
    in_body = math.hypot(
        _gap(-body.half_length, body.half_length, low_u, high_u), _gap(-body.half_width, body.half_width, low_v, high_v)
    )
    if end == first + 1:
        return in_body - pieces.radius[piece]
    width = body.half_length * abs(c) + body.half_width * abs(s)
    height = body.half_length * abs(s) + body.half_width * abs(c)
    cx, cy = x + c * body.offset, y + s * body.offset
    in_world = math.hypot(_gap(cx - width, cx + width, low_x, high_x), _gap(cy - height, cy + height, low_y, high_y))
    return max(in_body, in_world)


@inlined
def _near_poses(
    pieces: Shapes, poses: Matrix, first: int, end: int, reach: float, given: Ints32, count: int, near: Ints32,
    gap: Floats,
) -> int:  # fmt: skip
    """Choose, of `count` given pieces, those that may be nearest to the body at poses first ... end - 1."""
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for k in range(first, end):
        low_x, high_x = min(low_x, poses[k, 0]), max(high_x, poses[k, 0])
        low_y, high_y = min(low_y, poses[k, 1]), max(high_y, poses[k, 1])
    half = 0.5 * math.hypot(high_x - low_x, high_y - low_y) + reach
    return near_shapes(pieces, 0.5 * (low_x + high_x), 0.5 * (low_y + high_y), half, given, count, near, gap)


@compiled
def lower_bounds(pieces: Shapes, poses: Matrix, body: Body, numbers: IntMatrix32, gap: Floats, bounds: Floats) -> None:
    """Lower bounds (n,) of the clearance at poses (n, 3), m.

    Row 2 of `numbers` (3, pieces) has the number of each piece; the others and `gap` (pieces,) are working memory.
    """
    for first in range(0, len(poses), CHUNK * CHUNKS):
        end = min(first + CHUNK * CHUNKS, len(poses))
        outer = _near_poses(pieces, poses, first, end, body.reach, numbers[2], len(gap), numbers[0], gap)
        for low in range(first, end, CHUNK):
            high = min(low + CHUNK, end)
            inner = _near_poses(pieces, poses, low, high, body.reach, numbers[0], outer, numbers[1], gap)
            for k in range(low, high):
                x, y, c, s = poses[k, 0], poses[k, 1], math.cos(poses[k, 2]), math.sin(poses[k, 2])
                bounds[k] = math.inf
                for piece in range(inner):
                    bounds[k] = min(bounds[k], _piece_bound(pieces, numbers[1, piece], body, x, y, c, s))


@compiled
def nearest_pieces(pieces: Shapes, poses: Matrix, body: Body, numbers: IntMatrix32, gap: Floats) -> int:
    """Number of pieces that may be nearest at the only pose (1, 3): the first entries of row 0 of `numbers`.

    Their lower bounds (m) are the first entries of `gap`; the arrays are those of `lower_bounds`.
    """
    count = _near_poses(pieces, poses, 0, 1, body.reach, numbers[2], len(gap), numbers[0], gap)
    x, y, c, s = poses[0, 0], poses[0, 1], math.cos(poses[0, 2]), math.sin(poses[0, 2])
    for k in range(count):
        gap[k] = _piece_bound(pieces, numbers[0, k], body, x, y, c, s)
    return count
