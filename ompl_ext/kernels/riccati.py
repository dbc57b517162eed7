"""Backward and forward pass of a linear-quadratic problem with bounded controls, for `ompl_ext.polish`.

Minimises the sum of 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du + 1/2 stiffness w'w over the stages with
dx+ = A dx + B du + c + w and low <= du <= high.  The virtual controls w let a trajectory deviate from the model; a
rising stiffness leads to one that obeys it (Mao et al., Successive convexification, 2016).  Bounds are treated as in box-DDP (Tassa et al., Control-limited differential dynamic programming,
2014), by one round of clamping.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba

from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.jit import compiled, inlined


class Stages(NamedTuple):
    """Stages of a problem with n stages, nx states and m controls; Q and q have one more, the last state's."""

    a: Cube  # (n, nx, nx)
    b: Cube  # (n, nx, m)
    c: Matrix  # (n, nx)
    q_matrix: Cube  # (n + 1, nx, nx)
    q: Matrix  # (n + 1, nx)
    r_matrix: Cube  # (n, m, m)
    r: Matrix  # (n, m)
    low: Matrix  # (n, m)
    high: Matrix  # (n, m)


@inlined
def _solve(matrix: Matrix, size: int, right: Matrix, columns: int) -> bool:
    """Solve in place by Cholesky's decomposition; false if the matrix is not positive definite."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if total <= 1e-12:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for column in range(columns):
        for i in range(size):
            total = right[i, column]
            for k in range(i):
                total -= matrix[i, k] * right[k, column]
            right[i, column] = total / matrix[i, i]
        for i in range(size - 1, -1, -1):
            total = right[i, column]
            for k in range(i + 1, size):
                total -= matrix[k, i] * right[k, column]
            right[i, column] = total / matrix[i, i]
    return True


def _solve_stages(
    stages: Stages, damping: float, stiffness: float, gain: Cube, shift: Matrix, virtual: Cube, work: Cube,
    value: Matrix, slope: Floats, dx: Matrix, du: Matrix,
) -> bool:  # fmt: skip
    """Fill `dx` (n + 1, nx) and `du` (n, m); false if a stage is not convex at this damping.

    `gain` (n, m, nx), `shift` (n, m), `virtual` (n, nx, nx + 1), `work` (7, s, s) with s > nx + m + 3, `value` (nx, nx)
    and `slope` (nx,) are memory.
    """
    a, b = stages.a, stages.b
    n, nx, m = b.shape
    va, vb, quu, qux, right = work[0], work[1], work[2], work[3], work[4]
    for i in range(nx):
        slope[i] = stages.q[n, i]
        for j in range(nx):
            value[i, j] = stages.q_matrix[n, i, j]
    for stage in range(n - 1, -1, -1):
        for i in range(nx):  # the virtual control is w = -(V + stiffness)^-1 (V y + v) for y = A dx + B du + c
            work[6, i, 0] = slope[i]
            for j in range(nx):
                va[i, j] = value[i, j] + (stiffness if i == j else 0.0)
                work[6, i, 1 + j] = value[i, j]
        if not _solve(va, nx, work[6], nx + 1):
            return False
        for i in range(nx):
            for j in range(nx + 1):
                virtual[stage, i, j] = work[6, i, j]
        for i in range(nx):
            total = slope[i]
            for k in range(nx):
                total -= value[i, k] * work[6, k, 0]
            work[5, 0, i] = total
            for j in range(nx):
                total = value[i, j]
                for k in range(nx):
                    total -= value[i, k] * work[6, k, 1 + j]
                work[4, i, j] = total
        for i in range(nx):
            slope[i] = work[5, 0, i]
            for j in range(nx):
                value[i, j] = 0.5 * (work[4, i, j] + work[4, j, i])
        for i in range(nx):
            total = slope[i]
            for j in range(nx):
                total += value[i, j] * stages.c[stage, j]
            work[5, 0, i] = total
        for i in range(nx):
            for j in range(nx):
                total = 0.0
                for k in range(nx):
                    total += value[i, k] * a[stage, k, j]
                va[i, j] = total
            for j in range(m):
                total = 0.0
                for k in range(nx):
                    total += value[i, k] * b[stage, k, j]
                vb[i, j] = total
        for i in range(m):
            total = stages.r[stage, i]
            for k in range(nx):
                total += b[stage, k, i] * work[5, 0, k]
            work[5, 1, i] = total
            for j in range(m):
                total = stages.r_matrix[stage, i, j]
                for k in range(nx):
                    total += b[stage, k, i] * vb[k, j]
                quu[i, j] = total
            quu[i, i] += damping
            for j in range(nx):
                total = 0.0
                for k in range(nx):
                    total += b[stage, k, i] * va[k, j]
                qux[i, j] = total
        for i in range(m):
            work[5, 2, i] = 0.0  # 1 if clamped
        for attempt in range(m + 1):
            for i in range(m):
                clamped = work[5, 2, i] > 0.0
                right[i, 0] = shift[stage, i] if clamped else -work[5, 1, i]
                for j in range(nx):
                    right[i, 1 + j] = 0.0 if clamped else -qux[i, j]
                for j in range(m):
                    other = work[5, 2, j] > 0.0
                    work[5, 3 + i, j] = quu[i, j]
                    if clamped or other:
                        work[5, 3 + i, j] = 1.0 if i == j else 0.0
                        if other and not clamped:
                            right[i, 0] -= quu[i, j] * shift[stage, j]
            if not _solve(work[5, 3:], m, right, nx + 1):
                return False
            again = False
            for i in range(m):
                if work[5, 2, i] == 0.0:
                    low, high = stages.low[stage, i], stages.high[stage, i]
                    shift[stage, i] = min(max(right[i, 0], low), high)
                    if right[i, 0] < low or right[i, 0] > high:
                        work[5, 2, i] = 1.0
                        again = True
            if not again:
                break
        for i in range(m):
            for j in range(nx):
                gain[stage, i, j] = 0.0 if work[5, 2, i] > 0.0 else right[i, 1 + j]
        # slope = q + A'v + K'(Quu k + Qu) + Qux'k;  value = Q + A'VA + K'Quu K + K'Qux + Qux'K
        for i in range(m):
            total = work[5, 1, i]
            for j in range(m):
                total += quu[i, j] * shift[stage, j]
            right[i, 0] = total
            for j in range(nx):
                total = qux[i, j]
                for k in range(m):
                    total += quu[i, k] * gain[stage, k, j]
                right[i, 1 + j] = total
        for i in range(nx):
            total = stages.q[stage, i]
            for k in range(nx):
                total += a[stage, k, i] * work[5, 0, k]
            for k in range(m):
                total += gain[stage, k, i] * right[k, 0] + qux[k, i] * shift[stage, k]
            slope[i] = total
        for i in range(nx):
            for j in range(nx):
                total = stages.q_matrix[stage, i, j]
                for k in range(nx):
                    total += a[stage, k, i] * va[k, j]
                for k in range(m):
                    total += gain[stage, k, i] * right[k, 1 + j] + qux[k, i] * gain[stage, k, j]
                value[i, j] = total
        for i in range(nx):
            for j in range(i):
                value[i, j] = value[j, i] = 0.5 * (value[i, j] + value[j, i])
    for i in range(nx):
        dx[0, i] = 0.0
    for stage in range(n):
        for i in range(m):
            total = shift[stage, i]
            for j in range(nx):
                total += gain[stage, i, j] * dx[stage, j]
            du[stage, i] = min(max(total, stages.low[stage, i]), stages.high[stage, i])
        for i in range(nx):
            total = stages.c[stage, i]
            for j in range(nx):
                total += a[stage, i, j] * dx[stage, j]
            for j in range(m):
                total += b[stage, i, j] * du[stage, j]
            slope[i] = total
        for i in range(nx):
            total = slope[i] - virtual[stage, i, 0]
            for j in range(nx):
                total -= virtual[stage, i, 1 + j] * slope[j]
            dx[stage + 1, i] = total
    return True


_types: Any = numba.types  # numba has no types
_VECTOR, _MATRIX, _CUBE = _types.float64[::1], _types.float64[:, ::1], _types.float64[:, :, ::1]
_STAGES = _types.NamedTuple([_CUBE, _CUBE, _MATRIX, _CUBE, _MATRIX, _CUBE, _MATRIX, _MATRIX, _MATRIX], Stages)
_MEMORY = (_CUBE, _MATRIX, _CUBE, _CUBE, _MATRIX, _VECTOR)
solve = compiled(
    _solve_stages,
    signature=_types.boolean(_STAGES, _types.float64, _types.float64, *_MEMORY, _MATRIX, _MATRIX),
)
