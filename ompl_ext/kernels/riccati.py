"""Backward and forward pass of a linear-quadratic problem with bounded controls, for `ompl_ext.polish`.

Minimises the sum of 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du + 1/2 stiffness w'w over the stages, with
dx+ = A dx + B du + c + w and low <= du <= high.  The virtual controls w let a trajectory deviate from the model; a
rising stiffness leads to one that obeys it (Mao et al., Successive convexification of non-convex optimal control
problems, 2016).  Bounds are treated as in box-DDP (Tassa et al., Control-limited differential dynamic
programming, 2014).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.jit import compiled, inlined, part


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


class Memory(NamedTuple):
    """Working memory, and the result in `dx` (n + 1, nx) and `du` (n, m)."""

    dx: Matrix
    du: Matrix
    gain: Cube  # (n, m, nx): du = shift + gain dx
    shift: Matrix  # (n, m)
    virtual: Cube  # (n, nx, nx + 1): w = -(first column + the others (A dx + B du + c))
    value: Matrix  # (nx, nx) and `slope` (nx, 1): quadratic and linear part of the costs from a stage on
    slope: Matrix
    va: Matrix  # (nx, nx) product of value and A
    vb: Matrix  # (nx, m) product of value and B
    quu: Matrix  # (m, m), qux (m, nx), qu (m, 1): quadratic model in the controls
    qux: Matrix
    qu: Matrix
    factor: Matrix  # (s, s) and `right` (s, s) with s > nx, m: linear equations
    right: Matrix
    clamped: Floats  # (m,) 1 where a control is on its bound


def compile_solver() -> None:
    """Compile `solve`, or load it from the cache."""
    n, nx, m = 1, 1, 1
    empty = Stages(
        a=np.zeros((n, nx, nx)),
        b=np.zeros((n, nx, m)),
        c=np.zeros((n, nx)),
        q_matrix=np.zeros((n + 1, nx, nx)),
        q=np.zeros((n + 1, nx)),
        r_matrix=np.zeros((n, m, m)),
        r=np.zeros((n, m)),
        low=np.zeros((n, m)),
        high=np.zeros((n, m)),
    )
    solve(empty, 1.0, 1.0, memory(n, nx, m))


def memory(n: int, nx: int, m: int) -> Memory:
    """Memory for problems of one size."""
    s = max(nx, m) + 1
    return Memory(
        dx=np.zeros((n + 1, nx)),
        du=np.zeros((n, m)),
        gain=np.zeros((n, m, nx)),
        shift=np.zeros((n, m)),
        virtual=np.zeros((n, nx, nx + 1)),
        value=np.zeros((nx, nx)),
        slope=np.zeros((nx, 1)),
        va=np.zeros((nx, nx)),
        vb=np.zeros((nx, m)),
        quu=np.zeros((m, m)),
        qux=np.zeros((m, nx)),
        qu=np.zeros((m, 1)),
        factor=np.zeros((s, s)),
        right=np.zeros((s, s)),
        clamped=np.zeros(m),
    )


@inlined
def _set_product(out: Matrix, a: Matrix, b: Matrix, rows: int, inner: int, columns: int) -> None:
    """Set `out` to a b."""
    for i in range(rows):
        for j in range(columns):
            total = 0.0
            for k in range(inner):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@inlined
def _add_transposed(out: Matrix, a: Matrix, b: Matrix, rows: int, inner: int, columns: int) -> None:
    """Add a' b to `out`."""
    for i in range(rows):
        for j in range(columns):
            total = 0.0
            for k in range(inner):
                total += a[k, i] * b[k, j]
            out[i, j] += total


