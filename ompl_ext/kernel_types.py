"""The arrays that kernels share, and the signatures under which one kernel calls another.

A kernel that takes another kernel as an argument keeps its place in the on-disk cache only if the argument is a
first-class function of a signature written down beforehand; these are the three that a system provides.
"""

from __future__ import annotations

from typing import NamedTuple, get_type_hints

import numpy as np
from numba import types, typeof

from ompl_ext.arrays import Floats, Floats32, IntMatrix, Ints, Ints32, Matrix, Matrix32, Words

LANE_WIDTH = 32  # lanes that the arrays hold, the upper bound of the blossom number
Q_DIM = 4  # components of a configuration in the tree's metric: x, y, weighted cosine and sine of the heading


class Problem(NamedTuple):
    """What a query asks and where, constant while the tree grows."""

    parameters: Floats  # of the vehicle
    controls: Matrix  # (nu, 2) bounds
    limits: Matrix  # (nx, 2) state limits, the workspace bounds of x and y among them
    steps: Ints  # integration steps of an edge, largest number of steps of a manoeuvre
    duration: Floats  # shortest, longest edge (s)
    metric: Floats  # weight of the heading (m)
    safety: Floats  # cycle (s), delta_0 (m), delta_1 (s), rest speed, step of a manoeuvre (s)
    body: Floats  # reach, disc radius, length of the footprint (m)
    discs: Floats  # centres of the covering discs along the body axis (m)
    field: Matrix32  # (rows, columns) lower bound of the distance to obstacles (m)
    grid: Floats  # origin x, y and 1 / cell of the field
    togo: Matrix32  # (rows, columns) geodesic cost-to-go at cell centres (s)
    togo_grid: Floats  # origin x, y and 1 / cell of the cost-to-go
    bounds: Floats  # of sampling: x low, x high, y low, y high
    chance: Floats  # goal bias, share of controls beyond each bound (clipped to it)
    options: Ints  # blossom, insertions per visit, child extension, sort by f, ask for SAFETY
    goal: Floats  # x, y, radius, cosine and sine of the heading, cosine of its tolerance


class Lanes(NamedTuple):
    """Working memory of a batch of edges, lane-major; see `ompl_ext.lanes`."""

    control: Floats
    duration: Floats
    block: Floats
    trajectory: Floats
    cosine: Floats
    sine: Floats
    margin: Floats
    end: Floats  # (Q_DIM * width,) configuration at the end of each lane
    togo: Floats
    at_goal: Ints
    slack: Floats
    source: Floats  # (nx,) a state of its own, for callers
    last: Ints  # where the trajectory's last sample starts


class Tree(NamedTuple):
    """The tree as a struct of arrays, with the indices that make selection and dominance sublinear."""

    state: Matrix  # (capacity, nx)
    control: Matrix  # (capacity, nu)
    duration: Floats
    parent: Ints32
    at_goal: Ints32
    hot: Matrix  # (capacity, 8) what searches read, a cache line a node; columns below
    region_level: Ints32
    region_next: Ints32
    region_previous: Ints32
    region_head: Ints32  # first node of each cell, level after level
    level_at: IntMatrix  # where each level starts in region_head, with its columns and rows: (levels, 3)
    level_cell: Floats  # cell size of each level (m)
    level_count: Ints  # nodes on each level
    cell_next: Ints32
    cell_head: Ints32
    cell_best: Floats  # smallest f in each cell
    block_best: Floats  # smallest f in each block of 8 x 8 cells
    block_shape: Ints  # columns, rows
    frame: Floats  # origin x, y; cell of the position grid
    random: Words  # generator state
    count: Ints  # see the constants below
    best: Floats  # cost of the best goal node, smallest cost-to-go of any node


# Columns of Tree.hot; the first Q_DIM are the configuration in the tree's metric
F, RADIUS, COST, TOGO = 4, 5, 6, 7  # f = cost-to-come + cost-to-go (s), radius of the dominance-informed region (m)

# Places in Tree.count
SIZE, ITERATIONS, EDGES, BEST, CLOSEST, NEXT, FIRST_ITERATION, UNSAFE, FULL = range(9)


def _numba_type(tuple_class: type) -> types.NamedTuple:
    kinds = {Floats: "f8", Floats32: "f4", Ints: "i8", Ints32: "i4", Matrix: "f8", Matrix32: "f4", IntMatrix: "i8", Words: "u8"}
    fields = []
    for kind in get_type_hints(tuple_class).values():
        shape = (1, 1) if kind in (Matrix, Matrix32, IntMatrix) else (1,)
        fields.append(typeof(np.empty(shape, dtype=kinds[kind])))
    return types.NamedTuple(fields, tuple_class)


PROBLEM = _numba_type(Problem)
LANES = _numba_type(Lanes)
TREE = _numba_type(Tree)
