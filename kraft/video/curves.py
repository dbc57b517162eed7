"""Curves as equal pieces, for what is drawn of them."""

from __future__ import annotations

import numpy as np

from ompl_ext.arrays import Floats, Matrix


def lengths(points: Matrix) -> Floats:
    """Length of the curve up to each of its points (n, k), (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resampled(points: Matrix, spacing: float) -> Matrix:
    """Points (m, k) along the curve `spacing` apart, or a little less, with the same ends."""
    along = lengths(points)
    if along[-1] <= 0.0:
        return points[:1]
    places = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
    return np.column_stack([np.interp(places, along, column) for column in points.T])


def segments(points: Matrix) -> Floats:
    """The pieces between neighbouring points (n, k): (n - 1, 2, k)."""
    return np.stack([points[:-1], points[1:]], axis=1)