@part
def _factorise(matrix: Matrix, size: int) -> bool:
    """Cholesky's decomposition in place; false if the matrix is not positive definite."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j and total <= TINY:
                return False
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
    return True


@part
def _solve_factorised(matrix: Matrix, size: int, right: Matrix, columns: int) -> None:
    """Solve in place for several right-hand sides."""
    for column in range(columns):
        for i in range(size):
            for k in range(i):
                right[i, column] -= matrix[i, k] * right[k, column]
            right[i, column] /= matrix[i, i]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                right[i, column] -= matrix[k, i] * right[k, column]
            right[i, column] /= matrix[i, i]


TINY = 1e-12


@part
def _soften(work: Memory, stage: int, stiffness: float) -> bool:
    """Costs from the next stage on after the best virtual control -(V + stiffness)^-1 (V y + v), y = Adx + Bdu + c."""
    nx = len(work.value)
    value, slope, factor, right = work.value, work.slope, work.factor, work.right
    for i in range(nx):
        right[i, 0] = slope[i, 0]
        for j in range(nx):
            factor[i, j] = value[i, j] + (stiffness if i == j else 0.0)
            right[i, 1 + j] = value[i, j]
    if not _factorise(factor, nx):
        return False
    _solve_factorised(factor, nx, right, nx + 1)
    for i in range(nx):
        for j in range(nx + 1):
            work.virtual[stage, i, j] = right[i, j]
            factor[i, j] = 0.0
    _add_transposed(factor, value, right, nx, nx, nx + 1)
    for i in range(nx):
        slope[i, 0] -= factor[i, 0]
        for j in range(nx):
            value[i, j] -= 0.5 * (factor[i, 1 + j] + factor[j, 1 + i])
    return True


@part
def _expand(stages: Stages, work: Memory, stage: int, damping: float) -> None:
    """Quadratic model in the controls of a stage; `slope` becomes v + V c."""
    a, b = stages.a[stage], stages.b[stage]
    nx, m = b.shape
    for i in range(nx):
        work.right[i, 0] = stages.c[stage, i]
    _set_product(work.va, work.value, work.right, nx, nx, 1)
    for i in range(nx):
        work.slope[i, 0] += work.va[i, 0]
    _set_product(work.va, work.value, a, nx, nx, nx)
    _set_product(work.vb, work.value, b, nx, nx, m)
    for i in range(m):
        work.qu[i, 0] = stages.r[stage, i]
        for j in range(m):
            work.quu[i, j] = stages.r_matrix[stage, i, j] + (damping if i == j else 0.0)
        for j in range(nx):
            work.qux[i, j] = 0.0
    _add_transposed(work.qu, b, work.slope, m, nx, 1)
    _add_transposed(work.quu, b, work.vb, m, nx, m)
    _add_transposed(work.qux, b, work.va, m, nx, nx)


@part
def _fill_equations(stages: Stages, work: Memory, stage: int) -> None:
    """Equations for the shift (column 0) and the gain of the controls that are not clamped."""
    nx, m = len(work.value), len(work.quu)
    for i in range(m):
        clamped = work.clamped[i] > 0.0
        work.right[i, 0] = work.shift[stage, i] if clamped else -work.qu[i, 0]
        for j in range(nx):
            work.right[i, 1 + j] = 0.0 if clamped else -work.qux[i, j]
        for j in range(m):
            work.factor[i, j] = work.quu[i, j]
            if clamped or work.clamped[j] > 0.0:
                work.factor[i, j] = 1.0 if i == j else 0.0
                if not clamped:
                    work.right[i, 0] -= work.quu[i, j] * work.shift[stage, j]


@part
def _choose_controls(stages: Stages, work: Memory, stage: int) -> bool:
    """Shift and gain of a stage; controls that leave their bounds are clamped, one round after the other."""
    nx, m = len(work.value), len(work.quu)
    for i in range(m):
        work.clamped[i] = 0.0
    left = True
    while left:
        left = False
        _fill_equations(stages, work, stage)
        if not _factorise(work.factor, m):
            return False
        _solve_factorised(work.factor, m, work.right, nx + 1)
        for i in range(m):
            if work.clamped[i] == 0.0:
                low, high, wanted = stages.low[stage, i], stages.high[stage, i], work.right[i, 0]
                work.shift[stage, i] = min(max(wanted, low), high)
                if not low <= wanted <= high:
                    work.clamped[i] = 1.0
                    left = True
    for i in range(m):
        for j in range(nx):
            work.gain[stage, i, j] = 0.0 if work.clamped[i] > 0.0 else work.right[i, 1 + j]
    return True


@part
def _update_costs(stages: Stages, work: Memory, stage: int) -> None:
    """Costs from a stage on: v = q + A'v + K'(Quu k + Qu) + Qux'k, V = Q + A'VA + K'(Quu K + Qux) + Qux'K."""
    nx, m = len(work.value), len(work.quu)
    gain, right = work.gain[stage], work.right
    for i in range(m):
        right[i, 0] = work.qu[i, 0]
        for k in range(m):
            right[i, 0] += work.quu[i, k] * work.shift[stage, k]
        for j in range(nx):
            right[i, 1 + j] = work.qux[i, j]
            for k in range(m):
                right[i, 1 + j] += work.quu[i, k] * gain[k, j]
    for i in range(nx):
        for j in range(nx):
            work.value[i, j] = stages.q_matrix[stage, i, j]
            work.factor[i, 1 + j] = 0.0
        work.factor[i, 0] = stages.q[stage, i]
        for k in range(nx):
            work.factor[i, 0] += stages.a[stage, k, i] * work.slope[k, 0]
        for k in range(m):
            work.factor[i, 0] += work.qux[k, i] * work.shift[stage, k]
    _add_transposed(work.value, stages.a[stage], work.va, nx, nx, nx)
    _add_transposed(work.value, work.qux, gain, nx, m, nx)
    _add_transposed(work.factor, gain, right, nx, m, nx + 1)
    for i in range(nx):
        work.slope[i, 0] = work.factor[i, 0]
        for j in range(nx):
            work.value[i, j] += work.factor[i, 1 + j]
    for i in range(nx):
        for j in range(i):
            work.value[i, j] = work.value[j, i] = 0.5 * (work.value[i, j] + work.value[j, i])


@part
def _roll_out(stages: Stages, work: Memory) -> None:
    """Forward pass: `dx` and `du`."""
    n, nx, m = stages.b.shape
    dx, du, y = work.dx, work.du, work.slope
    for i in range(nx):
        dx[0, i] = 0.0
    for stage in range(n):
        for i in range(m):
            total = work.shift[stage, i]
            for j in range(nx):
                total += work.gain[stage, i, j] * dx[stage, j]
            du[stage, i] = min(max(total, stages.low[stage, i]), stages.high[stage, i])
        for i in range(nx):
            y[i, 0] = stages.c[stage, i]
            for j in range(nx):
                y[i, 0] += stages.a[stage, i, j] * dx[stage, j]
            for j in range(m):
                y[i, 0] += stages.b[stage, i, j] * du[stage, j]
        for i in range(nx):
            total = y[i, 0] - work.virtual[stage, i, 0]
            for j in range(nx):
                total -= work.virtual[stage, i, 1 + j] * y[j, 0]
            dx[stage + 1, i] = total


@compiled
def solve(stages: Stages, damping: float, stiffness: float, work: Memory) -> bool:
    """Solve for `dx` and `du` of the memory; false if a stage is not convex at this damping of the controls."""
    n, nx, _ = stages.b.shape
    for i in range(nx):
        work.slope[i, 0] = stages.q[n, i]
        for j in range(nx):
            work.value[i, j] = stages.q_matrix[n, i, j]
    for stage in range(n - 1, -1, -1):
        if not _soften(work, stage, stiffness):
            return False
        _expand(stages, work, stage, damping)
        if not _choose_controls(stages, work, stage):
            return False
        _update_costs(stages, work, stage)
    _roll_out(stages, work)
    return True
