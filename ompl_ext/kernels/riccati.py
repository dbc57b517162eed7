"""Backward and forward pass of a linear-quadratic problem with bounded controls, for `gauss_newton`.

Minimises the sum over the stages of 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du + 1/2 stiffness w'w and of
1/2 weight (jump + du - du of the stage before)^2 for each control but the last, the duration, with
dx+ = A dx + B du + c + w and low <= du <= high.  The controls of the stage before are part of the state, so that the
costs of their changes are exact.  The virtual controls w let a trajectory deviate from the model; a rising stiffness
leads to one that obeys it (Mao et al., Successive convexification of non-convex optimal control problems, 2016).
Bounds are treated as in box-DDP (Tassa et al., Control-limited differential dynamic programming, 2014).

`specialise` executes this module once per layout of the state, so that all sizes are constants: that is four times
faster.
"""

from __future__ import annotations

from numba import types

from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.cholesky import factorise, solve_factorised
from ompl_ext.kernels.specialise import layout_being_compiled, layout_cache_folder
from ompl_ext.kernels.trajectory_types import BACKWARD, STAGES, Backward, Stages

LAYOUT = layout_being_compiled()
NX, NU = LAYOUT.components, LAYOUT.controls
M = NU + 1  # controls and the duration
NS = NX + NU  # state and the controls of the stage before
LEAST_PIVOT = 1e-12


@inlined
def _soften(work: Backward, stage: int, stiffness: float) -> bool:
    """Costs from the next stage on after the best virtual control -(V11 + stiffness)^-1 (V1 y + v1)."""
    value, slope, factor, right = work.value, work.slope, work.factor, work.right
    for i in range(NX):
        right[i, 0] = slope[i]
        for j in range(NX):
            factor[i, j] = value[i, j]
        factor[i, i] += stiffness
        for j in range(NS):
            right[i, 1 + j] = value[i, j]
    if not factorise(factor, NX, LEAST_PIVOT):
        return False
    solve_factorised(factor, NX, right, NS + 1)
    for i in range(NX):
        for j in range(NS + 1):
            work.virtual[stage, i, j] = right[i, j]
    for i in range(NS):
        for j in range(NS):
            work.copy[i, j] = value[i, j]
    for i in range(NS):
        for k in range(NX):
            slope[i] -= work.copy[k, i] * right[k, 0]
            for j in range(NS):
                value[i, j] -= work.copy[k, i] * right[k, 1 + j]
    return True


@inlined
def _multiply(stages: Stages, work: Backward, stage: int) -> None:
    """Products of the value with A and B; `slope` becomes v + V c."""
    a, b, c, value, slope = stages.a[stage], stages.b[stage], stages.c[stage], work.value, work.slope
    for i in range(NS):
        for k in range(NX):
            slope[i] += value[i, k] * c[k]
        for j in range(NX):
            total = 0.0
            for k in range(NX):
                total += value[i, k] * a[k, j]
            work.va[i, j] = total
        for j in range(M):
            total = value[i, NX + j] if j < NU else 0.0
            for k in range(NX):
                total += value[i, k] * b[k, j]
            work.vb[i, j] = total


@inlined
def _expand(stages: Stages, work: Backward, stage: int, damping: float) -> None:
    """Quadratic model in the controls of a stage."""
    b, slope = stages.b[stage], work.slope
    for i in range(M):
        total = stages.r[stage, i]
        for k in range(NX):
            total += b[k, i] * slope[k]
        work.qu[i] = total
        for j in range(M):
            total = 0.0
            for k in range(NX):
                total += b[k, i] * work.vb[k, j]
            work.quu[i, j] = total
        for j in range(NS):
            total = 0.0
            if j < NX:
                for k in range(NX):
                    total += b[k, i] * work.va[k, j]
            work.qux[i, j] = total
        work.quu[i, i] += stages.r_diagonal[stage, i] + damping * stages.scale[i]


@inlined
def _add_jumps(stages: Stages, work: Backward, stage: int) -> None:
    """Add what the next stage and the changes of the controls contribute to the quadratic model in the controls."""
    for i in range(NU):
        weight = stages.jump_weight[stage, i]
        work.qu[i] += work.slope[NX + i] + weight * stages.jump[stage, i]
        work.quu[i, i] += weight
        work.qux[i, NX + i] -= weight
        for j in range(M):
            work.quu[i, j] += work.vb[NX + i, j]
        for j in range(NX):
            work.qux[i, j] += work.va[NX + i, j]


@inlined
def _fill_equations(stages: Stages, work: Backward, stage: int) -> None:
    """Equations for the shift (column 0) and the gain of the controls that are not clamped."""
    for i in range(M):
        clamped = work.clamped[i] > 0.0
        work.right[i, 0] = work.shift[stage, i] if clamped else -work.qu[i]
        for j in range(NS):
            work.right[i, 1 + j] = 0.0 if clamped else -work.qux[i, j]
        for j in range(M):
            work.factor[i, j] = work.quu[i, j]
            if clamped or work.clamped[j] > 0.0:
                work.factor[i, j] = 1.0 if i == j else 0.0
                if not clamped:
                    work.right[i, 0] -= work.quu[i, j] * work.shift[stage, j]


