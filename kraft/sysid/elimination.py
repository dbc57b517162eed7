"""Eliminate each log's controls and states, in the order of time, onto the parameters they share.

The graph of a log is a chain: step i connects the states x_i and x_(i+1) with rho, and so do the poses observed in it.
Its normal equations are block tridiagonal with a border for rho.  Eliminating the control of a step adds its noise to
that of the dynamics; eliminating the states from first to last leaves one Gaussian factor on rho per log.  GTSAM does
the same with the ordering "controls, states, rho"; here it is done in compiled loops over preallocated arrays.  All
kernels are in this file, because the name of the folder of their machine code is a hash of it.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernel_cache import cache_folder, layers

TINY = 1e-12
"""Added to the information of each state, so that a component without information does not make it singular."""


class Graph(NamedTuple):
    """Shape of the chains, and residuals and derivatives at a point."""

    first: Ints  # (C + 1,) where chains begin
    log: Ints  # (C,)
    h: Floats  # (N,) durations of steps, s
    seen: Ints  # (N + 1,) where steps' poses begin
    share: Floats  # (n,)
    dynamics: Matrix  # (N, nx) residual x' - f(x, u, p)
    jacobian: Floats  # (N, nx, nx + nu + np) of f
    control: Matrix  # (N, nu) residual u - mean command
    command: Floats  # (N, nu, np) derivative of the mean command
    pose: Matrix  # (n, 3) residual predicted - observed
    pose_state: Floats  # (n, 3, nx) derivative by the interpolated state
    pose_rho: Floats  # (n, 3, np)
    weight: Floats  # (n,) of the robust loss
    pose_information: Floats  # (3,)
    process: Floats  # (nx,) variance per second
    control_variance: Floats  # (nu,)
    start: Floats  # (nx,) information on the first state of each chain, about where it is


class Eliminated(NamedTuple):
    """Result of the elimination: a factor on rho per log, and the intermediate values of the back substitution."""

    diagonal: Floats  # (S, nx, nx) information of each state, factorised in place
    solved: Floats  # (S, nx, nx + np + 1) coefficients of each state: of the next state, of rho, and the constant
    noise: Floats  # (N, nx, nx) information of the dynamics with the control's noise
    left: Matrix  # (N, nx) residual of the dynamics with the control at the command
    by_rho: Floats  # (N, nx, np) its derivative, negative
    information: Floats  # (logs, np, np)
    gradient: Matrix  # (logs, np)
    scratch: Floats  # (4, m, m)


def allocate(steps: int, states: int, logs: int, nx: int, np_: int) -> Eliminated:
    """Arrays for the elimination of chains with so many steps and states, of so many logs."""
    side = max(nx, np_) + nx + 1
    return Eliminated(
        diagonal=np.empty((states, nx, nx)),
        solved=np.empty((states, nx, nx + np_ + 1)),
        noise=np.empty((steps, nx, nx)),
        left=np.empty((steps, nx)),
        by_rho=np.empty((steps, nx, np_)),
        information=np.empty((logs, np_, np_)),
        gradient=np.empty((logs, np_)),
        scratch=np.empty((4, side, side)),
    )


@inlined
def factorise(a: Matrix, n: int) -> None:
    """Lower Cholesky factor of a (n, n) in place.

    A pivot that is not positive is what rounding left of the information of a component that no pose shows; its size
    says how much that may be.
    """
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        a[j, j] = math.sqrt(max(-a[j, j], TINY) if a[j, j] <= 0.0 else a[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]


@inlined
def solve(factor: Matrix, n: int, b: Matrix, columns: int) -> None:
    """Solve for `columns` of b in place, given the Cholesky factor."""
    for i in range(n):
        for k in range(i):
            for c in range(columns):
                b[i, c] -= factor[i, k] * b[k, c]
        for c in range(columns):
            b[i, c] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for c in range(columns):
                b[i, c] -= factor[k, i] * b[k, c]
        for c in range(columns):
            b[i, c] /= factor[i, i]


@inlined
def fold_control(i: int, g: Graph, out: Eliminated) -> None:
    """Eliminate the control of step i: fix it at the command, and add its noise to that of the dynamics."""
    nx, nu, own = g.dynamics.shape[1], g.control.shape[1], g.jacobian.shape[2]
    own -= nx + nu
    np_ = g.command.shape[2]
    covariance, information = out.scratch[0], out.noise[i]
    for a in range(nx):
        for b in range(nx):
            total = g.process[a] * g.h[i] if a == b else 0.0
            for k in range(nu):
                total += g.jacobian[i, a, nx + k] * g.control_variance[k] * g.jacobian[i, b, nx + k]
            covariance[a, b] = total
            information[a, b] = 1.0 if a == b else 0.0
    factorise(covariance, nx)
    solve(covariance, nx, information, nx)
    for a in range(nx):
        out.left[i, a] = g.dynamics[i, a]
        for k in range(nu):
            out.left[i, a] += g.jacobian[i, a, nx + k] * g.control[i, k]
        for r in range(np_):
            out.by_rho[i, a, r] = g.jacobian[i, a, nx + nu + r] if r < own else 0.0
            for k in range(nu):
                out.by_rho[i, a, r] += g.jacobian[i, a, nx + k] * g.command[i, k, r]


@inlined
def weigh(i: int, g: Graph, out: Eliminated) -> None:
    """Information times the derivatives by state (scratch 1), by rho, and the residual (scratch 2, last column)."""
    nx, np_ = out.left.shape[1], out.by_rho.shape[2]
    w, weighted_f, weighted_p = out.noise[i], out.scratch[1], out.scratch[2]
    for a in range(nx):
        for c in range(nx):
            weighted_f[a, c] = 0.0
        for r in range(np_ + 1):
            weighted_p[a, r] = 0.0
        for b in range(nx):
            for c in range(nx):
                weighted_f[a, c] += w[a, b] * g.jacobian[i, b, c]
            for r in range(np_):
                weighted_p[a, r] += w[a, b] * out.by_rho[i, b, r]
            weighted_p[a, np_] += w[a, b] * out.left[i, b]


@inlined
def add_dynamics(i: int, s: int, log: int, g: Graph, out: Eliminated) -> None:
    """Add step i, from state s to s + 1: columns -F, I, -P with F and P the derivatives by state and rho."""
    nx, np_ = out.left.shape[1], out.by_rho.shape[2]
    weigh(i, g, out)
    weighted_f, weighted_p, here, there = out.scratch[1], out.scratch[2], out.solved[s], out.solved[s + 1]
    for a in range(nx):
        for c in range(nx):
            out.diagonal[s + 1, a, c] += out.noise[i, a, c]
            here[a, c] -= weighted_f[c, a]  # -F^T W, W symmetric
        for r in range(np_):
            there[a, nx + r] -= weighted_p[a, r]
        there[a, nx + np_] += weighted_p[a, np_]
        for b in range(nx):
            f = g.jacobian[i, b, a]
            for c in range(nx):
                out.diagonal[s, a, c] += f * weighted_f[b, c]
            for r in range(np_):
                here[a, nx + r] += f * weighted_p[b, r]
            here[a, nx + np_] -= f * weighted_p[b, np_]
    for r in range(np_):
        for b in range(nx):
            out.gradient[log, r] -= out.by_rho[i, b, r] * weighted_p[b, np_]
            for q in range(r, np_):
                out.information[log, r, q] += out.by_rho[i, b, r] * weighted_p[b, q]


@inlined
def add_pose_to_states(j: int, row: int, s: int, g: Graph, out: Eliminated) -> None:
    """Add one row of pose j to states s and s + 1, between which it was seen."""
    nx, np_ = out.left.shape[1], out.by_rho.shape[2]
    there, here = g.share[j], 1.0 - g.share[j]
    for a in range(nx):
        slope = g.weight[j] * g.pose_information[row] * g.pose_state[j, row, a]
        if slope == 0.0:
            continue
        for c in range(nx):
            product = slope * g.pose_state[j, row, c]
            out.diagonal[s, a, c] += here * here * product
            out.solved[s, a, c] += here * there * product
            out.diagonal[s + 1, a, c] += there * there * product
        out.solved[s, a, nx + np_] += here * slope * g.pose[j, row]
        out.solved[s + 1, a, nx + np_] += there * slope * g.pose[j, row]


@inlined
def add_pose(j: int, s: int, log: int, g: Graph, out: Eliminated) -> None:
    """Add pose j, seen between states s and s + 1; it depends on few of the parameters."""
    nx, np_ = out.left.shape[1], out.by_rho.shape[2]
    there, here = g.share[j], 1.0 - g.share[j]
    for row in range(3):
        add_pose_to_states(j, row, s, g, out)
        weight = g.weight[j] * g.pose_information[row]
        for r in range(np_):
            by_rho = g.pose_rho[j, row, r]
            slope = weight * by_rho
            if slope == 0.0:
                continue
            for a in range(nx):
                product = weight * g.pose_state[j, row, a] * by_rho
                out.solved[s, a, nx + r] += here * product
                out.solved[s + 1, a, nx + r] += there * product
            out.gradient[log, r] += slope * g.pose[j, row]
            for q in range(r, np_):
                out.information[log, r, q] += slope * g.pose_rho[j, row, q]


@inlined
def eliminate_state(s: int, last: bool, log: int, damping: float, out: Eliminated) -> None:
    """Eliminate state s onto the next one (if there is one) and rho."""
    nx, np_ = out.left.shape[1], out.by_rho.shape[2]
    factor, solved, before = out.diagonal[s], out.solved[s], out.scratch[3]
    for a in range(nx):
        factor[a, a] += damping * factor[a, a] + TINY
        for c in range(nx + np_ + 1):
            before[a, c] = solved[a, c]
    factorise(factor, nx)
    solve(factor, nx, solved, nx + np_ + 1)
    if not last:
        for a in range(nx):
            for b in range(nx):
                for c in range(nx):
                    out.diagonal[s + 1, a, c] -= before[b, a] * solved[b, c]
                for c in range(nx, nx + np_ + 1):
                    out.solved[s + 1, a, c] -= before[b, a] * solved[b, c]
    for r in range(np_):
        for b in range(nx):
            out.gradient[log, r] -= before[b, nx + r] * solved[b, nx + np_]
            for q in range(r, np_):
                out.information[log, r, q] -= before[b, nx + r] * solved[b, nx + q]


def _eliminate(g: Graph, damping: float, out: Eliminated) -> None:
    out.diagonal[:] = 0.0
    out.solved[:] = 0.0
    out.information[:] = 0.0
    out.gradient[:] = 0.0
    for chain in range(len(g.log)):
        log = g.log[chain]
        for a in range(len(g.start)):
            out.diagonal[g.first[chain], a, a] += g.start[a]
        for s in range(g.first[chain], g.first[chain + 1] - 1):
            i = s - chain  # each chain before has one state more than steps
            fold_control(i, g, out)
            add_dynamics(i, s, log, g, out)
            for j in range(g.seen[i], g.seen[i + 1]):
                add_pose(j, s, log, g, out)
            eliminate_state(s, False, log, damping, out)
        eliminate_state(g.first[chain + 1] - 1, True, log, damping, out)
    for log in range(len(out.information)):  # steps and poses add to the upper triangle
        for r in range(out.information.shape[1]):
            for q in range(r):
                out.information[log, r, q] = out.information[log, q, r]


@inlined
def deviation(i: int, s: int, g: Graph, out: Eliminated, rho: Floats, states: Matrix, controls: Matrix) -> None:
    """Change of the deviation of step i's control: to zero, then what it takes to lead from state s to the next."""
    nx, nu = g.dynamics.shape[1], g.control.shape[1]
    for k in range(nu):
        controls[i, k] = -g.control[i, k]
    for a in range(nx):
        e = out.left[i, a] + states[s + 1, a]
        for b in range(nx):
            e -= g.jacobian[i, a, b] * states[s, b]
        for r in range(len(rho)):
            e -= out.by_rho[i, a, r] * rho[r]
        for b in range(nx):
            for k in range(nu):
                controls[i, k] += g.control_variance[k] * g.jacobian[i, b, nx + k] * out.noise[i, b, a] * e


