"""Multi-step form of the estimation: open-loop prediction over windows, each with an unknown state at its beginning.

The unknowns are the parameters rho, the initial state of every window, and in every window the deviation of those
parameters that vary from drive to drive and during one (random effects); the controls are the commands.  The residual
of a pose has the noise of the poses and the error that the model makes by then, which grows with the time since the
beginning of the window.  For a model that is exact this error is small and every pose counts the same; a model that
lacks an effect is fitted to predict over the whole window instead of being bent by small motions.  Fits run in threads
on all cores (`in_parallel`): compiled kernels and large arrays release Python's global lock.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from kraft.sysid.dynamics import DIFFERENCE_STEP, Dynamics
from kraft.sysid.fit_progress import OnStep, ignore_step
from kraft.sysid.initial_values import SmoothedPoses, initial_states
from kraft.sysid.optimiser import RIDGE, Optimum, RhoFactors, bounded_step
from kraft.sysid.parallel import in_parallel
from kraft.sysid.parameters import YAW_RATES, Parameters, speed_index
from kraft.sysid.problem import NoiseModel, ObservationModel, Point, Problem
from kraft.sysid.smoothing import NEIGHBOURS
from kraft.sysid.window_controls import WindowControls
from kraft.sysid.windows import Acting, Variation
from ompl_ext.arrays import Bools, Floats, Matrix

START_NOISE = 3.0
"""Standard deviation of an initial pose from the smoothed one, over the noise of a pose."""
POSITION_FREE, YAW_FREE, SPEED_FREE, YAW_RATE_FREE, HIDDEN_FREE = 0.005, 0.01, 0.01, 0.02, 0.002
"""Least standard deviations of an initial state from its first values, m, rad, m/s, rad/s, because smoothing rounds off
curves; others, which follow from the commands, in their unit."""
CONVERGED = 1e-5
"""Relative decrease of the cost by a step below which a fit has converged, if the one before was as small."""
NEARLY_LINEAR = 0.01
"""Relative decrease of the cost by a step up to which derivatives are kept for the next one."""
DAMPING_INITIAL, DAMPING_MIN, DAMPING_MAX = 1e-3, RIDGE, 1e7
"""Damping of the first step, the least one, and the one beyond which a fit has converged if its step is refused."""
VARIATION_MIN = 0.1
"""Least share of the variation before that a new estimate may be, and of the estimate that the one before may be."""
MISFIT_FREEDOM = 3.0
"""Degrees of freedom of Student's distribution of a window's misfit: its poses err together, so that a window which the
model does not explain (a start against stiction, a hand on the car) counts little as a whole."""
LARGE_SHARE = 0.99
"""Quantile of the squared residuals up to which they count in full for the growth of the error."""
CHUNK = 32
"""Number of windows whose derivatives are multiplied at once: they remain in the processor's cache."""
EXPECTED_KEPT = 3
"""Number of points whose expected initial states are kept."""


