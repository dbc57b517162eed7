"""Arrays that the kernels share.

A kernel receives a few named tuples of arrays; single numbers are entries of arrays, with the indices named here.  (Few
arrays with named indices compile faster than many fields.)
"""

from __future__ import annotations

from typing import Any, NamedTuple, get_type_hints

import numba
import numpy as np

from ompl_ext.arrays import (
    Cube,
    Floats,
    Floats32,
    IntMatrix,
    IntMatrix32,
    Ints,
    Ints32,
    Matrix,
    Matrix32,
    Words,
    Words16Matrix,
)

LANE_WIDTH = 32  # lanes that the arrays hold, the upper bound of the blossom number
Q_DIM = 4  # components of a configuration in the tree's metric: x, y, weighted cosine and sine of the heading


class Problem(NamedTuple):
    """Query and maps, constant while the tree grows."""

    parameters: Floats  # of the vehicle
    controls: Matrix  # (nu, 2) bounds
    limits: Matrix  # (nx, 2) state limits, the workspace bounds of x and y among them
    discs: Matrix  # (n, 4) centres in the body frame, radii (m), and how many that follow are within, see `grouped`
    field: Matrix32  # (rows, columns) lower bound of the distance to obstacles (m)
    togo: Matrix32  # (rows, columns) geodesic cost-to-go at the same cells' centres (s)
    tile: IntMatrix32  # (rows, columns) number of each tile of the fine field, -1 where none is stored
    squares: Words16Matrix  # (tiles, vertices) squared distances of the fine field, in squared spacings
    pose_togo: Floats32  # cost-to-go of poses, flat, headings x rows x columns (s); see `ompl_ext.kernels.posetogo`
    goal_limits: Matrix  # (nx, 3) bounds of each component in the goal, and least time per unit to change it (s)
    scalar: Floats
    option: Ints
    functions: Ints  # addresses of the vehicle's compiled functions, see `ompl_ext.kernels.functions`


class Maps(NamedTuple):
    """Part of a problem that determines whether a pose is free."""

    discs: Matrix
    field: Matrix32
    tile: IntMatrix32
    squares: Words16Matrix
    scalar: Floats


# Indices of Problem.scalar
SHORTEST, LONGEST, QUANTUM = 0, 1, 2  # edge durations; multiples of QUANTUM if it is positive (s)
HEADING_WEIGHT, RESOLUTION = 3, 4  # of the tree's metric (m)
CYCLE, DELTA, DELTA_PER_SPEED = 5, 6, 7  # planning cycle (s); clearance DELTA + DELTA_PER_SPEED |v| at first (m, s)
REST_SPEED, REST_RATE = 8, 11  # largest speed at standstill, and largest value of other components that vanish (SI)
BRAKE_STEP = 9  # integration step of a manoeuvre (s)
REACH, LENGTH = 10, 12  # of the footprint (m)
GRID_X, GRID_Y, GRID_INVERSE = 13, 14, 15  # lower left corner and 1 / cell of field and togo
X_LOW, X_HIGH, Y_LOW, Y_HIGH = 16, 17, 18, 19  # workspace bounds (m)
GOAL_BIAS = 20  # share of samples at the goal
CONTROL_BOUND_BIAS = 21  # how far controls are sampled beyond each bound, onto which they are moved, in ranges
EXPLORATION = 28  # share of the visits to a sampled node that add any free candidate instead of the best
GOAL_X, GOAL_Y, GOAL_RADIUS = 22, 23, 24  # (m)
GOAL_COS, GOAL_SIN, GOAL_TOLERANCE = 25, 26, 27  # of the heading; the tolerance as its cosine
DELTA_PER_TIME, DELTA_HORIZON = 29, 30  # clearance added per second since the start of the query, for so long (m/s, s)
FINE_X, FINE_Y, FINE_COS, FINE_SIN = 31, 32, 33, 34  # frame of the fine field (m)
FINE_INVERSE = 35  # 1 / spacing of the fine field (1/m), 0 without one
POSE_X, POSE_Y, POSE_INVERSE, POSE_BEYOND = 36, 37, 38, 39  # first centre (m) and 1 / cell of pose_togo; see `posetogo`
TOP_SPEED, BRAKING = 40, 41  # of the vehicle (m/s, m/s^2); BRAKING is 0 if the goal does not bound the speed
GOAL_SPEED = 42  # largest speed in the goal (m/s)
GOAL_NEAR = 43  # distance from the goal's centre beyond which no edge that begins there reaches the goal (m)
SHORTEST_NEAR_GOAL = 44  # duration of the shortest edge from nodes that are near a goal that CUT_AT_GOAL (s)
POSE_HEADING = 45  # heading of the first layer of pose_togo (rad)
NEAR = 46  # time since the start of the query after which another clearance is kept (s)
DELTA_FAR, DELTA_FAR_PER_SPEED = 47, 48  # that is DELTA_FAR + DELTA_FAR_PER_SPEED |v| (m, s)
SCALARS = 49

