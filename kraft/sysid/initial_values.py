"""Initial values from the data alone: smoothed poses, parameters by search over their bounds, speeds by simulation.

Each part of a log is simulated from its beginning.  The displacement of the model in windows of one second, in the
frame of the first pose of each, is compared with that of the smoothed poses.  Errors therefore do not accumulate over a
log, and the hidden components of the state (speeds) follow from the commands.  Many parameter vectors are simulated
together, as lanes; the best few are refined.  The search works for any model whose motion is invariant to its pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kraft.sysid.chains import Chains
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.parameters import YAW_RATES, Parameters, speed_index
from kraft.sysid.smoothing import smoothed
from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.vehicle import Vehicle

COMPARED_LENGTH = 1.0
"""Length of the windows that are compared, s."""
CANDIDATES = 128
"""Number of values of the parameters, spread evenly between their bounds, that are compared, ..."""
REFINED = 6
"""... of the best ones that are refined, ..."""
REFINEMENT_ITERATIONS = 12
"""... and of the steps of that."""
CHAINS_MAX, STEPS_MAX = 12, 400
"""Most chains and steps that the search uses; more would hardly improve the initial values."""
LOGARITHMIC_RATIO = 5.0
"""Ratio of the bounds above which a parameter is searched on a logarithmic scale."""


@dataclass(frozen=True, eq=False)
class SmoothedPoses:
    """Smoothed poses and their rates at the states' times."""

    poses: Matrix
    """(S, 3)"""
    rates: Matrix
    """(S, 3)"""


def smooth_chains(chains: Chains) -> SmoothedPoses:
    """Smoothed poses of all chains."""
    found = [smoothed(s.part.pose_times[s.poses], s.part.poses[s.poses], s.times) for s in chains.segments]
    return SmoothedPoses(np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found]))


def initial_states(vehicle: Vehicle, at: Ints, data: SmoothedPoses) -> Matrix:
    """(n, nx) states at the poses of index `at` (n,), as far as the poses determine them."""
    states = np.zeros((len(at), len(vehicle.state)))
    poses, rates = data.poses[at], data.rates[at]
    states[:, vehicle.index("x")], states[:, vehicle.index("y")] = poses[:, 0], poses[:, 1]
    speed = np.hypot(rates[:, 0], rates[:, 1])
    if vehicle.index("theta") >= 0:
        states[:, vehicle.index("theta")] = poses[:, 2]
        speed = rates[:, 0] * np.cos(poses[:, 2]) + rates[:, 1] * np.sin(poses[:, 2])
    for k, name in enumerate(vehicle.state):
        if name in YAW_RATES:
            states[:, k] = rates[:, 2]
    if (k := speed_index(vehicle)) >= 0:
        states[:, k] = speed
    return states