class MultiStep:
    """Multi-step problem with given parameters, to be solved by `fit`.

    `Point.states` (W, nx + nv) are the initial states and the deviations of the parameters that vary.
    """

    def __init__(
        self,
        controls: WindowControls,
        parameters: Parameters,
        noise: NoiseModel,
        growth: Floats,
        variation: Variation,
    ) -> None:
        """Prepare the problem.

        Args:
            controls: the windows to predict, and the controls that act in them.
            parameters: of the model, and auxiliary ones.
            noise: of the poses.
            growth: (3,) of the model's error in x, y and yaw, m/s and rad/s.
            variation: of the parameters that vary; windows of a fold are of one drive.
        """
        windows = controls.windows
        self.windows, self.noise, self._controls = windows, noise, controls
        self.problem = Problem(
            parameters, controls.chains, controls.actuators, Dynamics(parameters), ObservationModel(parameters), noise
        )
        since = np.abs(windows.since - windows.known[:, None])[..., None]
        self.sigmas: Floats = np.sqrt(noise.pose_sigmas**2 + (growth * since) ** 2)
        self._nx = self.problem.dynamics.nx
        self._varying = [parameters.index(name) for name in variation.names]
        self.variation = variation
        self._within, self._between = variation.within**-2.0, np.maximum(variation.between, 1e-9) ** -2.0
        self._free = np.flatnonzero(parameters.free)
        self._expected: dict[bytes, Matrix] = {}

    @property
    def smoothed(self) -> SmoothedPoses:
        """Smoothed poses of the windows at the times of the steps."""
        return self._controls.smoothed

    @cached_property
    def _observed(self) -> tuple[Matrix, Floats]:
        """Initial states (W, nx) as the smoothed poses of the tracked point show them, and deviations (W, nx)."""
        vehicle, noise = self.problem.parameters.vehicle, self.noise.noise
        states = initial_states(vehicle, np.arange(len(self.windows.segments)), self.windows.first)
        slope = START_NOISE / (
            self.windows.interval * math.sqrt(NEIGHBOURS * (NEIGHBOURS**2 - 1) / 12.0)
        )  # of a parabola's middle
        spread = np.full(states.shape, HIDDEN_FREE)
        for k, name in enumerate(vehicle.state):
            if name in ("x", "y"):
                spread[:, k] = max(START_NOISE * noise.position, POSITION_FREE)
            elif name == "theta":
                spread[:, k] = max(START_NOISE * noise.yaw, YAW_FREE)
            elif name in YAW_RATES:
                spread[:, k] = max(slope * noise.yaw, YAW_RATE_FREE)
            elif k == speed_index(vehicle):
                spread[:, k] = np.hypot(max(slope * noise.position, SPEED_FREE), self._rounded_off)
        return states, spread

    @property
    def _rounded_off(self) -> Floats:
        """(W,) speed that a parabola through poses of a turn loses, m/s: to first order a share of v r^2."""
        rates = self.windows.first.rates
        lost = (3.0 * NEIGHBOURS**2 - 7.0) / 120.0 * self.windows.interval**2  # mean of t^4 over that of t^2, over 6
        speed: Floats = np.hypot(rates[:, 0], rates[:, 1])
        return lost * speed * rates[:, 2] ** 2

    def prior_states(self, rho: Floats) -> Matrix:
        """(W, nx + nv) expected initial states: smoothed poses and rates, and what the first command leads to.

        Those of the last few are kept: the cost of a point, its derivatives and the step from it all need them.
        """
        key = rho.tobytes()
        found = self._expected.pop(key, None)
        if found is None:
            found = self._expect(rho)
            if len(self._expected) >= EXPECTED_KEPT:
                del self._expected[next(iter(self._expected))]
        self._expected[key] = found  # the last one is the newest
        return found.copy()

    def _expect(self, rho: Floats, alike: Matrix | None = None) -> Matrix:
        """Expected initial states; what poses do not show as in `alike`, where rho makes no difference to it."""
        states = self._shown_alike(self._observed[0], np.zeros(len(rho)), rho)
        if self._hidden and alike is not None:
            states[:, self._hidden] = alike[:, self._hidden]
        elif self._hidden:
            acting = self._controls.before(rho)
            order, lane = acting.window, acting.lane
            before = self.problem.dynamics.simulate(states[order], acting.controls, rho, acting.h)[-1][lane]
            states[:, self._hidden] = before[:, self._hidden]
        return np.hstack([states, np.zeros((len(states), len(self._varying)))])

    @cached_property
    def _hidden(self) -> list[int]:
        """Components of the state that poses do not show."""
        vehicle = self.problem.parameters.vehicle
        shown = {speed_index(vehicle), *(vehicle.index(name) for name in ("x", "y", "theta", *YAW_RATES))}
        return [k for k in range(self._nx) if k not in shown]

    @cached_property
    def _moves_hidden(self) -> Bools:
        """(np,) which components of rho make a difference to what poses do not show."""
        moved = self.problem.dynamics.causes(self._hidden)
        moved[self._controls.components] = True
        return moved

    def with_rho(self, point: Point, rho: Floats) -> Point:
        """The point with other parameters: the same poses, and initial states as far from the expected ones."""
        change = self.prior_states(rho) - self.prior_states(point.rho)
        return replace(point, states=self._shifted(point.states, point.rho, rho, change), rho=rho)

    def _shifted(self, states: Matrix, before: Floats, rho: Floats, change: Matrix) -> Matrix:
        moved = self._shown_alike(states, before, rho)
        moved[:, self._hidden] += change[:, self._hidden]
        return moved

    def _shown_alike(self, states: Matrix, before: Floats, rho: Floats) -> Matrix:
        """States moved so that they show with `rho` the poses that they show with `before`; zeros show themselves."""
        observation, vehicle = self.problem.observation, self.problem.parameters.vehicle
        shown, moved = observation.predict(states, before), states.copy()
        for k, name in ((2, "theta"), (0, "x"), (1, "y")):  # the yaw first: a lever turns with it
            if name in vehicle.state:
                moved[:, vehicle.index(name)] += shown[:, k] - observation.predict(moved, rho)[:, k]
        return moved

    def start(self, rho: Floats) -> Point:
        """Point with given parameters, each window beginning as the smoothed poses do."""
        return Point(self.prior_states(rho), np.empty((0, 0)), rho.copy())

    def predict(self, start: Matrix, rho: Floats) -> Floats:
        """Poses (W, n, 3) of all windows from their unknowns `start` (W, nx + nv) with rho (np,)."""
        poses = np.empty((*self.windows.since.shape, 3))
        acting, step, share = self._controls.during(rho)
        states = self._simulated(start, rho, acting)
        self.problem.observation.of_windows(states, acting.lane, step, share, rho, poses)
        return poses

    def _simulated(self, start: Matrix, rho: Floats, acting: Acting) -> Floats:
        """States (parts + 1, W, nx) of all windows, by lane, from their unknowns (W, nx + nv)."""
        model = self.problem.parameters.model_values(rho)
        values, by_lane = np.empty((len(start), len(model))), start[acting.window]
        values[:] = model
        values[:, self._varying] += by_lane[:, self._nx :]
        states = np.ascontiguousarray(by_lane[:, : self._nx])
        return self.problem.dynamics.simulate(states, acting.controls, rho, acting.h, values)

    def trajectories(self, point: Point) -> Matrix:
        """States (S, nx) of all windows at their steps."""
        acting = self._controls.during(point.rho)[0]
        states, steps = self._simulated(point.states, point.rho, acting), self.problem.chains.steps
        found = np.split(acting.first, np.cumsum(steps)[:-1])
        return np.concatenate([states[np.append(f, -1), i] for f, i in zip(found, acting.lane, strict=True)])

    def residuals(self, point: Point) -> Floats:
        """(W, n, 3) predicted less observed, 0 where there is no pose."""
        off: Floats = (self.predict(point.states, point.rho) - self.windows.poses) * self.windows.seen[..., None]
        if not self.problem.observation.turns:
            off[..., 2] = 0.0
        return off

    def cost(self, point: Point) -> float:
        """Half of the sum of squared residuals in standard deviations, with the robust loss for poses."""
        off = (point.states - self.prior_states(point.rho))[:, : self._nx] / self._observed[1]
        means, varied = self._means(point.states)
        share = self._misfit(self.residuals(point)) / MISFIT_FREEDOM
        total = 0.5 * float(np.sum(self._counts * (MISFIT_FREEDOM + 1.0) * np.log1p(share)))
        total += 0.5 * float(np.sum(varied**2 * self._within) + np.sum(means**2 * self._between))
        total += 0.5 * float(np.sum(off**2) + np.sum(self.problem.prior_residuals(point.rho) ** 2))
        return total if np.isfinite(total) else np.inf

    def _means(self, states: Matrix) -> tuple[Matrix, Matrix]:
        """Best means (folds, nv) of the parameters that vary, and the deviations (W, nv) of the windows from them."""
        deviations, fold = states[:, self._nx :], self.windows.fold
        means = np.zeros((self.windows.folds, deviations.shape[1]))
        np.add.at(means, fold, deviations * self._within)
        means /= np.bincount(fold, minlength=len(means))[:, None] * self._within + self._between
        return means, deviations - means[fold]

    @cached_property
    def _counts(self) -> Floats:
        """(W,) number of poses seen."""
        counts: Floats = np.maximum(self.windows.seen.sum(axis=1), 1).astype(np.float64)
        return counts

    def _misfit(self, off: Floats) -> Floats:
        """(W,) mean squared residual of each window in standard deviations, outliers limited."""
        misfit: Floats = 2.0 * self.noise.losses(self.noise.distance(off, self.sigmas)).sum(axis=1) / self._counts
        return misfit

    def linearise(self, point: Point, again: bool = True) -> None:
        """Residuals, and derivatives of all of them by differences: every window once per component, in one rollout.

        Derivatives are kept if not `again`: near the optimum weights and residuals change, and these hardly do.
        """
        self._point = point
        if not again:
            self._off = self.residuals(point)
            return
        nx, p = self._nx + len(self._varying), self.problem.parameters
        changes = DIFFERENCE_STEP * np.maximum(np.abs(point.rho), 0.1)
        changes = np.where(point.rho + changes > p.high, -changes, changes)
        pose = [p.vehicle.index(name) for name in ("x", "y", "theta") if name in p.vehicle.state]
        others = [k for k in range(nx) if k not in pose]
        changed = [point.rho + changes * (np.arange(len(changes)) == k) for k in self._free.tolist()]
        for rho in changed:  # kept, so that threads only read
            self._controls.during(rho)
            if self._hidden:
                self._controls.before(rho)
        base, known = self.predict(point.states, point.rho), self.prior_states(point.rho)
        self._off = (base - self.windows.poses) * self.windows.seen[..., None]
        self._slopes = np.zeros((nx + len(changed), *base.shape))

        def by_state(k: int) -> None:
            moved = self.predict(point.states + DIFFERENCE_STEP * (np.arange(nx) == k), point.rho)
            self._slopes[k] = (moved - base) / DIFFERENCE_STEP

        def by_rho(i: int) -> None:
            k, rho = self._free[i], changed[i]
            change = self._expect(rho, None if self._moves_hidden[k] else known) - known
            states = self._shifted(point.states, point.rho, rho, change)  # a lever turns about the tracked point
            self._slopes[nx + i] = (self.predict(states, rho) - base) / changes[k]

        in_parallel(by_state, others)
        in_parallel(by_rho, range(len(changed)))
        self._by_pose(base)
        if not self.problem.observation.turns:
            self._off[..., 2] = 0.0

    def _by_pose(self, base: Floats) -> None:
        """Derivatives by the initial pose: the motion moves and turns with it."""
        vehicle = self.problem.parameters.vehicle
        self._slopes[vehicle.index("x"), ..., 0] = self._slopes[vehicle.index("y"), ..., 1] = 1.0
        if vehicle.index("theta") >= 0:
            centre = self._point.states[:, [vehicle.index("x"), vehicle.index("y")]]
            arm, turned = base[..., :2] - centre[:, None], self._slopes[vehicle.index("theta")]
            turned[..., 0], turned[..., 1], turned[..., 2] = -arm[..., 1], arm[..., 0], 1.0

    def _squares(self) -> Floats:
        """(W, unknowns + 1, unknowns + 1) sums of weighted products of the derivatives, the last being residuals."""
        trust = (MISFIT_FREEDOM + 1.0) / (MISFIT_FREEDOM + self._misfit(self._off))
        weight = trust[:, None] * self.noise.weights(self.noise.distance(self._off, self.sigmas)) * self.windows.seen
        root = np.sqrt(weight)[..., None] / self.sigmas
        size, count = len(self._slopes), len(root)

        def of_some(first: int) -> Floats:
            own = slice(first, first + CHUNK)
            scaled = np.empty((size + 1, *root[own].shape))
            np.multiply(self._slopes[:, own], root[own], out=scaled[:-1])
            np.multiply(self._off[own], root[own], out=scaled[-1])
            lanes = np.moveaxis(scaled.reshape(*scaled.shape[:2], -1), 1, 0)
            found: Floats = lanes @ np.swapaxes(lanes, 1, 2)
            return found

        return np.concatenate(in_parallel(of_some, range(0, count, CHUNK)))

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate the windows, then the means of the drives; `damping` raises the windows' information by that share.

        With rho the means are the columns of the windows' factors; their prior connects them to the windows.
        """
        nx, nv, free, count = self._nx, len(self._varying), self._free, len(self.windows.segments)
        known, squares = len(free), self._squares()
        slopes = squares[:, :-1, -1]
        self._mean, varied = self._means(self._point.states)
        prior = np.hstack([self._observed[1] ** -2.0, np.tile(self._within, (count, 1))])
        deviation = self._point.states - self.prior_states(self._point.rho)
        deviation[:, nx:] = varied
        diagonal, ends, own_states = np.arange(nx + nv), np.arange(nv), slice(0, nx + nv)
        information = squares[:, own_states, own_states].copy()
        information[:, diagonal, diagonal] += prior
        information[:, diagonal, diagonal] *= 1.0 + damping
        cross, own = np.zeros((count, nx + nv, known + nv)), np.zeros((count, known + nv, known + nv))
        slope = np.zeros((count, known + nv))
        cross[:, :, :known] = squares[:, own_states, nx + nv : -1]
        cross[:, nx + ends, known + ends] = -self._within
        own[:, :known, :known] = squares[:, nx + nv : -1, nx + nv : -1]
        own[:, known + ends, known + ends] = self._within
        slope[:, :known] = slopes[:, nx + nv :]
        slope[:, known:] = -varied * self._within
        gradient = slopes[:, own_states] + prior * deviation
        self._solved = np.linalg.solve(information, np.concatenate([cross, gradient[..., None]], axis=2))
        own -= np.swapaxes(cross, 1, 2) @ self._solved[..., :-1]
        slope -= np.einsum("wxr,wx->wr", cross, self._solved[..., -1])
        factors = RhoFactors.with_priors(*self._reduce_means(own, slope), self.problem, self._point.rho)
        return replace(factors, window_gradient=self._window_gradient(slope))

    def _window_gradient(self, slope: Matrix) -> Matrix:
        """Gradient (W, np) of rho by each window without the means of the drives."""
        known, found = len(self._free), np.zeros((len(slope), len(self._point.rho)))
        follow = self._mean_solved[self.windows.fold, :, :-1]
        found[:, self._free] = slope[:, :known] - np.einsum("wv,wvr->wr", slope[:, known:], follow)
        return found

    def _reduce_means(self, own: Floats, slope: Matrix) -> tuple[Floats, Matrix]:
        """Information (folds, np, np) and gradient (folds, np) of rho without the means of the drives."""
        free, size, folds = self._free, len(self._point.rho), self.windows.folds
        known, ends = len(free), len(free) + np.arange(len(self._varying))
        full, slopes = np.zeros((folds, size, size)), np.zeros((folds, size))
        self._mean_solved = np.zeros((folds, len(ends), known + 1))
        self._mean_spread = np.zeros((folds, len(ends)))
        for fold in range(folds):
            chosen = self.windows.fold == fold
            joint, gradient = own[chosen].sum(axis=0), slope[chosen].sum(axis=0)
            joint[ends, ends] += self._between
            gradient[ends] += self._mean[fold] * self._between
            inverse = np.linalg.inv(joint[known:, known:])
            solved = inverse @ np.column_stack([joint[known:, :known], gradient[known:]])
            self._mean_solved[fold], self._mean_spread[fold] = solved, np.diag(inverse)
            full[fold][np.ix_(free, free)] = joint[:known, :known] - joint[:known, known:] @ solved[:, :-1]
            slopes[fold, free] = gradient[:known] - joint[:known, known:] @ solved[:, -1]
        return full, slopes

    def found_growth(self, point: Point) -> Floats:
        """(3,) growth of the model's error in x, y and yaw per second, from typical residuals at a point."""
        windows = self.windows
        late = windows.seen & (windows.since > 0.1 * windows.since.max())
        off, since = self.residuals(point)[late], windows.since[late]
        square = off**2 / since[:, None] ** 2
        square = np.mean(np.minimum(square, np.quantile(square, LARGE_SHARE, axis=0)), axis=0)
        square -= np.mean(1.0 / since**2) * self.noise.pose_sigmas**2
        position = max(0.5 * (square[0] + square[1]), 0.0)
        growth: Floats = np.sqrt([position, position, max(square[2], 0.0)])
        return growth

    def found_variation(self, states: Matrix) -> Variation:
        """Variation of the means of the drives as of the windows reduced last.

        Squared means over the number of them that the data show (MacKay: Bayesian interpolation, Neural
        Computation 4, 1992, eq. 4.9).
        """
        means, before = self._means(states)[0], self.variation.between
        shown = np.maximum(np.sum(1.0 - self._mean_spread * self._between, axis=0), 1.0)
        found = np.sqrt(np.sum(means**2, axis=0) / shown)
        return Variation.of(self.variation.names, np.clip(found, VARIATION_MIN * before, before / VARIATION_MIN))

    def moved(self, change: Floats) -> Point:
        """Point with rho changed, each window beginning at the best of the linearised problem."""
        rho, known = self.problem.parameters.within_bounds(self._point.rho + change), len(self._free)
        means = -(self._mean_solved[..., :-1] @ change[self._free] + self._mean_solved[..., -1])
        step = -(self._solved[..., :known] @ change[self._free] + self._solved[..., -1])
        step -= np.einsum("wxv,wv->wx", self._solved[..., known:-1], means[self.windows.fold])
        found = self.with_rho(self._point, rho)
        return replace(found, states=found.states + step)


