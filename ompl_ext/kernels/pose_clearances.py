"""Clearances of the footprint at many poses at once, as vector lanes.

Row `r` of pose i has index r + i of a flat array; with constant strides in one array LLVM vectorises the loops over
poses.  The discs of the footprint are looked up one after the other, each for all poses, and those within a disc only
for the poses where that comes near enough.
"""

from __future__ import annotations

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.jit import inlined, part
from ompl_ext.kernels.fine_field import fine_distance
from ompl_ext.kernels.kernel_types import FINE_INVERSE, GRID_INVERSE, GRID_X, GRID_Y, LANE_WIDTH, Problem
from ompl_ext.trigonometry import cos, sin

POSES = 4 * LANE_WIDTH  # number of poses that are looked up at once
# Rows: position, heading, its cosine and sine; the clearance that is enough, that of the disc round the whole
# footprint and that of the footprint; a point of the body, its place in the clearance field and the value there
AT_X, AT_Y, AT_HEADING, AT_ENOUGH, AT_WHOLE = (k * POSES for k in range(5))
AT_COS, AT_SIN, AT_CLEARANCE, AT_WHO = (k * POSES for k in range(5, 9))
AT_POINT_X, AT_POINT_Y, AT_ROW, AT_COLUMN, AT_VALUE = (k * POSES for k in range(9, 14))
ROW = 14 * POSES  # length of an array of poses


@inlined
def read_field(count: int, problem: Problem, poses: Floats) -> None:
    """Read the clearance field at a point of each pose.

    The places are computed apart from the reading of the field, so that LLVM can vectorise that.
    """
    field, ox, oy = problem.field, problem.scalar[GRID_X], problem.scalar[GRID_Y]
    inverse, last_row, last_column = problem.scalar[GRID_INVERSE], field.shape[0] - 1.0, field.shape[1] - 1.0
    for i in range(count):  # points outside the map count as points of its border
        poses[AT_ROW + i] = min(max(0.0, (poses[AT_POINT_Y + i] - oy) * inverse), last_row)
        poses[AT_COLUMN + i] = min(max(0.0, (poses[AT_POINT_X + i] - ox) * inverse), last_column)
    for i in range(count):
        poses[AT_VALUE + i] = field[int(poses[AT_ROW + i]), int(poses[AT_COLUMN + i])]


@inlined
def distances_of_disc(count: int, disc: Floats, problem: Problem, poses: Floats) -> None:
    """Distance from a disc of the footprint to the nearest obstacle (m), for every pose, in the row of values."""
    ahead, aside, radius = disc[0], disc[1], disc[2]
    for i in range(count):
        c, s = poses[AT_COS + i], poses[AT_SIN + i]
        poses[AT_POINT_X + i] = poses[AT_X + i] + ahead * c - aside * s
        poses[AT_POINT_Y + i] = poses[AT_Y + i] + ahead * s + aside * c
    read_field(count, problem, poses)
    if problem.scalar[FINE_INVERSE] > 0.0:
        for i in range(count):
            if poses[AT_VALUE + i] - radius < poses[AT_CLEARANCE + i]:
                fine = fine_distance(problem, poses[AT_POINT_X + i], poses[AT_POINT_Y + i])
                poses[AT_VALUE + i] = max(poses[AT_VALUE + i], fine)
    for i in range(count):
        poses[AT_VALUE + i] -= radius


@inlined
def lower_by_disc(count: int, disc: Floats, problem: Problem, poses: Floats) -> None:
    """Lower the clearances to the distances of a disc, where those are less."""
    distances_of_disc(count, disc, problem, poses)
    for i in range(count):
        poses[AT_CLEARANCE + i] = min(poses[AT_CLEARANCE + i], poses[AT_VALUE + i])


@inlined
def lower_by_group(count: int, k: int, problem: Problem, poses: Floats, some: Floats) -> None:
    """Lower the clearances by the discs that follow disc k and are within it; `some` is working memory as `poses`."""
    discs, chosen = problem.discs, 0
    distances_of_disc(count, discs[k], problem, poses)
    for i in range(count):
        some[AT_WHO + chosen] = i
        chosen += 1 if poses[AT_VALUE + i] < poses[AT_CLEARANCE + i] else 0
    if chosen == 0:
        return
    for j in range(chosen):
        i = int(some[AT_WHO + j])
        some[AT_X + j], some[AT_Y + j] = poses[AT_X + i], poses[AT_Y + i]
        some[AT_COS + j], some[AT_SIN + j] = poses[AT_COS + i], poses[AT_SIN + i]
        some[AT_CLEARANCE + j] = poses[AT_CLEARANCE + i]
    for member in range(k + 1, k + 1 + int(discs[k, 3])):
        lower_by_disc(chosen, discs[member], problem, some)
    for j in range(chosen):
        poses[AT_CLEARANCE + int(some[AT_WHO + j])] = some[AT_CLEARANCE + j]


@part
def find_clearances(count: int, problem: Problem, memory: Matrix) -> None:
    """Find lower bounds of the clearances (m) at the poses of the first row of `memory`, tight below what is enough.

    The clearance is at least that of the disc round the whole footprint.
    """
    poses, some, discs, k = memory[0], memory[1], problem.discs, 0
    for i in range(count):
        poses[AT_COS + i], poses[AT_SIN + i] = cos(poses[AT_HEADING + i]), sin(poses[AT_HEADING + i])
    for i in range(count):
        poses[AT_CLEARANCE + i] = poses[AT_ENOUGH + i]
    while k < len(discs):
        if discs[k, 3] > 0.0:
            lower_by_group(count, k, problem, poses, some)
        else:
            lower_by_disc(count, discs[k], problem, poses)
        k += 1 + int(discs[k, 3])
    for i in range(count):
        poses[AT_CLEARANCE + i] = max(poses[AT_CLEARANCE + i], poses[AT_WHOLE + i])