class InitialSearch:
    """Search for parameters with which the displacements of simulated windows match the observed ones."""

    def __init__(
        self, parameters: Parameters, discrete_model: DiscreteModel, chains: Chains, data: SmoothedPoses, mean: Matrix
    ) -> None:
        """`mean` (N, nu) are the controls that act in the steps."""
        self._parameters, self._discrete_model = parameters, discrete_model
        steps, first_step = chains.steps, chains.first_step
        chosen = np.unique(np.linspace(0, len(steps) - 1, min(CHAINS_MAX, len(steps))).round().astype(int))
        longest = int(min(STEPS_MAX, steps[chosen].max()))
        self._start = initial_states(parameters.vehicle, chains.first[:-1], data)[chosen]
        self._h = np.array([chains.segments[c].h for c in chosen])
        self._u = np.zeros((longest, len(chosen), discrete_model.nu))
        index, lane = [], []
        for place, c in enumerate(chosen):
            count = min(longest, int(steps[c]))
            begin = int(first_step[c])
            self._u[:count, place] = mean[begin : begin + count]
            width = max(1, min(round(COMPARED_LENGTH / self._h[place]), count))
            windows = np.arange(0, count - width + 1, max(1, width // 2))
            index.append(np.column_stack([windows, windows + width]))
            lane.append(np.full(len(windows), place))
        self._index: Ints = np.concatenate(index)
        self._lane: Ints = np.concatenate(lane)
        offset = chains.first[chosen][self._lane]
        self._pose = [parameters.vehicle.index(name) for name in ("x", "y", "theta")]
        before, after = (self._turning(data.poses[offset + self._index[:, k]]) for k in (0, 1))
        self._observed = observed = _displacement(before, after)
        typical = np.median(np.hypot(observed[:, 0], observed[:, 1]))
        self._scale = np.array([0.05 * typical + 0.005, 0.05 * typical + 0.005, 0.05 * np.std(observed[:, 2]) + 0.01])

    def best(self) -> Floats:
        """The parameters rho (np,) that fit the windows best; frozen and auxiliary ones keep their values."""
        free = self._parameters.free.copy()
        free[self._parameters.model_size :] = False
        if not free.any():
            return self._parameters.nominal.copy()
        candidates = self._candidates(free)
        order = np.argsort(_loss(self._residuals(candidates)))
        return self._refine(candidates[order[:REFINED]], free)

    def _candidates(self, free: Bools) -> Matrix:
        p = self._parameters
        low, high = p.low[free], p.high[free]
        logarithmic = (low > 0.0) & (high > LOGARITHMIC_RATIO * low)
        unit = _halton(len(low), CANDIDATES)[1:]
        lower = np.where(logarithmic, np.log(np.where(logarithmic, low, 1.0)), low)
        upper = np.where(logarithmic, np.log(np.where(logarithmic, high, 1.0)), high)
        values = lower + unit * (upper - lower)
        spread = np.tile(p.nominal, (CANDIDATES, 1))  # the last candidate remains nominal
        spread[:-1, free] = np.where(logarithmic, np.exp(np.where(logarithmic, values, 0.0)), values)
        return spread

    def _refine(self, rho: Matrix, free: Bools) -> Floats:
        """Damped Gauss-Newton steps of several starts together, under the Cauchy loss."""
        p, count, columns = self._parameters, len(rho), np.flatnonzero(free)
        change = 1e-4 * np.maximum(np.abs(p.high - p.low), 1e-6)
        damping = np.full(count, 1e-2)
        residual = self._residuals(rho)
        loss = _loss(residual)
        for _ in range(REFINEMENT_ITERATIONS):
            moved = np.repeat(rho, len(columns), axis=0)
            for j, column in enumerate(columns):
                moved[j :: len(columns), column] += change[column]
            there = self._residuals(moved).reshape(count, len(columns), -1)
            jacobian = (there - residual[:, None]) / change[columns][:, None]  # (count, columns, residuals)
            weight = 1.0 / (1.0 + residual**2)
            normal = np.einsum("cir,cjr,cr->cij", jacobian, jacobian, weight)
            gradient = np.einsum("cir,cr->ci", jacobian, weight * residual)
            diagonal = np.einsum("cii->ci", normal) + 1e-12
            step = np.zeros_like(gradient)
            for c in range(count):
                step[c] = np.linalg.solve(normal[c] + np.diag(damping[c] * diagonal[c]), -gradient[c])
            candidate = rho.copy()
            candidate[:, columns] = np.clip(rho[:, columns] + step, p.low[columns], p.high[columns])
            residual_there = self._residuals(candidate)
            loss_there = _loss(residual_there)
            better = loss_there < loss
            rho = np.where(better[:, None], candidate, rho)
            residual = np.where(better[:, None], residual_there, residual)
            gained = np.max(np.where(better, loss - loss_there, 0.0))
            loss = np.where(better, loss_there, loss)
            damping = np.where(better, 0.1 * damping, 10.0 * damping)
            if gained < 1e-6 and damping.min() > 1.0:
                break
        result: Floats = rho[np.argmin(loss)]
        return result

    def _residuals(self, rho: Matrix) -> Matrix:
        """(candidates, residuals) of parameter vectors (candidates, np)."""
        count, lanes = len(rho), len(self._start)
        own = np.array([self._parameters.model_values(r) for r in rho])
        states = self._discrete_model.simulate(
            np.tile(self._start, (count, 1)),
            np.ascontiguousarray(np.tile(self._u, (1, count, 1))),
            np.repeat(own, lanes, axis=0),
            np.tile(self._h, count),
        )
        lane = self._lane[None] + lanes * np.arange(count)[:, None]
        before, after = (self._pose_of(states[self._index[:, k][None], lane]) for k in (0, 1))
        displacement = _displacement(before, after)
        residuals = (displacement - self._observed) / self._scale
        residuals = np.nan_to_num(residuals, nan=1e6, posinf=1e6, neginf=-1e6)
        limited: Matrix = np.clip(residuals, -1e6, 1e6).reshape(count, -1)
        return limited

    def _pose_of(self, states: Floats) -> Floats:
        return self._turning(states[..., self._pose])

    def _turning(self, poses: Floats) -> Floats:
        """Poses (..., 3), with a yaw of 0 if the state has none: its logged yaw is unrelated to its path."""
        return poses if self._pose[2] >= 0 else poses * [1.0, 1.0, 0.0]


def _halton(dimensions: int, count: int) -> Matrix:
    """(count, dimensions) the first points of Halton's sequence in [0, 1): digits of their index, mirrored.

    As `scipy.stats.qmc.Halton` without scrambling, which takes a second to load.
    """
    bases = [n for n in range(2, 16 * (dimensions + 1)) if all(n % d for d in range(2, math.isqrt(n) + 1))][:dimensions]
    found = np.zeros((count, dimensions))
    for k, base in enumerate(bases):
        left, share = np.arange(count), 1.0
        while left.any():
            share /= base
            found[:, k] += share * (left % base)
            left //= base
    return found


def _displacement(before: Floats, after: Floats) -> Floats:
    """(..., 3) displacement from one pose to another, in the frame of the first."""
    c, s = np.cos(before[..., 2]), np.sin(before[..., 2])
    d = after - before
    return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], d[..., 2]], axis=-1)


def _loss(residuals: Matrix) -> Floats:
    """Cauchy loss of each candidate (candidates,), which limits the influence of windows with outliers."""
    loss: Floats = np.mean(np.log1p(residuals**2), axis=1)
    return loss