def fit(
    graph: MultiStep,
    start: Point,
    most: int,
    on_step: OnStep = ignore_step,
    tolerance: float = CONVERGED,
) -> Optimum:
    """Minimise the cost within the bounds of the parameters, in at most `most` steps (Levenberg-Marquardt).

    The fit has converged after two steps that decrease the cost by a share of at most `tolerance`, or if no step
    from the exact linearisation decreases it, however short.

    Some terms act with the square of their parameter, such as `saturation`: near 0 the derivatives do not show it, and
    its prior moves it as far as if it had no effect.  A step that is refused is tried without such parameters, since
    a damping that makes theirs short makes those of all others short too.
    """
    p = graph.problem.parameters
    point, cost, damping, converged, iterations = start, graph.cost(start), DAMPING_INITIAL, False, 0
    small, fresh = False, True
    graph.linearise(point)
    while iterations < most and not converged:
        factors = graph.reduce(damping)
        low, high = p.low - point.rho, p.high - point.rho
        candidate = graph.moved(bounded_step(factors, damping, low, high, p.free))
        lower, led = graph.cost(candidate), p.free & factors.led_by_prior
        if lower > cost and led.any():
            candidate = graph.moved(bounded_step(factors, damping, low, high, p.free & ~led))
            lower = graph.cost(candidate)
        if lower <= cost:
            before, small = small, cost - lower <= tolerance * cost
            iterations, converged = iterations + 1, before and small and fresh
            fresh = not converged and (small or cost - lower > NEARLY_LINEAR * cost)
            point, cost, damping = candidate, lower, max(0.2 * damping, DAMPING_MIN)
            graph.linearise(point, again=fresh)
            on_step(iterations, cost)
        elif not fresh:
            graph.linearise(point)
            fresh = True
        else:
            damping, converged = 5.0 * damping, damping > DAMPING_MAX
    return Optimum(point, cost, converged, iterations, graph.reduce(0.0))
