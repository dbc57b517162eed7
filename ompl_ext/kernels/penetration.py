"""Clearance field with negative values inside obstacles: there, how deep they are, for `ompl_ext.polish`."""

from __future__ import annotations

import math

from ompl_ext.arrays import Matrix32
from ompl_ext.jit import compiled


@compiled
def fill_penetration(field: Matrix32, cell: float, signed: Matrix32) -> None:
    """Set `signed` to the field where that is positive, else to minus the length of a way to such a cell (m)."""
    rows, columns = field.shape
    for row in range(rows):
        for column in range(columns):
            signed[row, column] = field[row, column] if field[row, column] > 0.0 else -1e6
    for sweep in range(2):
        for i in range(rows):
            row = i if sweep == 0 else rows - 1 - i
            for j in range(columns):
                column = j if sweep == 0 else columns - 1 - j
                if field[row, column] > 0.0:
                    continue
                best = signed[row, column]
                for r in range(max(row - 1, 0), min(row + 2, rows)):
                    for c in range(max(column - 1, 0), min(column + 2, columns)):
                        way = cell * (math.sqrt(2.0) if r != row and c != column else 1.0)
                        best = max(best, min(signed[r, c], 0.0) - way)
                signed[row, column] = best
