"""Multi-step form of the estimation: open-loop prediction over windows, each with an unknown state at its beginning.

The unknowns are the parameters rho and the initial state of every window; the controls are the commands.  The residual
of a pose has the noise of the poses and the error that the model makes by then, which grows with the time since the
beginning of the window.  For a model that is exact this error is small and every pose counts the same; a model that
lacks an effect is fitted to predict over the whole window instead of being bent by small motions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kraft.sysid.chains import Segment
from kraft.sysid.dynamics import DIFFERENCE_STEP
from kraft.sysid.initial_values import SmoothedPoses, initial_states, smooth_chains
from kraft.sysid.observation import NoiseModel
from kraft.sysid.optimiser import OnIteration, Optimum, RhoFactors, bounded_step, ignore_iteration
from kraft.sysid.parameters import YAW_RATES, Parameters, speed_index
from kraft.sysid.problem import Point, Problem, assemble
from kraft.sysid.smoothing import NEIGHBOURS, smoothed
from ompl_ext.arrays import Bools, Floats, Ints, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Part


START_NOISE = 3.0
"""Standard deviation of an initial pose from the smoothed one, over the noise of a pose."""
POSITION_FREE, YAW_FREE, SPEED_FREE, YAW_RATE_FREE, HIDDEN_FREE = 0.005, 0.01, 0.01, 0.02, 0.002
"""Least standard deviations of an initial state from its first values, m, rad, m/s, rad/s, because smoothing rounds off
curves; others, which follow from the commands, in their unit."""
CONVERGED = 1e-5
"""Relative decrease of the cost by a step below which a fit has converged, if the one before was as small."""
DAMPING_INITIAL, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e7
SETTLING = 1.0
"""Time for which the first command is held to find components of an initial state that poses do not show, s."""
COMMANDS_KEPT = 8
"""Number of actuator parameters whose commands are kept."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Poses of windows in common arrays: W windows of at most n poses."""

    segments: tuple[Segment, ...]
    steps: int
    """of the longest window"""
    h: Floats
    """(W,) s"""
    poses: Floats
    """(W, n, 3) observed, zeros beyond the last pose of a window"""
    seen: Bools
    """(W, n) whether there is such a pose"""
    since: Matrix
    """(W, n) time since the beginning of the window, s"""
    step: Ints
    """(W, n)"""
    share: Matrix
    """(W, n) of the step"""
    fold: Ints
    """(W,)"""
    first: SmoothedPoses
    """(W, 3) poses and rates at the beginnings, smoothed with those before and after"""
    interval: float
    """between the poses that they were smoothed from, s"""

    @property
    def folds(self) -> int:
        """Number of folds."""
        return int(self.fold.max()) + 1


def windows_of(segments: Sequence[Segment], parts: Sequence[Part], fold: Ints) -> Windows:
    """Arrays of some windows; `parts` (W,) are the parts with all poses, `fold` (W,) is the fold of each."""
    beginnings = [
        smoothed(part.pose_times, part.poses, np.array([s.begin])) for s, part in zip(segments, parts, strict=True)
    ]
    first = SmoothedPoses(*(np.concatenate(each) for each in zip(*beginnings, strict=True)))
    interval = float(np.median([np.median(np.diff(part.pose_times)) for part in parts]))
    most = max(len(s.part.pose_times[s.poses]) for s in segments)
    shape = (len(segments), most)
    poses, seen, since = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool), np.zeros(shape)
    for w, s in enumerate(segments):
        times = s.part.pose_times[s.poses]
        poses[w, : len(times)], seen[w, : len(times)] = s.part.poses[s.poses], True
        since[w, : len(times)] = times - s.begin
    h = np.array([s.h for s in segments])
    counts = np.array([s.steps for s in segments])[:, None]
    step = np.clip(np.floor(since / h[:, None] + 1e-9), 0, counts - 1).astype(np.int64)
    share = np.clip(since / h[:, None] - step, 0.0, 1.0)
    return Windows(tuple(segments), int(counts.max()), h, poses, seen, since, step, share, fold, first, interval)


