"""Kalman update of a state by an observed pose, which errors and the slope of the floor add to.

A camera that takes the floor as level reports where its line of sight to the marker meets the plane in which the marker
would move on a level floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from numba import types

from ompl_ext.arrays import Cube, Floats, IntMatrix, Ints, Matrix
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.cholesky import factorise, solve_factorised
from ompl_ext.kernels.kernel_types import numba_type

HALF_LENGTH = 0.1  # half the distance between two points that show a heading (m)
DIFFERENCE = 1e-4  # step of numeric derivatives by pose and floor (SI)
FLOOR_SIZE = 2  # components of a floor: rise per metre of floor along x and along y
INPUTS = 3 + FLOOR_SIZE

# Indices of Sensor.camera: its position (m), height of the marker above the floor (m), and the place where the floor is
# at the height that the camera takes it to be at (m)
CAMERA_X, CAMERA_Y, CAMERA_Z, MARKER_HEIGHT, LEVEL_X, LEVEL_Y = range(6)


class Sensor(NamedTuple):
    """How an observed pose depends on a state (n,): the sum of `parts`, the first of which is the pose itself.

    The second one is an error in other directions and units, which `spread` takes to those of a pose.  The components
    `floor` are not corrected.  The camera takes the floor as level; without one they have no effect.
    """

    parts: IntMatrix  # (m, 3)
    spread: Matrix  # (3, 3)
    floor: Ints  # (2,), or none
    camera: Floats  # (6,), or none


@part
def seen_place(camera: Floats, x: float, y: float, floor: Floats) -> tuple[float, float]:
    """Measured place (m) of the marker for a place (m) of the vehicle on a floor (2,)."""
    away_x, away_y = x - camera[LEVEL_X], y - camera[LEVEL_Y]
    level = math.sqrt(max(1.0 - (floor[0] * floor[0] + floor[1] * floor[1]), 0.0))  # cosine of the angle of the slope
    rise = floor[0] * away_x + floor[1] * away_y
    tilt = rise / (1.0 + level) + camera[MARKER_HEIGHT]
    height = rise + camera[MARKER_HEIGHT] * level
    stretch = (camera[CAMERA_Z] - camera[MARKER_HEIGHT]) / max(camera[CAMERA_Z] - height, 0.1 * camera[CAMERA_Z])
    return (
        camera[CAMERA_X] + stretch * (camera[LEVEL_X] + away_x - tilt * floor[0] - camera[CAMERA_X]),
        camera[CAMERA_Y] + stretch * (camera[LEVEL_Y] + away_y - tilt * floor[1] - camera[CAMERA_Y]),
    )


@part
def see(camera: Floats, inputs: Floats, seen: Floats) -> None:
    """Write the measured pose (3,) for a pose and a floor, (5,) together; the heading stays within half a turn."""
    see_points(camera, inputs, HALF_LENGTH * math.cos(inputs[2]), HALF_LENGTH * math.sin(inputs[2]), seen)


@part
def see_points(camera: Floats, inputs: Floats, along: float, across: float, seen: Floats) -> None:
    """Write the same by two points that are `along`, `across` (m) before and behind the vehicle on its heading."""
    floor, theta = inputs[3:], inputs[2]
    front_x, front_y = seen_place(camera, inputs[0] + along, inputs[1] + across, floor)
    rear_x, rear_y = seen_place(camera, inputs[0] - along, inputs[1] - across, floor)
    turned = math.atan2(front_y - rear_y, front_x - rear_x) - theta
    seen[0], seen[1] = 0.5 * (front_x + rear_x), 0.5 * (front_y + rear_y)
    seen[2] = theta + turned - math.tau * round(turned / math.tau)


@part
def linearise(camera: Floats, inputs: Floats, seen: Floats, jacobian: Matrix, work: Matrix) -> None:
    """Write the measured pose (3,), and its derivatives (3, 5) by pose and floor; `inputs` (5,) are these."""
    along, across = HALF_LENGTH * math.cos(inputs[2]), HALF_LENGTH * math.sin(inputs[2])
    see_points(camera, inputs, along, across, seen)
    for k in range(INPUTS):
        value = inputs[k]
        for side in range(2):
            inputs[k] = value + DIFFERENCE if side == 0 else value - DIFFERENCE
            if k == 2:
                see(camera, inputs, work[side])
            else:
                see_points(camera, inputs, along, across, work[side])
        inputs[k] = value
        for row in range(3):
            jacobian[row, k] = (work[0, row] - work[1, row]) / (2.0 * DIFFERENCE)


def _see_each(camera: Floats, poses: Matrix, inputs: Floats, seen: Matrix) -> None:
    for i in range(len(poses)):
        for k in range(3):
            inputs[k] = poses[i, k]
        see(camera, inputs, seen[i])


def _linearise_each(camera: Floats, poses: Matrix, inputs: Floats, seen: Matrix, jacobians: Cube, work: Matrix) -> None:
    for i in range(len(poses)):
        for k in range(3):
            inputs[k] = poses[i, k]
        linearise(camera, inputs, seen[i], jacobians[i], work)


@part
def errors(row: int, column: Floats, sensor: Sensor) -> float:
    """Sum of the errors of a component of the pose in a state (n,)."""
    total = 0.0
    if len(sensor.parts) > 1:
        for k in range(3):
            total += sensor.spread[row, k] * column[sensor.parts[1, k]]
    for m in range(2, len(sensor.parts)):
        total += column[sensor.parts[m, row]]
    return total


@part
def weighted(jacobian: Matrix, row: int, column: Floats, sensor: Sensor) -> float:
    """Row of the derivatives of a pose by the state, times a column (n,)."""
    total = 0.0
    for k in range(3):
        total += jacobian[row, k] * column[sensor.parts[0, k]]
    for k in range(len(sensor.floor)):
        total += jacobian[row, 3 + k] * column[sensor.floor[k]]
    return total + errors(row, column, sensor)


def _expect(
    mean: Floats, covariance: Matrix, sensor: Sensor, work: Matrix, pose: Floats, cross: Matrix, expected: Matrix
) -> None:
    jacobian, inputs = work[:3], work[3]
    for row in range(3):
        for k in range(INPUTS):
            jacobian[row, k] = 1.0 if k == row else 0.0
        pose[row] = mean[sensor.parts[0, row]]
    if len(sensor.camera) > 0:
        for row in range(3):
            inputs[row] = pose[row]
        for k in range(FLOOR_SIZE):
            inputs[3 + k] = mean[sensor.floor[k]]
        linearise(sensor.camera, inputs, pose, jacobian, work[4:])
    for row in range(3):
        pose[row] += errors(row, mean, sensor)
        for a in range(len(mean)):
            cross[a, row] = weighted(jacobian, row, covariance[a], sensor)
    for column in range(3):
        for row in range(3):
            expected[row, column] = weighted(jacobian, row, cross[:, column], sensor)


@part
def factorise_copy(a: Matrix, factor: Matrix) -> bool:
    """Write the lower Cholesky factor (3, 3); false if `a` is not positive definite."""
    for i in range(3):
        for j in range(i + 1):
            factor[i, j] = a[i, j]
    return factorise(factor, 3, 0.0)


def _whiten(innovation_covariance: Matrix, innovation: Floats, work: Matrix, whitened: Floats) -> None:
    is_definite = factorise_copy(innovation_covariance, work)
    for i in range(3):
        total = innovation[i] if is_definite else math.nan
        for k in range(i):
            total -= work[i, k] * whitened[k]
        whitened[i] = total / work[i, i]


def _correct(
    covariance: Matrix, cross: Matrix, innovation_covariance: Matrix, kept: Ints, work: Matrix, gain: Matrix,
    after: Matrix,
) -> None:  # fmt: skip
    is_definite, n = factorise_copy(innovation_covariance, work), len(cross)
    for i in range(3):
        for a in range(n):
            gain[i, a] = cross[a, i] if is_definite else math.nan
    if is_definite:
        solve_factorised(work, 3, gain, n)
    for k in range(len(kept)):
        for i in range(3):
            gain[i, kept[k]] = 0.0
    for a in range(n):
        for b in range(a + 1):
            one, other = covariance[a, b], covariance[b, a]
            for i in range(3):
                one -= gain[i, a] * cross[b, i]
                other -= gain[i, b] * cross[a, i]
            after[a, b] = after[b, a] = 0.5 * (one + other)
    for k in range(len(kept)):
        a = kept[k]
        for b in range(n):
            total = covariance[a, b]
            for i in range(3):
                total -= cross[a, i] * gain[i, b]
            after[a, b] = after[b, a] = total


@part
def replace_in(mean: Floats, covariance: Matrix, known: Ints, values: Floats, spread: Matrix, work: Matrix) -> None:
    """Replace two components of a state by values (2,) with the covariance `spread` (2, 2), the others by regression.

    `work` is (2, n): gains of the other components.
    """
    one, other = known[0], known[1]
    a, b, c = covariance[one, one], covariance[one, other], covariance[other, other]
    determinant = a * c - b * b
    first, second = values[0] - mean[one], values[1] - mean[other]
    for k in range(len(mean)):
        p, q = covariance[k, one], covariance[k, other]
        work[0, k], work[1, k] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        mean[k] += work[0, k] * first + work[1, k] * second
    a, b, c = spread[0, 0] - a, spread[0, 1] - b, spread[1, 1] - c
    for k in range(len(mean)):
        p, q = a * work[0, k] + b * work[1, k], b * work[0, k] + c * work[1, k]
        for j in range(k + 1):
            covariance[k, j] = covariance[j, k] = covariance[k, j] + p * work[0, j] + q * work[1, j]


def _replace(means: Matrix, covariances: Cube, known: Ints, values: Floats, spread: Matrix, work: Matrix) -> None:
    for i in range(len(means)):
        replace_in(means[i], covariances[i], known, values, spread, work)


@dataclass(frozen=True)
class PoseFusion:
    """Compiled functions of a Kalman update by a pose; `work` is (6, 5).

    `see(camera, poses, inputs, seen)` and `linearise(camera, poses, inputs, seen, jacobians, work)` are what a camera
    measures of poses (n, 3) on the floor that `inputs` (5,) has, and its derivatives.
    `expect(mean, covariance, sensor, work, pose, cross, expected)` writes the expected pose (3,), its covariance with
    the state (n, 3), and its covariance without noise (3, 3).
    `whiten(innovation_covariance, innovation, work, whitened)` writes the innovation (3,) in standard deviations.
    `correct(covariance, cross, innovation_covariance, kept, work, gain, after)` writes the gain, transposed (3, n), and
    the covariance (n, n) after the pose; components `kept` are not corrected, but all covariances with them are right
    (Schmidt's filter).
    `replace(means, covariances, known, values, spread, work)` replaces two components of states (m, n), see
    `replace_in`.
    """

    see: Callable[[Floats, Matrix, Floats, Matrix], None]
    linearise: Callable[[Floats, Matrix, Floats, Matrix, Cube, Matrix], None]
    expect: Callable[[Floats, Matrix, Sensor, Matrix, Floats, Matrix, Matrix], None]
    whiten: Callable[[Matrix, Floats, Matrix, Floats], None]
    correct: Callable[[Matrix, Matrix, Matrix, Ints, Matrix, Matrix, Matrix], None]
    replace: Callable[[Matrix, Cube, Ints, Floats, Matrix, Matrix], None]


WORK = (6, INPUTS)


@cache
def pose_fusion() -> PoseFusion:
    """The compiled functions; compiled, or loaded from the cache, on the first call."""
    sensor, floats, ints, matrix = numba_type(Sensor), types.float64[::1], types.int64[::1], types.float64[:, ::1]
    nothing, cube = types.void, types.float64[:, :, ::1]
    return PoseFusion(
        compiled(_see_each, signature=nothing(floats, matrix, floats, matrix)),
        compiled(_linearise_each, signature=nothing(floats, matrix, floats, matrix, cube, matrix)),
        compiled(_expect, signature=nothing(floats, matrix, sensor, matrix, floats, matrix, matrix)),
        compiled(_whiten, signature=nothing(matrix, floats, matrix, floats)),
        compiled(_correct, signature=nothing(matrix, matrix, matrix, ints, matrix, matrix, matrix)),
        compiled(_replace, signature=nothing(matrix, cube, ints, floats, matrix, matrix)),
    )
