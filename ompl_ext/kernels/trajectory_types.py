"""Arrays of the local optimisation of a trajectory, which the kernels `riccati` and `gauss_newton` share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.kernels.kernel_types import numba_type


class Stages(NamedTuple):
    """Linear-quadratic problem of n stages, nx states and m controls, of which the last one is the duration."""

    a: Cube  # (n, nx, nx)
    b: Cube  # (n, nx, m)
    c: Matrix  # (n, nx)
    q_matrix: Cube  # (n + 1, nx, nx)
    q: Matrix  # (n + 1, nx)
    r_diagonal: Matrix  # (n, m)
    r: Matrix  # (n, m)
    jump: Matrix  # (n, m - 1) difference of the controls from those of the stage before
    jump_weight: Matrix  # (n, m - 1)
    low: Matrix  # (n, m)
    high: Matrix  # (n, m)
    scale: Floats  # (m + 1,) what the damping of each control, and of the states, is multiplied by


class Backward(NamedTuple):
    """Working memory of a solution, and the result in `dx` (n + 1, nx) and `du` (n, m); ns = nx + m - 1."""

    dx: Matrix
    du: Matrix
    gain: Cube  # (n, m, ns): du = shift + gain (dx, du of the stage before)
    shift: Matrix  # (n, m)
    virtual: Cube  # (n, nx, ns + 1): w = -(first column + the others (A dx + B du + c, du))
    value: Matrix  # (ns, ns) and `slope` (ns,): quadratic and linear part of the costs from a stage on
    slope: Floats
    copy: Matrix  # (ns, ns)
    va: Matrix  # (ns, nx) product of value and A
    vb: Matrix  # (ns, m) product of value and B
    quu: Matrix  # (m, m), qux (m, ns), qu (m,): quadratic model in the controls
    qux: Matrix
    qu: Floats
    factor: Matrix  # (s, s) and `right` (s, ns + 1) with s the larger one of nx and m: linear equations
    right: Matrix
    clamped: Floats  # (m,) 1 where a control is on its bound


class Shooting(NamedTuple):
    """Trajectory of up to n intervals: a state at each end and, in each, constant controls and a duration (s).

    `tried` are those of a step that may be refused.
    """

    states: Matrix  # (n + 1, nx)
    inputs: Matrix  # (n, m)
    tried_states: Matrix
    tried_inputs: Matrix
    after: Matrix  # (n, nx) state that the model predicts after each interval
    margin: Floats  # (n + 1,) clearance that the optimiser aims for (m)
    block: Floats  # lanes of the integration
    gradient: Floats  # (nx,)


# Indices of the setting of an optimisation
STIFFNESS, PENALTY = 0, 1  # of the model (1/SI^2, s) and of what is violated (1/m^2, s)
URGENCY, SMOOTHNESS, SMOOTHNESS_COST, EVENNESS = 2, 3, 4, 5  # weights of time, of changes of controls and of durations
EVEN, SHORTEST, LONGEST = 6, 7, 8  # mean, shortest and longest duration of an interval (s); fixed if equal
GOAL_DISTANCE, GOAL_HEADING, GOAL_TURN, GOAL_SHARE = 9, 10, 11, 12  # region that is aimed for (m, rad)
BEGIN = 13  # time of the first state since the start of the query (s)
SMALL_CHANGE = 14  # of a control, as a share of its range, beyond which a change counts in proportion
SETTINGS = 15
UNSAFE = 1_000_000  # in the number of edges that fail: SAFETY fails, too


SHOOTING, STAGES, BACKWARD = (numba_type(each) for each in (Shooting, Stages, Backward))


def stages(n: int, nx: int, m: int) -> Stages:
    """Memory for a problem of n stages."""
    return Stages(
        np.zeros((n, nx, nx)), np.zeros((n, nx, m)), np.zeros((n, nx)), np.zeros((n + 1, nx, nx)),
        np.zeros((n + 1, nx)), np.zeros((n, m)), np.zeros((n, m)), np.zeros((n, m - 1)), np.zeros((n, m - 1)),
        np.zeros((n, m)), np.zeros((n, m)), np.ones(m + 1),
    )  # fmt: skip


def backward(n: int, nx: int, m: int) -> Backward:
    """Working memory for a problem of n stages."""
    s, ns = max(nx, m), nx + m - 1
    return Backward(
        np.zeros((n + 1, nx)), np.zeros((n, m)), np.zeros((n, m, ns)), np.zeros((n, m)), np.zeros((n, nx, ns + 1)),
        np.zeros((ns, ns)), np.zeros(ns), np.zeros((ns, ns)), np.zeros((ns, nx)), np.zeros((ns, m)), np.zeros((m, m)),
        np.zeros((m, ns)), np.zeros(m), np.zeros((s, s)), np.zeros((s, ns + 1)), np.zeros(m),
    )  # fmt: skip


def shooting(n: int, nx: int, m: int, block: int) -> Shooting:
    """Memory for a trajectory of n intervals."""
    return Shooting(
        np.zeros((n + 1, nx)), np.zeros((n, m)), np.zeros((n + 1, nx)), np.zeros((n, m)), np.zeros((n, nx)),
        np.zeros(n + 1), np.zeros(block), np.zeros(nx),
    )  # fmt: skip
