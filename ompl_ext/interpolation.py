"""Linear interpolation of trajectories and of other tables with a row for each time."""

from __future__ import annotations

import numpy as np

from ompl_ext.arrays import Floats, Matrix


def interpolated_rows(x: Floats | float, knots: Floats, rows: Matrix) -> Floats:
    """Rows (..., k) at `x` (...), which may be a number, of `rows` (m, k) that are known at `knots` (m,), ascending.

    Before the first knot and after the last one it is the row there, as `numpy.interp` has it.
    """
    found = np.empty((*np.shape(x), rows.shape[1]))
    for k, column in enumerate(rows.T):
        found[..., k] = np.interp(x, knots, column)
    return found
