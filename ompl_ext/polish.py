"""Local optimisation of a plan: controls and durations of short intervals, by Gauss-Newton with multiple shooting.

States, controls and durations are improved together, so that the first guess need not obey the model (Giftthaler et
al., A family of iterative Gauss-Newton shooting methods for nonlinear optimal control, 2018).  The time is minimised;
clearance, limits of the state and the goal region are penalised where they are violated; controls and durations have
bounds.  What comes out is a guess as well: the tree adds it like edges of an earlier plan, with all of its checks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Cube, Floats, Ints, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Problem
from ompl_ext.kernels.penetration import fill_penetration
from ompl_ext.kernels.posetogo import PosePath
from ompl_ext.kernels.riccati import Stages, compile_solver, memory, solve
from ompl_ext.kernels.specialise import step_kernels
from ompl_ext.motion import motion_of
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Goal, Safety, Settings, pose_cost_to_go_of, settings_for
from ompl_ext.vehicle import Vehicle

SHORTEST, LONGEST, INTERVAL = 0.02, 0.2, 0.1  # of an interval, and of those of a first guess (s)
CAREFULLY = 1.2  # factor of the durations of a first guess over those at constant speed
SUBSTEPS = 4  # of the integration of an interval
CHANGE = 1e-5  # of numerical derivatives
PENALTY, LAST_PENALTY = 1e4, 3e5  # stiffness of the penalties (1/m^2, s): that of the model between these bounds
SOFT, HARD, HARDENING = 30.0, 1e7, 6.0  # first and last stiffness of the model, and the factor between rounds
SMOOTHNESS = 2e-3  # s for a control that differs by its range from those before and after it
EVENNESS = 1.0  # 1/s for a duration that differs from those before and after it
WITHIN_LIMITS = 1e-3  # share of a component's range, at most of 1, by which it is to stay within its limits
INSIDE = 0.6  # share of the goal's tolerances that is aimed for
CONVERGED = 1e-3  # share of the time that an iteration must save
MAX_ITERATIONS, LAST_ITERATIONS = 8, 30  # of a round, of the last one
TRUST = 3.0  # damping of the states over that of the controls


@dataclass(frozen=True)
class Guess:
    """Trajectory of n intervals: `states` (n + 1, nx), `controls` (n, nu), `durations` (n,) s."""

    states: Matrix
    controls: Matrix
    durations: Floats

    @property
    def time(self) -> float:
        """Duration of all intervals (s)."""
        return float(self.durations.sum())


class Near(NamedTuple):
    """Discs that lack clearance (k,): state, number, lack (m), and slope of the field there along x and y."""

    state: Ints
    disc: Ints
    lack: Floats
    slope_x: Floats
    slope_y: Floats


class Polish:
    """Local optimisation for a problem of the planner; it keeps its memory between trajectories."""

    def __init__(self, vehicle: Vehicle, problem: Problem, goal: Goal, safety: Safety) -> None:
        self._vehicle, self._problem, self.goal, self.safety = vehicle, problem, goal, safety
        self._kernels, self._signed = step_kernels(vehicle), np.empty_like(problem.field)
        fill_penetration(problem.field, 1.0 / problem.scalar[at.GRID_INVERSE], self._signed)
        compile_solver()
        self._pose = [vehicle.index(name) for name in ("x", "y", "theta")]
        self._bounds = np.vstack([vehicle.control_bounds, (SHORTEST, LONGEST)])
        self._block = np.zeros(self._kernels.block)
        limits = problem.limits
        self.iterations, self.urgency = 0, 1.0
        self._limited = np.flatnonzero(np.isfinite(limits).any(axis=1))

    def improve(self, guess: Guess, margin: float, stiffness: float = SOFT) -> Guess:
        """Trajectory that obeys the model and takes less time, as far as was found; its poses aim for `margin` m.

        The model is at first as soft as `stiffness`, so that a guess far from it can become one that obeys it.
        """
        current, damping = guess, 1e-3
        while True:
            current, damping = self._round(current, margin, stiffness, damping)
            if stiffness >= HARD:
                return current
            stiffness *= HARDENING

    def _round(self, current: Guess, margin: float, stiffness: float, damping: float) -> tuple[Guess, float]:
        """Iterations at one stiffness of the model; also the damping that was found good."""
        n, nx, m = len(current.durations), len(self._vehicle.state), len(self._bounds)
        work = memory(n, nx, m)
        near = self._clearance(current, margin)
        merit, self.terms = self._merit(current, near, stiffness)
        stages = self._stages(current, near, _penalty(stiffness))
        for _ in range(MAX_ITERATIONS if stiffness < HARD else LAST_ITERATIONS):
            self.iterations += 1
            damped = stages._replace(q_matrix=stages.q_matrix + TRUST * damping * np.eye(nx))
            if not solve(damped, damping, stiffness, work):
                damping *= 10.0
                continue
            inputs = np.clip(np.column_stack([current.controls, current.durations]) + work.du, *self._bounds.T)
            tried = Guess(current.states + work.dx, inputs[:, :-1], inputs[:, -1])
            near = self._clearance(tried, margin)
            found, terms = self._merit(tried, near, stiffness)
            if found >= merit:
                damping *= 10.0
                continue
            saved, merit, self.terms, current = merit - found, found, terms, tried
            damping = max(0.2 * damping, 1e-6)
            if saved < CONVERGED * merit:
                break
            stages = self._stages(current, near, _penalty(stiffness))
        return current, min(damping, 1e3)

    def _step(self, guess: Guess, derivatives: bool) -> tuple[Matrix, Cube, Cube]:
        """States (n, nx) after each interval, and their derivatives by the state and by control and duration."""
        n, nx, nu = len(guess.durations), len(self._vehicle.state), len(self._vehicle.controls)
        parameters = self._problem.parameters
        count = nx + nu + len(parameters) + 1 if derivatives else 0
        states, controls = np.ascontiguousarray(guess.states[:-1]), np.ascontiguousarray(guess.controls)
        step, change = np.ascontiguousarray(guess.durations / SUBSTEPS), np.full(count, CHANGE)
        by_state, by_input = np.tile(np.eye(nx), (n, 1, 1)), np.zeros((n, nx, nu + 1))
        for _ in range(SUBSTEPS):
            after, jacobian = np.empty((n, nx)), np.zeros((n, nx, count))
            self._kernels.linearise(states, controls, parameters, step, change, self._block, after, jacobian)
            if derivatives:
                a, b = jacobian[:, :, :nx], jacobian[:, :, [*range(nx, nx + nu), count - 1]]
                b[:, :, -1] /= SUBSTEPS
                by_state, by_input = a @ by_state, a @ by_input + b
            states = after
        return states, by_state, by_input

    def _merit(self, guess: Guess, near: Near, stiffness: float) -> tuple[float, tuple[float, ...]]:
        after, _, _ = self._step(guess, False)
        defect = float(((after - guess.states[1:]) ** 2).sum())
        penalty = float((near.lack**2).sum()) + float((self._beyond_limits(guess.states)[0] ** 2).sum())
        miss = float((self._miss(guess.states[-1])[0] ** 2).sum())
        rough = self._roughness(guess)
        cost = (
            self.urgency * guess.time + 0.5 * _penalty(stiffness) * (penalty + miss) + 0.5 * stiffness * defect + rough
        )
        return cost, (guess.time, defect, penalty, miss, rough)

    def _roughness(self, guess: Guess) -> float:
        span = self._bounds[:-1, 1] - self._bounds[:-1, 0]
        jumps = np.diff(guess.controls / span, axis=0)
        return float(0.5 * SMOOTHNESS * (jumps**2).sum() + 0.5 * EVENNESS * (np.diff(guess.durations) ** 2).sum())

    def _stages(self, guess: Guess, near: Near, stiffness: float) -> Stages:
        """Quadratic problem around a trajectory; `stiffness` is that of the penalties."""
        n, nx, m = len(guess.durations), len(self._vehicle.state), len(self._bounds)
        after, by_state, by_input = self._step(guess, True)
        nu = m - 1
        q_matrix, q = np.zeros((n + 1, nx, nx)), np.zeros((n + 1, nx))
        self._add_clearance(near, guess, stiffness, q_matrix, q)
        excess, sign = self._beyond_limits(guess.states)
        for column, k in enumerate(self._limited):
            q[:, k] += stiffness * excess[:, column] * sign[:, column]
            q_matrix[:, k, k] += stiffness * (excess[:, column] > 0.0)
        residual, gradient = self._miss(guess.states[-1])
        q[-1] += stiffness * residual @ gradient
        q_matrix[-1] += stiffness * gradient.T @ gradient
        inputs = np.column_stack([guess.controls, guess.durations])
        span = np.append(self._bounds[:-1, 1] - self._bounds[:-1, 0], 1.0)
        weight = np.append(np.full(nu, SMOOTHNESS), EVENNESS) / span**2
        jumps = np.diff(inputs, axis=0)
        r = np.zeros((n, m))
        r[:-1] -= weight * jumps
        r[1:] += weight * jumps
        r[:, -1] += self.urgency
        r_matrix = np.zeros((n, m, m))
        r_matrix[:, range(m), range(m)] = 2.0 * weight
        return Stages(
            np.ascontiguousarray(by_state), np.ascontiguousarray(by_input), after - guess.states[1:], q_matrix, q,
            r_matrix, r, self._bounds[:, 0] - inputs, self._bounds[:, 1] - inputs,
        )  # fmt: skip

    def _beyond_limits(self, states: Matrix) -> tuple[Matrix, Matrix]:
        """How far states are beyond the limits of the limited components, and on which side."""
        low, high = self._problem.limits[self._limited].T
        slack = WITHIN_LIMITS * np.minimum(high - low, 1.0)
        values = states[:, self._limited]
        below, above = np.maximum(low + slack - values, 0.0), np.maximum(values - high + slack, 0.0)
        return below + above, np.where(above > 0.0, 1.0, -1.0)

    def _miss(self, state: Floats) -> tuple[Floats, Matrix]:
        """Residuals (k,) of a state outside the middle of the goal region, and their gradient (k, nx)."""
        goal, (x, y, theta), nx = self.goal, self._pose, len(state)
        away = np.array([state[x] - goal.center[0], state[y] - goal.center[1]])
        distance = float(np.hypot(*away))
        residuals, rows = [], []
        if distance > INSIDE * goal.radius:
            row = np.zeros(nx)
            row[[x, y]] = away / distance
            residuals.append(distance - INSIDE * goal.radius)
            rows.append(row)
        if theta >= 0 and goal.has_heading:
            off = math.remainder(state[theta] - goal.heading, math.tau)
            if abs(off) > INSIDE * goal.tolerance:
                row = np.zeros(nx)
                row[theta] = math.copysign(1.0, off)
                residuals.append(abs(off) - INSIDE * goal.tolerance)
                rows.append(row)
        for name, (low, high) in goal.limits.items():
            k = self._vehicle.index(name)
            middle, half = 0.5 * (low + high), 0.5 * INSIDE * (high - low)
            off = state[k] - middle
            if abs(off) > half:
                row = np.zeros(nx)
                row[k] = math.copysign(1.0, off)
                residuals.append(abs(off) - half)
                rows.append(row)
        return np.array(residuals), np.array(rows).reshape(len(rows), nx)

    def _clearance(self, guess: Guess, margin: float) -> Near:
        """Discs of the footprint that lack clearance, of the states that are not far from all obstacles."""
        scalar, field, states = self._problem.scalar, self._signed, guess.states
        x, y, required = states[:, self._pose[0]], states[:, self._pose[1]], margin + self._delta(guess)
        column = ((x - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE]).astype(np.int64)
        row = ((y - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE]).astype(np.int64)
        around = field[row.clip(0, field.shape[0] - 1), column.clip(0, field.shape[1] - 1)]
        near = np.flatnonzero(around < scalar[at.REACH] + required)
        c, s = self._direction(states[near])
        ahead, aside, radius = self._problem.discs.T
        u = (x[near, None] + ahead * c - aside * s - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE] - 0.5
        v = (y[near, None] + ahead * s + aside * c - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE] - 0.5
        u, v = np.clip(u, 0.0, field.shape[1] - 1.001), np.clip(v, 0.0, field.shape[0] - 1.001)
        columns, rows = u.astype(np.int64), v.astype(np.int64)
        u, v = u - columns, v - rows
        first = rows * field.shape[1] + columns
        flat, width = field.reshape(-1), field.shape[1]
        f00, f01, f10, f11 = (flat[first + k] for k in (0, 1, width, width + 1))
        value = (f00 * (1 - u) + f01 * u) * (1 - v) + (f10 * (1 - u) + f11 * u) * v
        lack = np.maximum(required[near, None] + radius - value, 0.0)
        pose, disc = np.nonzero(lack)
        u, v = u[pose, disc], v[pose, disc]
        f00, f01, f10, f11 = (corner[pose, disc] for corner in (f00, f01, f10, f11))
        return Near(
            near[pose],
            disc,
            lack[pose, disc],
            ((f01 - f00) * (1 - v) + (f11 - f10) * v) * scalar[at.GRID_INVERSE],
            ((f10 - f00) * (1 - u) + (f11 - f01) * u) * scalar[at.GRID_INVERSE],
        )

    def _direction(self, states: Matrix) -> tuple[Matrix, Matrix]:
        theta = self._pose[2]
        heading = states[:, theta, None] if theta >= 0 else np.zeros((len(states), 1))
        return np.cos(heading), np.sin(heading)

    def _delta(self, guess: Guess) -> Floats:
        """Clearance (n + 1,) that the model gap requires within the first cycle, m."""
        times = np.concatenate([[0.0], np.cumsum(guess.durations)])
        speed = guess.states[:, self._vehicle.rest_indices[0]] if self._vehicle.rest else np.zeros(len(times))
        inside = times <= self.safety.cycle + LONGEST
        delta: Floats = np.where(inside, self.safety.clearance(speed, times), 0.0)
        return delta

    def _add_clearance(self, near: Near, guess: Guess, stiffness: float, q_matrix: Cube, q: Matrix) -> None:
        if len(near.state) == 0:
            return
        c, s = (part[near.state, 0] for part in self._direction(guess.states))
        ahead, aside, _ = self._problem.discs[near.disc].T
        gradient = np.zeros((len(near.state), len(self._vehicle.state)))
        gradient[:, self._pose[0]], gradient[:, self._pose[1]] = near.slope_x, near.slope_y
        if self._pose[2] >= 0:
            gradient[:, self._pose[2]] = -near.slope_x * (ahead * s + aside * c) + near.slope_y * (
                ahead * c - aside * s
            )
        np.add.at(q, near.state, -stiffness * near.lack[:, None] * gradient)
        np.add.at(q_matrix, near.state, stiffness * gradient[:, :, None] * gradient[:, None, :])


def _penalty(stiffness: float) -> float:
    """Stiffness of the penalties at a stiffness of the model."""
    return min(max(stiffness, PENALTY), LAST_PENALTY)


def resampled(guess: Guess, interval: float) -> Guess:
    """The same trajectory in intervals of about `interval` s; states in between are interpolated."""
    ends = np.concatenate([[0.0], np.cumsum(guess.durations)])
    count = max(math.ceil(ends[-1] / interval), 2)
    times = np.linspace(0.0, ends[-1], count + 1)
    states = np.column_stack([np.interp(times, ends, column) for column in guess.states.T])
    middle = 0.5 * (times[:-1] + times[1:])
    index = np.clip(np.searchsorted(ends, middle, side="right") - 1, 0, len(guess.durations) - 1)
    return Guess(states, guess.controls[index], np.diff(times))


def guess_along(path: PosePath, vehicle: Vehicle, start: Floats) -> Guess:
    """First guess from a path of poses: speeds and controls are those at which the path's velocities were seen.

    The durations allow for acceleration.
    """
    motion = motion_of(vehicle)
    _, numbers = motion.extreme_twists(vehicle.footprint.reach)
    seen = numbers[path.twist]
    states = motion.states[np.append(seen, seen[-1:])]
    columns = [vehicle.index(name) for name in ("x", "y", "theta")]
    states[:, columns] = path.poses
    turns = round((start[columns[2]] - path.poses[0, 2]) / math.tau)
    states[:, columns[2]] += math.tau * turns
    states[0] = start
    controls = motion.controls[seen].copy()
    return resampled(Guess(states, controls, CAREFULLY * path.times), INTERVAL)


def guess_to_goal(
    vehicle: Vehicle, workspace: Workspace, goal: Goal, settings: Settings, start: Floats
) -> Guess | None:
    """Guess along the path of poses from a start (nx,) to a goal with a heading; None if there is no path."""
    found = pose_cost_to_go_of(vehicle, workspace, goal, settings_for(settings, vehicle, goal).cell)
    path = found.path_from(*(float(start[vehicle.index(name)]) for name in ("x", "y", "theta")))
    return guess_along(path, vehicle, start) if path is not None and len(path.times) > 1 else None


def guess_of(times: Floats, trajectory: Matrix, controls: Matrix, durations: Floats) -> Guess:
    """Guess of a plan: states `trajectory` (k, nx) at `times` (k,), and the edges' controls (n, nu) and durations."""
    ends = np.cumsum(durations)
    held = np.minimum(np.searchsorted(ends, 0.5 * (times[:-1] + times[1:])), len(ends) - 1)
    return resampled(Guess(trajectory, controls[held], np.diff(times)), INTERVAL)