# Indices of Problem.option
STEPS, BRAKE_STEPS = 0, 1  # integration steps of the longest edge, of the longest manoeuvre
BLOSSOM, INSERTIONS, CHILD_EXTENSION, REQUIRE_SAFETY = 2, 3, 4, 5
POSE_HEADINGS, POSE_ROWS, POSE_COLUMNS = 6, 7, 8  # shape of pose_togo; 0 headings without it
CUT_AT_GOAL = 9  # whether an edge that passes through the goal ends there
GOAL_HEADING, GOAL_LIMITS = 10, 11  # whether the goal has a heading, and bounds of other components
MANOEUVRES = 12  # number of the vehicle's contingency manoeuvres
OPTIONS = 13

# Indices of the weights of rollouts: step (s), weights of the time to the goal, of a collision, of a clearance below
# the margin (m), of errors of position, heading and speed, and of controls; cost beyond the least one that is infinite
ROLLOUT_STEP, ROLLOUT_GOAL, ROLLOUT_COLLISION, ROLLOUT_NEAR, ROLLOUT_MARGIN = range(5)
ROLLOUT_POSITION, ROLLOUT_HEADING, ROLLOUT_SPEED, ROLLOUT_GAMMA, ROLLOUT_CUTOFF = range(5, 10)
ROLLOUT_WEIGHTS = 10

SST_SELECTION, SST_PRUNING = range(2)  # indices of the radii of SST (m)


class Lanes(NamedTuple):
    """Working memory of a batch of edges, lane-major; see `ompl_ext.kernels.lanes`."""

    control: Floats
    duration: Floats
    steps: Ints  # integration steps of each lane
    block: Floats
    trajectory: Floats  # states, step after step
    deviation: Floats  # of the motion in a step from one at constant rates (m), step after step
    end: Floats  # (Q_DIM * width,) configuration at the end of each lane
    togo: Floats  # cost-to-go from there (s)
    at_goal: Ints
    slack: Floats  # clearance beyond the required one (m), negative if the edge may collide
    source: Floats  # (nx,) a state to start from


STAGES = 3  # of a Runge-Kutta step whose derivatives the working block has; those of the last one are used at once


def block_layout(nx: int) -> tuple[int, int, int, int, int, int, int]:
    """Indices in the working block of step, deviation, outside, cosine, sine, stages, input; the state is before them.

    The input is last because its length is the vehicle's.
    """
    begin = nx * LANE_WIDTH
    step, deviation, outside, cosine, sine, stages = (begin + k * LANE_WIDTH for k in range(6))
    return step, deviation, outside, cosine, sine, stages, stages + STAGES * begin


def block_length(nx: int, inputs: int) -> int:
    """Length of the working block for states of `nx` components and `inputs` of the vehicle."""
    return block_layout(nx)[-1] + inputs * LANE_WIDTH


class Tree(NamedTuple):
    """Tree as a struct of arrays, with the two spatial indices of `ompl_ext.kernels.tree`."""

    state: Matrix  # (capacity, nx)
    edge: Matrix  # (capacity, nu + 1) control and duration of the edge from the parent
    value: Matrix  # (capacity, 8) what the search reads of a node, one cache line each
    link: IntMatrix32  # (capacity, 8), half a cache line each
    region_cells: IntMatrix32  # (cells, 2) list of each cell and a bound of f in it, level after level
    level: IntMatrix  # (levels, 7)
    level_cell: Floats  # cell size of each level (m)
    cells: IntMatrix32  # (cells, 2) list of each cell of positions, and a bound of f in it
    block_bound: Ints32  # bound of f in each block of cells
    block_shape: Ints  # columns, rows of blocks, and how they are stored
    frame: Floats  # lower left corner and cell size of the cells (m)
    count: Ints  # type: ignore[assignment]  # hides the method of tuples, which is not needed
    best: Floats  # cost of the best goal node, smallest cost-to-go of any node (s)
    random: Words  # generator state