@inlined
def _choose_controls(stages: Stages, work: Backward, stage: int) -> bool:
    """Shift and gain of a stage; controls that leave their bounds are clamped, one round after the other."""
    for i in range(M):
        work.clamped[i] = 0.0
    left = True
    while left:
        left = False
        _fill_equations(stages, work, stage)
        if not factorise(work.factor, M, LEAST_PIVOT):
            return False
        solve_factorised(work.factor, M, work.right, NS + 1)
        for i in range(M):
            if work.clamped[i] == 0.0:
                low, high, wanted = stages.low[stage, i], stages.high[stage, i], work.right[i, 0]
                work.shift[stage, i] = min(max(wanted, low), high)
                if not low <= wanted <= high:
                    work.clamped[i] = 1.0
                    left = True
    for i in range(M):
        for j in range(NS):
            work.gain[stage, i, j] = 0.0 if work.clamped[i] > 0.0 else work.right[i, 1 + j]
    return True


@inlined
def _update_slope(stages: Stages, work: Backward, stage: int) -> None:
    """Linear part of the costs from a stage on: v = q + A'v + K'(Quu k + Qu) + Qux'k.

    `right` receives Quu [k K] + [Qu Qux].
    """
    a, gain, shift, right, slope = stages.a[stage], work.gain[stage], work.shift[stage], work.right, work.slope
    for i in range(M):
        right[i, 0] = work.qu[i]
        for j in range(NS):
            right[i, 1 + j] = work.qux[i, j]
        for k in range(M):
            right[i, 0] += work.quu[i, k] * shift[k]
            for j in range(NS):
                right[i, 1 + j] += work.quu[i, k] * gain[k, j]
    for i in range(NS):
        total = 0.0
        for k in range(NX):
            total += a[k, i] * slope[k] if i < NX else 0.0
        for k in range(M):
            total += work.qux[k, i] * shift[k] + gain[k, i] * right[k, 0]
        work.copy[0, i] = total
    for i in range(NX):
        slope[i] = work.copy[0, i] + stages.q[stage, i]
    for i in range(NU):
        slope[NX + i] = work.copy[0, NX + i] - stages.jump_weight[stage, i] * stages.jump[stage, i]


@inlined
def _update_value(stages: Stages, work: Backward, stage: int, damping: float) -> None:
    """Quadratic part of the costs from a stage on: V = Q + A'VA + K'(Quu K + Qux) + Qux'K, of which `right` has one."""
    a, gain, right, value = stages.a[stage], work.gain[stage], work.right, work.value
    for i in range(NS):
        for j in range(i + 1):
            total = 0.0
            for k in range(M):
                total += work.qux[k, i] * gain[k, j] + gain[k, i] * right[k, 1 + j]
            value[i, j] = total
    for i in range(NX):
        for j in range(i + 1):
            total = stages.q_matrix[stage, i, j]
            for k in range(NX):
                total += a[k, i] * work.va[k, j]
            value[i, j] += total
        value[i, i] += stages.scale[M] * damping
    for i in range(NU):
        value[NX + i, NX + i] += stages.jump_weight[stage, i]
    for i in range(NS):
        for j in range(i):
            value[j, i] = value[i, j]


@inlined
def _roll_out(stages: Stages, n: int, work: Backward) -> None:
    """Forward pass: `dx` and `du`."""
    dx, du, y = work.dx, work.du, work.slope
    for i in range(NX):
        dx[0, i] = 0.0
    for stage in range(n):
        for i in range(M):
            total = work.shift[stage, i]
            for j in range(NX):
                total += work.gain[stage, i, j] * dx[stage, j]
            if stage > 0:
                for j in range(NU):
                    total += work.gain[stage, i, NX + j] * du[stage - 1, j]
            du[stage, i] = min(max(total, stages.low[stage, i]), stages.high[stage, i])
        for i in range(NX):
            total = stages.c[stage, i]
            for j in range(NX):
                total += stages.a[stage, i, j] * dx[stage, j]
            for j in range(M):
                total += stages.b[stage, i, j] * du[stage, j]
            y[i] = total
        for i in range(NU):
            y[NX + i] = du[stage, i]
        for i in range(NX):
            total = y[i] - work.virtual[stage, i, 0]
            for j in range(NS):
                total -= work.virtual[stage, i, 1 + j] * y[j]
            dx[stage + 1, i] = total


def _solve(stages: Stages, n: int, damping: float, stiffness: float, work: Backward) -> bool:
    """Solve `n` stages for `dx` and `du` of the memory; false if a stage is not convex at this damping."""
    for i in range(NS):
        work.slope[i] = stages.q[n, i] if i < NX else 0.0
        for j in range(NS):
            work.value[i, j] = stages.q_matrix[n, i, j] if i < NX and j < NX else 0.0
    for i in range(NX):
        work.value[i, i] += stages.scale[M] * damping
    for stage in range(n - 1, -1, -1):
        if not _soften(work, stage, stiffness):
            return False
        _multiply(stages, work, stage)
        _expand(stages, work, stage, damping)
        _add_jumps(stages, work, stage)
        if not _choose_controls(stages, work, stage):
            return False
        _update_slope(stages, work, stage)
        _update_value(stages, work, stage, damping)
    _roll_out(stages, n, work)
    return True


solve = compiled(
    _solve,
    folder=layout_cache_folder(LAYOUT),
    signature=types.boolean(STAGES, types.int64, types.float64, types.float64, BACKWARD),
)