def _back_substitute(g: Graph, out: Eliminated, rho: Floats, states: Matrix, controls: Matrix) -> None:
    nx, np_ = g.dynamics.shape[1], len(rho)
    for chain in range(len(g.log)):
        last = g.first[chain + 1] - 1
        for s in range(last, g.first[chain] - 1, -1):
            for a in range(nx):
                total = out.solved[s, a, nx + np_]
                for r in range(np_):
                    total += out.solved[s, a, nx + r] * rho[r]
                if s < last:
                    for b in range(nx):
                        total += out.solved[s, a, b] * states[s + 1, b]
                states[s, a] = -total
        for s in range(g.first[chain], last):
            deviation(s - chain, s, g, out, rho, states, controls)


def is_cached() -> bool:
    """Whether the machine code of both kernels is cached on this machine."""
    names = "_eliminate", "_back_substitute"
    return all(any(any(layer.rglob(f"*.{name}-*.nbi")) for layer in layers(_FOLDER)) for name in names)


_FOLDER = cache_folder(f"sysid-{hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]}")

eliminate = compiled(_eliminate, folder=_FOLDER)
"""eliminate(graph, damping, out): fill `out`; the information of each state is raised by the share `damping`."""

back_substitute = compiled(_back_substitute, folder=_FOLDER)
"""back_substitute(graph, out, rho, states, controls): write the changes of the states (S, nx) and of the deviations of
controls from commands (N, nu) that follow from a change of rho (np,) to the last two arguments."""
