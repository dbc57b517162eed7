"""Checks of edges, contingencies and poses for one vehicle in one workspace, by the compiled kernels."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.fine_field import raise_to_fine
from ompl_ext.kernels.kernel_types import LANE_WIDTH, Lanes, Problem
from ompl_ext.kernels.search import search
from ompl_ext.kernels.specialise import kernels
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Contingency
from ompl_ext.problem import lanes_of, make_problem
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.vehicle import Vehicle


class _Memory(threading.local):
    """Working memory of single edges and of manoeuvres, which every thread has for itself."""

    def __init__(self, vehicle: Vehicle, problem: Problem) -> None:
        self.work = lanes_of(vehicle, int(problem.option[at.STEPS]))
        self.brake = lanes_of(vehicle, int(problem.option[at.BRAKE_STEPS]))


class EdgeChecker:
    """Checks edges, contingencies and poses; the constructor computes the clearance field.

    Several threads may check at the same time, while none sets parameters or clearances.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        workspace: Workspace,
        goal: Goal | None = None,
        safety: Safety | None = None,
        settings: Settings | None = None,
    ) -> None:
        """Prepare the maps; with a `goal` also the cost-to-go."""
        self.vehicle, self.workspace, self.goal = vehicle, workspace, goal
        self.safety, self.settings = safety or Safety(), settings or Settings()
        self._kernels, self._search = kernels(vehicle), search()
        self._problem = make_problem(vehicle, workspace, goal, self.safety, self.settings)
        problem = self._problem
        problem.functions[:] = self._kernels.functions
        self._maps = problem.field, problem.tile, problem.squares, problem.discs, problem.scalar
        self._memory = _Memory(vehicle, problem)

    @property
    def problem(self) -> Problem:
        """Arrays that the kernels read."""
        return self._problem

    @property
    def work(self) -> Lanes:
        """Working memory of single edges, of the thread that asks."""
        return self._memory.work

    def steps_of(self, duration: float) -> int:
        """Number of integration steps of an edge.

        Raises:
            ValueError: it is longer than the longest one.
        """
        most = steps = int(self._problem.option[at.STEPS])
        if self.settings.quantum > 0.0 and duration > 0.0:
            steps = max(1, round(duration / self.settings.quantum))
        if steps > most:
            raise ValueError(f"an edge of {duration} s is longer than the longest of {self.settings.longest} s")
        return steps

    def contingency(self, state: Floats, after: float = 0.0) -> Contingency | None:
        """SAFETY (Alg. 2) of a state: a manoeuvre that is safe until standstill, or None; times begin at `after` s."""
        self._memory.brake.source[:] = state
        return self._first_safe_manoeuvre(math.inf, after)

    def manoeuvres(self, state: Floats) -> list[Matrix]:
        """States (m, nx) of each contingency manoeuvre from a state until standstill, at most up to the horizon.

        A state follows every `safety.step` s; nothing is checked.
        """
        brake = self._memory.brake
        brake.source[:] = state
        self._search.brake(self._problem, self._memory.work, brake, math.inf)
        count = len(self.vehicle.manoeuvres)
        trajectory = brake.trajectory.reshape(-1, len(self.vehicle.state), LANE_WIDTH)[:, :, :count]
        states = np.ascontiguousarray(trajectory.transpose(2, 0, 1))
        resting = self.safety.is_resting(self.vehicle, states)
        samples = np.where(resting.any(axis=1), resting.argmax(axis=1) + 1, len(trajectory)).tolist()
        return [states[number, : samples[number]] for number in range(count)]

    def edge(
        self, state: Floats, control: Floats, duration: float, start_time: float = math.inf
    ) -> tuple[Matrix, float]:
        """Trajectory (steps + 1, nx) of one edge and its slack (m), negative if it may collide.

        The edge begins at `start_time` s; before the end of the cycle it must also keep delta(v).

        Raises:
            ValueError: state or control have another number of values, or the edge is longer than the longest one.
        """
        for what, values, names in (("state", state, self.vehicle.state), ("control", control, self.vehicle.controls)):
            if len(values) != len(names):  # the kernel would take those that are missing from an earlier edge
                raise ValueError(f"the {what} has {len(values)} values; expected {len(names)}: {', '.join(names)}")
        slack = self._propagate(np.asarray(state, dtype=float), control, duration, start_time)
        work, nx = self._memory.work, len(self.vehicle.state)
        steps = int(work.steps[0])
        return work.trajectory.reshape(-1, nx, LANE_WIDTH)[: steps + 1, :, 0].copy(), slack

    def slack(self, state: Floats) -> float:
        """Clearance of a state (nx,) beyond delta(v) where the cycle begins (m), negative if it may collide."""
        return self._propagate(np.asarray(state, dtype=float), np.zeros(len(self.vehicle.controls)), 0.0, 0.0)

    def set_delta(self, delta: float) -> None:
        """Set the clearance at rest within the first cycle and along contingencies (m), which does not grow with time.

        A vehicle that stands with less than a growing clearance could not even stay: it would lack more and more.
        """
        self.set_bound(delta, self.safety.delta_per_speed, 0.0, 0.0)

    def set_bound(self, delta: float, per_speed: float, per_time: float, horizon: float) -> None:
        """Set the clearance delta(t, v) within the first cycle and along contingencies, see `Safety`."""
        self.safety = replace(
            self.safety, delta=delta, delta_per_speed=per_speed, delta_per_time=per_time, delta_horizon=horizon
        )
        scalar = self._problem.scalar
        scalar[at.DELTA], scalar[at.DELTA_PER_SPEED] = delta, per_speed
        scalar[at.DELTA_PER_TIME], scalar[at.DELTA_HORIZON] = per_time, horizon

    def set_far(self, near: float, delta: float, per_speed: float) -> None:
        """Set the clearance `delta` + `per_speed` |v| of the time after `near` s, see `Safety`."""
        self.safety = replace(self.safety, near=near, far_delta=delta, far_delta_per_speed=per_speed)
        self._problem.scalar[[at.NEAR, at.DELTA_FAR, at.DELTA_FAR_PER_SPEED]] = near, delta, per_speed

    def set_cycle(self, seconds: float) -> None:
        """Set the time for which plans keep the clearance and after which they have a contingency, s."""
        self.safety = replace(self.safety, cycle=seconds)
        self._problem.scalar[at.CYCLE] = seconds

    @contextmanager
    def with_clearance_until(self, seconds: float) -> Iterator[None]:
        """Let edges that begin before `seconds` s keep delta(t, v), instead of those before the end of the cycle."""
        self._problem.scalar[at.CYCLE] = seconds
        try:
            yield
        finally:
            self._problem.scalar[at.CYCLE] = self.safety.cycle

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,), in its order; the cost-to-go stays that of the first ones."""
        names = self.vehicle.parameters
        self.vehicle = self.vehicle.with_parameters(dict(zip(names, map(float, values), strict=True)))
        self._problem.parameters[: len(names)] = values

    def pose_slack(self, x: float, y: float, theta: float) -> float:
        """Lower bound of the footprint's clearance at a pose within the workspace (m)."""
        return self._search.pose(*self._maps, x, y, theta)

    def clearances(self, poses: Matrix) -> Floats:
        """Lower bound (n,) of the footprint's clearance at poses (n, 3), m; as `pose_slack`, but tight everywhere."""
        found = np.empty(len(poses))
        poses = np.ascontiguousarray(poses, dtype=float)
        self._search.clearances(self._problem, poses, np.cos(poses[:, 2]), np.sin(poses[:, 2]), found)
        return found

    def least_slacks(self, states: Matrix, since: Floats, ends: Ints) -> Floats:
        """Least clearance of k motions beyond delta(t, v) (k,), m, a lower bound; delta has the speed and the time.

        Motion k has the states (n, nx) up to number `ends[k]`, from the end of the one before it on, and `since` (n,)
        are their times since the start of the query, s.
        """
        vehicle, found = self.vehicle, np.empty(len(ends))
        theta = vehicle.index("theta")
        heading = states[:, theta] if theta >= 0 else np.zeros(len(states))
        where = np.array([vehicle.index("x"), vehicle.index("y"), vehicle.rest_indices[0]])
        states = np.ascontiguousarray(states, dtype=float)
        self._search.least_slacks(self._problem, states, np.cos(heading), np.sin(heading), where, since, ends, found)
        return found

    def least_distance(self, poses: Matrix) -> float:
        """Smallest exact distance of the footprint at poses (n, 3) to an obstacle (m), asked of as few as possible."""
        return self.exact.least_distance(poses)

    def fine(self, states: Matrix, controls: Matrix, durations: Floats, samples: int) -> Floats:
        """States (n, samples + 1, nx) at equal intervals along n motions, unchecked.

        Motion k begins in `states[k]` (nx,) and holds `controls[k]` (nu,) for `durations[k]` s.
        """
        found = np.empty((len(states), samples + 1, len(self.vehicle.state)))
        found[:, 0] = states
        self._kernels.roll_out(found, np.ascontiguousarray(controls), self._problem.parameters, durations / samples)
        return found

    def is_occupied(self, points: Matrix) -> Bools:
        """Whether each of the points (n, 2) is in an obstacle or less than a cell of the clearance field from one."""
        scalar, field = self._problem.scalar, self._problem.field
        columns, rows = ((points - scalar[[at.GRID_X, at.GRID_Y]]) * scalar[at.GRID_INVERSE]).astype(int).T
        value = field[rows.clip(0, field.shape[0] - 1), columns.clip(0, field.shape[1] - 1)].astype(float)
        if scalar[at.FINE_INVERSE] > 0.0:
            raise_to_fine(self._problem, points[:, 0].copy(), points[:, 1].copy(), value)
        inside: Bools = value <= 0.0
        return inside

    @cached_property
    def exact(self) -> ExactClearance:
        """Exact clearance of the vehicle's footprint in the workspace."""
        return ExactClearance(self.workspace, self.vehicle.footprint)

    def _propagate(self, state: Floats, control: Floats, duration: float, start_time: float = math.inf) -> float:
        work, problem = self._memory.work, self._problem
        work.source[:] = state
        for k, value in enumerate(control):
            work.control[k * LANE_WIDTH] = value
        work.duration[0], work.steps[0] = duration, self.steps_of(duration)
        self._search.edge(problem, work, start_time)
        return float(work.slack[0])

    def _first_safe_manoeuvre(self, edge_begins: float, brakes_at: float) -> Contingency | None:
        """SAFETY where the edge in lane 0 crosses the end of the cycle, or of `source` if `edge_begins` is infinite."""
        brake = self._memory.brake
        number = self._search.brake(self._problem, self._memory.work, brake, edge_begins)
        if number < 0:
            return None
        samples, nx = int(brake.steps[number]) + 1, len(self.vehicle.state)
        states = brake.trajectory.reshape(-1, nx, LANE_WIDTH)[:samples, :, number].copy()
        times: Floats = brakes_at + self.safety.step * np.arange(samples, dtype=float)
        return Contingency(self.vehicle.manoeuvres[number], times, states, float(brake.slack[number]))