class MultiStep:
    """Multi-step problem with given parameters, to be solved by `fit`; `Point.states` are the initial states."""

    def __init__(self, windows: Windows, parameters: Parameters, noise: NoiseModel, growth: Floats) -> None:
        """`growth` (3,) is that of the model's error in x, y and yaw, m/s and rad/s."""
        self.windows, self.noise = windows, noise
        self.problem: Problem = assemble(windows.segments, len(windows.segments), parameters, noise)
        self.sigmas: Floats = np.sqrt(noise.pose_sigmas**2 + (growth * windows.since[..., None]) ** 2)
        self._nx = self.problem.dynamics.nx
        self._kernel = self.problem.dynamics.discrete_model
        self._free = np.flatnonzero(parameters.free)
        self._commands: dict[bytes, Floats] = {}
        self._expected: tuple[bytes, Matrix] | None = None
        acts = ("delay", "lag_", "dead_band_")
        self._acting = [
            k for k, name in enumerate(parameters.names) if k >= parameters.model_size and name.startswith(acts)
        ]

    @cached_property
    def smoothed(self) -> SmoothedPoses:
        """Smoothed poses of the windows at the times of the steps."""
        return smooth_chains(self.problem.chains)

    @cached_property
    def _observed(self) -> tuple[Matrix, Floats]:
        """Initial states (W, nx) as the smoothed poses of the tracked point show them, and deviations (nx,)."""
        vehicle, noise = self.problem.parameters.vehicle, self.noise.noise
        slope = START_NOISE / (
            self.windows.interval * math.sqrt(NEIGHBOURS * (NEIGHBOURS**2 - 1) / 12.0)
        )  # of a parabola's middle
        spread = np.full(self._nx, HIDDEN_FREE)
        for k, name in enumerate(vehicle.state):
            if name in ("x", "y"):
                spread[k] = max(START_NOISE * noise.position, POSITION_FREE)
            elif name == "theta":
                spread[k] = max(START_NOISE * noise.yaw, YAW_FREE)
            elif name in YAW_RATES:
                spread[k] = max(slope * noise.yaw, YAW_RATE_FREE)
            elif k == speed_index(vehicle):
                spread[k] = max(slope * noise.position, SPEED_FREE)
        return initial_states(vehicle, np.arange(len(self.windows.segments)), self.windows.first), spread

    def prior_states(self, rho: Floats) -> Matrix:
        """(W, nx) expected initial states: smoothed poses and rates, and what the first command leads to.

        Those of the last rho are kept: the cost of a point, its derivatives and the step from it all need them.
        """
        key = rho.tobytes()
        if self._expected is None or self._expected[0] != key:
            self._expected = (key, self._expect(rho))
        return self._expected[1].copy()

    def _expect(self, rho: Floats) -> Matrix:
        states = self._shown_alike(self._observed[0], np.zeros(len(rho)), rho)
        if self._hidden:
            steps = round(SETTLING / float(self.windows.h.min()))
            controls = np.repeat(self._controls(rho)[:1], steps, axis=0)
            values = np.tile(self.problem.parameters.model_values(rho), (len(states), 1))
            settled = self._kernel.simulate(states, controls, values, self.windows.h)[-1]
            states[:, self._hidden] = settled[:, self._hidden]
        return states

    @cached_property
    def _hidden(self) -> list[int]:
        """Components of the state that poses do not show."""
        vehicle = self.problem.parameters.vehicle
        shown = {speed_index(vehicle), *(vehicle.index(name) for name in ("x", "y", "theta", *YAW_RATES))}
        return [k for k in range(self._nx) if k not in shown]

    def shifted(self, states: Matrix, before: Floats, rho: Floats) -> Matrix:
        """Initial states for `rho` that differ from the expected ones as those for `before` do, with the same poses."""
        moved = self._shown_alike(states, before, rho)
        if self._hidden and not np.array_equal(before, rho):
            change = self._expect(rho)[:, self._hidden] - self.prior_states(before)[:, self._hidden]
            moved[:, self._hidden] += change
        return moved

    def _shown_alike(self, states: Matrix, before: Floats, rho: Floats) -> Matrix:
        """States moved so that they show with `rho` the poses that they show with `before`; zeros show themselves."""
        observation, vehicle = self.problem.observation, self.problem.parameters.vehicle
        shown, moved = observation.predict(states, before), states.copy()
        for k, name in ((2, "theta"), (0, "x"), (1, "y")):  # the yaw first: a lever turns with it
            if name in vehicle.state:
                moved[:, vehicle.index(name)] += shown[:, k] - observation.predict(moved, rho)[:, k]
        return moved

    def process_noise(self, growth: Floats, horizon: float) -> dict[str, float]:
        """Random walks of speed and turning, by component, that make errors as large as the model's at the horizon."""
        vehicle, found = self.problem.parameters.vehicle, {}
        per_rate = math.sqrt(3.0 / horizon)  # a random walk of a rate, integrated: q sqrt(t^3 / 3)
        if (k := speed_index(vehicle)) >= 0:
            found[vehicle.state[k]] = float(growth[0]) * per_rate
        for name in vehicle.state:
            if name in YAW_RATES:
                found[name] = float(growth[2]) * per_rate
        if "theta" in vehicle.state and not set(YAW_RATES) & set(vehicle.state):
            found["theta"] = float(growth[2]) * math.sqrt(horizon)
        return found

    def start(self, rho: Floats) -> Point:
        """Point with given parameters, each window beginning as the smoothed poses do."""
        return Point(self.prior_states(rho), np.empty((0, 0)), rho.copy())

    def predict(self, starts: Sequence[Matrix], rhos: Sequence[Floats]) -> Floats:
        """Poses (m, W, n, 3) of all windows, m times: from the states starts[i] (W, nx) with rhos[i] (np,)."""
        p, w, count = self.problem.parameters, self.windows, len(self.windows.segments)
        controls = np.concatenate([self._controls(rho) for rho in rhos], axis=1)
        values = np.repeat([p.model_values(rho) for rho in rhos], count, axis=0)
        h = np.tile(w.h, len(rhos))
        states = self._kernel.simulate(np.concatenate(starts), controls, values, h)
        states = states.reshape(w.steps + 1, len(rhos), count, self._nx)
        at, share = np.arange(count)[:, None], w.share[..., None]
        poses = np.empty((len(rhos), *w.since.shape, 3))
        for i, rho in enumerate(rhos):
            own = states[:, i]
            between = (1.0 - share) * own[w.step, at] + share * own[w.step + 1, at]
            shown = self.problem.observation.predict(between.reshape(-1, self._nx), rho)
            poses[i] = shown.reshape(*w.since.shape, 3)
        return poses

    def _controls(self, rho: Floats) -> Floats:
        """(steps, W, nu) controls that act; those of the last few actuator parameters are kept."""
        key = rho[self._acting].tobytes()
        if key not in self._commands:
            mean = self.problem.actuators.mean(rho)[0]
            found = np.zeros((self.windows.steps, len(self.windows.segments), mean.shape[1]))
            for i, segment in enumerate(self.windows.segments):
                first = int(self.problem.chains.first[i]) - i
                found[: segment.steps, i] = mean[first : first + segment.steps]
            if len(self._commands) >= COMMANDS_KEPT:
                del self._commands[next(iter(self._commands))]
            self._commands[key] = found
        return self._commands[key]

    def residuals(self, point: Point) -> Floats:
        """(W, n, 3) predicted less observed, 0 where there is no pose."""
        predicted = self.predict([point.states], [point.rho])[0]
        off: Floats = (predicted - self.windows.poses) * self.windows.seen[..., None]
        if not self.problem.observation.turns:
            off[..., 2] = 0.0
        return off

    def _weights(self, off: Floats) -> Floats:
        """(W, n) weights of the robust loss."""
        if not self.noise.robust:
            return np.ones(off.shape[:2])
        distance = np.sqrt(np.sum((off / self.sigmas) ** 2, axis=2))
        weights: Floats = self.noise.threshold / np.maximum(distance, self.noise.threshold)
        return weights

    def cost(self, point: Point) -> float:
        """Half of the sum of squared residuals in standard deviations, with the robust loss for poses."""
        distance = np.sqrt(np.sum((self.residuals(point) / self.sigmas) ** 2, axis=2))
        inside = np.minimum(distance, self.noise.threshold)
        loss = float(np.sum(inside * (distance - 0.5 * inside)))
        off = (point.states - self.prior_states(point.rho)) / self._observed[1]
        total = loss + 0.5 * float(np.sum(off**2) + np.sum(self.problem.prior_residuals(point.rho) ** 2))
        return total if np.isfinite(total) else np.inf

    def linearise(self, point: Point) -> None:
        """Derivatives of all residuals by differences: every window once per component, in one rollout."""
        self._point = point
        nx, p = self._nx, self.problem.parameters
        changes = DIFFERENCE_STEP * np.maximum(np.abs(point.rho), 0.1)
        changes = np.where(point.rho + changes > p.high, -changes, changes)
        pose = [p.vehicle.index(name) for name in ("x", "y", "theta") if name in p.vehicle.state]
        others = [k for k in range(nx) if k not in pose]
        starts, rhos = [point.states], [point.rho]
        for k in self._free.tolist():
            rhos.append(point.rho + changes * (np.arange(len(changes)) == k))
            starts.append(self.shifted(point.states, point.rho, rhos[-1]))  # a lever turns about the tracked point
        for k in others:
            rhos.append(point.rho)
            starts.append(point.states + DIFFERENCE_STEP * (np.arange(nx) == k))
        poses, seen, count = self.predict(starts, rhos), self.windows.seen[..., None], len(self._free)
        base = poses[0]
        self._off = (base - self.windows.poses) * seen
        slopes = np.moveaxis(poses[1:] - base, 0, -1) * seen[..., None]
        self._by_rho = slopes[..., :count] / changes[self._free]
        self._by_start = np.zeros((*base.shape, nx))
        self._by_start[..., others] = slopes[..., count:] / DIFFERENCE_STEP
        self._by_pose(base, seen)
        if not self.problem.observation.turns:
            self._off[..., 2] = 0.0

    def _by_pose(self, base: Floats, seen: Bools) -> None:
        """Derivatives by the initial pose: the motion moves and turns with it."""
        vehicle = self.problem.parameters.vehicle
        self._by_start[..., 0, vehicle.index("x")] = self._by_start[..., 1, vehicle.index("y")] = 1.0
        if vehicle.index("theta") >= 0:
            centre = self._point.states[:, [vehicle.index("x"), vehicle.index("y")]]
            arm = base[..., :2] - centre[:, None]
            k = vehicle.index("theta")
            self._by_start[..., 0, k], self._by_start[..., 1, k] = -arm[..., 1], arm[..., 0]
            self._by_start[..., 2, k] = 1.0
        self._by_start *= seen[..., None]

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate the initial states; `damping` raises their information by that share."""
        nx, free, count = self._nx, self._free, len(self.windows.segments)
        weight = self._weights(self._off)[..., None] / self.sigmas**2
        a = self._by_start.reshape(count, -1, nx)
        b = self._by_rho.reshape(count, -1, len(free))
        w, r = weight.reshape(count, -1), self._off.reshape(count, -1)
        deviation = self._point.states - self.prior_states(self._point.rho)
        prior = self._observed[1] ** -2.0
        wa = a * w[..., None]
        information = np.swapaxes(wa, 1, 2) @ a
        information[:, np.arange(nx), np.arange(nx)] += prior
        information[:, np.arange(nx), np.arange(nx)] *= 1.0 + damping
        cross = np.swapaxes(wa, 1, 2) @ b
        gradient = (wa * r[..., None]).sum(axis=1) + prior * deviation
        self._solved = np.linalg.solve(information, np.concatenate([cross, gradient[..., None]], axis=2))
        own = np.swapaxes(b * w[..., None], 1, 2) @ b - np.swapaxes(cross, 1, 2) @ self._solved[..., :-1]
        slope = ((b * w[..., None]) * r[..., None]).sum(axis=1) - np.einsum("wxr,wx->wr", cross, self._solved[..., -1])
        size, folds = len(self._point.rho), self.windows.folds
        full, slopes = np.zeros((folds, size, size)), np.zeros((folds, size))
        for fold in range(folds):
            chosen = self.windows.fold == fold
            full[fold][np.ix_(free, free)] = own[chosen].sum(axis=0)
            slopes[fold, free] = slope[chosen].sum(axis=0)
        p = self.problem.parameters
        inverse = np.where(p.free, 1.0 / p.std, 0.0)
        return RhoFactors(full, slopes, inverse**2, inverse * self.problem.prior_residuals(self._point.rho))

    def moved(self, change: Floats) -> Point:
        """Point with rho changed, each window beginning at the best of the linearised problem."""
        rho = self.problem.parameters.within_bounds(self._point.rho + change)
        step = -(self._solved[..., :-1] @ change[self._free] + self._solved[..., -1])
        states = self.shifted(self._point.states, self._point.rho, rho) + step
        return replace(self._point, states=states, rho=rho)


def fit(graph: MultiStep, start: Point, most: int, on_iteration: OnIteration = ignore_iteration) -> Optimum:
    """Minimise the cost within the bounds of the parameters, in at most `most` steps (Levenberg-Marquardt)."""
    p = graph.problem.parameters
    point, cost, damping, converged, iterations = start, graph.cost(start), DAMPING_INITIAL, False, 0
    small = False
    graph.linearise(point)
    while iterations < most and not converged:
        factors = graph.reduce(damping)
        change = bounded_step(factors, damping, p.low - point.rho, p.high - point.rho, p.free)
        candidate = graph.moved(change)
        lower = graph.cost(candidate)
        if lower <= cost:
            before, small = small, cost - lower <= CONVERGED * cost
            iterations, converged = iterations + 1, before and small
            point, cost, damping = candidate, lower, max(0.2 * damping, DAMPING_MIN)
            graph.linearise(point)
            on_iteration(iterations, cost)
        else:
            damping, converged = 5.0 * damping, damping > DAMPING_MAX
    return Optimum(point, cost, converged, iterations, graph.reduce(0.0))