# Columns of Tree.value; the first Q_DIM are the configuration in the tree's metric.  F is the sum of cost-to-come and
# cost-to-go (s), RADIUS that of the dominance-informed region, 0 of closed nodes (m)
F, RADIUS, COST, TOGO = range(4, 8)

# Indices of Tree.frame
CELLS_X, CELLS_Y, CELL_SIZE = range(3)

# Columns of Tree.link
PARENT, AT_GOAL, REGION_LEVEL, REGION_NEXT, REGION_PREVIOUS, CELL_NEXT, VISITS = range(7)

# Columns of Tree.region_cells and Tree.cells: first node + 1, and a bound of f in ticks.  An empty cell is zeros, so
# that memory may stay as the system gives it.  The bound of regions is above the largest f of a cell.  That of
# positions, and that of a block, is more than the smallest f is below MOST_TICKS.
HEAD, BOUND = range(2)
TICKS = 4096.0  # per s
MOST_TICKS = 2.0**31 - 3.0  # 6 days; a larger f counts as this

# Columns of Tree.level: first index in region_cells, columns and rows, number of nodes, and how the cells are stored
LEVEL_START, LEVEL_COLUMNS, LEVEL_ROWS, LEVEL_COUNT = range(4)
LEVEL_COLUMN_MASK, LEVEL_ROW_MASK, LEVEL_STRIDE = range(4, 7)

# Indices of Tree.block_shape
BLOCK_COLUMNS, BLOCK_ROWS, BLOCK_COLUMN_MASK, BLOCK_ROW_MASK, BLOCK_STRIDE = range(5)

# Indices of Tree.count
SIZE, ITERATIONS, EDGES, BEST, CLOSEST, NEXT, FIRST_ITERATION, UNSAFE, FULL, RETAINED, PRUNED = range(11)
COUNTS = 11


class RolloutMemory(NamedTuple):
    """Working memory of a batch of rollouts, see `ompl_ext.kernels.rollouts`."""

    block: Floats
    path: Matrix  # (steps, 6 * width) what is kept of each step
    poses: Matrix  # (2, n) poses whose clearances are found at once, see `ompl_ext.kernels.pose_clearances`


WAITING = -2  # instead of the node of a retained edge


class Retained(NamedTuple):
    """Edges of an earlier plan or tree for the start of a query, parents before children."""

    parent: Ints  # index of the parent edge, -1 at the root
    edge: Matrix  # (edges, nu + 1) control and duration
    target: Matrix  # (n, Q_DIM) configurations where the first n edges ended; these edges are corrected to end there
    node: Ints  # node of each edge's end in the tree, -1 if the edge was omitted, `WAITING` if it is to be added


_types: Any = numba.types  # numba has no types
_typeof: Any = numba.typeof


def numba_type(tuple_class: type) -> Any:
    """Type of a named tuple of arrays in the signature of a kernel."""
    kinds = {
        Floats: (1, "f8"), Floats32: (1, "f4"), Ints: (1, "i8"), Ints32: (1, "i4"), Words: (1, "u8"),
        Matrix: (2, "f8"), Matrix32: (2, "f4"), IntMatrix: (2, "i8"), IntMatrix32: (2, "i4"), Words16Matrix: (2, "u2"),
        Cube: (3, "f8"),
    }  # fmt: skip
    hints = [kinds[kind] for kind in get_type_hints(tuple_class).values()]
    return _types.NamedTuple([_typeof(np.empty((1,) * ndim, dtype=dtype)) for ndim, dtype in hints], tuple_class)


PROBLEM = numba_type(Problem)
LANES = numba_type(Lanes)
TREE = numba_type(Tree)
ROLLOUT_MEMORY = numba_type(RolloutMemory)
RETAINED_EDGES = numba_type(Retained)
