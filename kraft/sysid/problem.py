"""The least-squares problem of Sec. IV-A: observation of poses, noise, unknowns, residuals and cost.

The pose observed between two states is that of the state interpolated between them.  Interpolation is linear, also of
the continuous yaw, so that the factor is linear in the states if the tracked point is the reference point of the model.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import chdtri, gammaincinv, ndtr

from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.chains import Chains, Segment, chains_of
from kraft.sysid.dynamics import Dynamics
from kraft.sysid.initial_values import SmoothedPoses, initial_states
from kraft.sysid.interface import Noise, Settings
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.jit import compiled
from ompl_ext.kernel_cache import cache_folder
from ompl_ext.vehicle import Vehicle

PROCESS_POSITION = 0.001
"""Process noise of the position, m per square root of a second."""
PROCESS_YAW = 0.002
"""Process noise of the yaw, rad per square root of a second."""
PROCESS_OTHER = 0.005
"""Process noise of a speed or another hidden component, in its unit per square root of a second."""
CONTROL_SHARE = 0.01
"""Standard deviation of the applied control from the command, as a share of the control's range."""


class ObservationModel:
    """Poses observed of a vehicle's states, with a lever arm and a yaw offset if rho has them."""

    def __init__(self, parameters: Parameters) -> None:
        """Look up the indices of the pose in the state and of the auxiliary parameters in rho."""
        self._np = len(parameters.names)
        self._x, self._y, self._theta = (parameters.vehicle.index(name) for name in ("x", "y", "theta"))
        self._lever, self._side, self._offset = (
            parameters.auxiliary_index(name) for name in ("lever", "side", "yaw_offset")
        )

    def offsets(self, rho: Floats) -> tuple[float, float, float]:
        """Lever (m), side (m) and yaw offset (rad) in rho, 0 for those that it lacks."""
        lever, side, yaw = (float(rho[k]) if k >= 0 else 0.0 for k in (self._lever, self._side, self._offset))
        return lever, side, yaw

    def predict(self, states: Matrix, rho: Floats) -> Matrix:
        """Poses (n, 3) observed of states (n, nx); yaw is 0 for a vehicle without yaw."""
        poses = np.zeros((len(states), 3))
        poses[:, 0], poses[:, 1] = states[:, self._x], states[:, self._y]
        if self._theta < 0:
            return poses
        yaw = states[:, self._theta]
        lever, side, offset = self.offsets(rho)
        poses[:, 2] = yaw + offset
        if lever != 0.0 or side != 0.0:
            c, s = np.cos(yaw), np.sin(yaw)
            poses[:, 0] += lever * c - side * s
            poses[:, 1] += lever * s + side * c
        return poses

    def of_windows(self, states: Floats, lane: Ints, step: Ints, share: Matrix, rho: Floats, out: Floats) -> None:
        """Write the poses `out` (W, n, 3) of the states (steps + 1, W, nx), at steps (W, n) and shares of them.

        The states of window w are those of `lane[w]`.
        """
        shown = np.array([self._x, self._y, self._theta], dtype=np.int64)
        poses_of_windows(states, lane, step, share, shown, np.array(self.offsets(rho)), out)

    def linearise(self, states: Matrix, rho: Floats) -> tuple[Matrix, Floats, Floats]:
        """Poses (n, 3) observed of states (n, nx), and their derivatives by state (n, 3, nx) and by rho (n, 3, np)."""
        poses = self.predict(states, rho)
        by_state, by_rho = np.zeros((len(states), 3, states.shape[1])), np.zeros((len(states), 3, self._np))
        by_state[:, 0, self._x] = by_state[:, 1, self._y] = 1.0
        if self._theta < 0:
            return poses, by_state, by_rho
        by_state[:, 2, self._theta] = 1.0
        if self._offset >= 0:
            by_rho[:, 2, self._offset] = 1.0
        if self._lever >= 0 or self._side >= 0:
            c, s = np.cos(states[:, self._theta]), np.sin(states[:, self._theta])
            lever, side, _ = self.offsets(rho)
            by_state[:, 0, self._theta] = -lever * s - side * c
            by_state[:, 1, self._theta] = lever * c - side * s
            if self._lever >= 0:
                by_rho[:, 0, self._lever], by_rho[:, 1, self._lever] = c, s
            if self._side >= 0:
                by_rho[:, 0, self._side], by_rho[:, 1, self._side] = -s, c
        return poses, by_state, by_rho

    @property
    def turns(self) -> bool:
        """Whether yaw is observed."""
        return self._theta >= 0

    def residual(self, predicted: Matrix, poses: Matrix) -> Matrix:
        """Predicted less observed poses (n, 3)."""
        difference = predicted - poses
        if not self.turns:
            difference[:, 2] = 0.0
        return difference


def _poses_of_windows(
    states: Floats, lane: Ints, step: Ints, share: Matrix, shown: Ints, offset: Floats, out: Floats
) -> None:
    for w in range(step.shape[0]):
        i = lane[w]
        for j in range(step.shape[1]):
            k, e = step[w, j], share[w, j]
            x = (1.0 - e) * states[k, i, shown[0]] + e * states[k + 1, i, shown[0]]
            y = (1.0 - e) * states[k, i, shown[1]] + e * states[k + 1, i, shown[1]]
            yaw = 0.0
            if shown[2] >= 0:
                yaw = (1.0 - e) * states[k, i, shown[2]] + e * states[k + 1, i, shown[2]]
                if offset[0] != 0.0 or offset[1] != 0.0:
                    c, s = math.cos(yaw), math.sin(yaw)
                    x += offset[0] * c - offset[1] * s
                    y += offset[0] * s + offset[1] * c
                yaw += offset[2]
            out[w, j, 0], out[w, j, 1], out[w, j, 2] = x, y, yaw


poses_of_windows = compiled(
    _poses_of_windows, folder=cache_folder(f"poses-{hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]}")
)
"""poses_of_windows(states, lane, step, share, shown, offset, out): see `ObservationModel.of_windows`; `shown` (3,) are
the indices of x, y and yaw in the state, `offset` (3,) lever, side and yaw offset."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Standard deviations of poses, process and controls, and the threshold of the robust loss of a pose."""

    noise: Noise
    process: Floats
    """(nx,) standard deviations per square root of a second"""
    control: Floats
    """(nu,) standard deviations"""
    threshold: float
    """Mahalanobis distance of a pose above which its weight decreases; inf for no robust loss"""

    @cached_property
    def pose_sigmas(self) -> Floats:
        """(3,) x, y, yaw."""
        return np.array([self.noise.position, self.noise.position, self.noise.yaw])

    def distance(self, residuals: Floats, sigmas: Floats | None = None) -> Floats:
        """Mahalanobis distances (...) of pose residuals (..., 3); `sigmas` (..., 3) in place of those of the poses."""
        with np.errstate(over="ignore"):  # infinite after a step that diverged, which the optimiser refuses
            squares = (residuals / (self.pose_sigmas if sigmas is None else sigmas)) ** 2
            distance: Floats = np.sqrt(squares.sum(axis=-1))
        return distance

    def weights(self, distance: Floats) -> Floats:
        """Weight of poses at a `distance` (...) by the Huber loss: 1 up to the threshold, then decreasing with it."""
        if not self.robust:
            return np.ones_like(distance)
        weights: Floats = self.threshold / np.maximum(distance, self.threshold)
        return weights

    def losses(self, distance: Floats) -> Floats:
        """Huber loss of poses at a `distance` (...): half of its square up to the threshold, then linear."""
        inside = np.minimum(distance, self.threshold)
        losses: Floats = inside * (distance - 0.5 * inside)
        return losses

    @property
    def robust(self) -> bool:
        """Whether the loss of poses is robust."""
        return math.isfinite(self.threshold)


def noise_model(vehicle: Vehicle, settings: Settings, noise: Noise) -> NoiseModel:
    """The noise that the settings state, with defaults for what they leave open."""
    default = {"x": PROCESS_POSITION, "y": PROCESS_POSITION, "theta": PROCESS_YAW}
    process = [settings.process.get(name, default.get(name, PROCESS_OTHER)) for name in vehicle.state]
    control = [
        settings.control_noise.get(name, CONTROL_SHARE * (high - low)) for name, (low, high) in vehicle.controls.items()
    ]
    shown = 3 if vehicle.index("theta") >= 0 else 2
    return NoiseModel(noise, np.array(process), np.array(control), threshold(settings.robust, shown))


def threshold(robust: float | None, shown: int) -> float:
    """Threshold of the distance of `shown` residuals that inliers exceed as often as one residual exceeds `robust`."""
    if robust is None:
        return math.inf
    return math.sqrt(float(chdtri(shown, 2.0 * float(ndtr(-robust)))))


@dataclass(frozen=True, eq=False)
class Point:
    """Values of all unknowns."""

    states: Matrix
    """(S, nx)"""
    controls: Matrix
    """(N, nu) applied in the steps"""
    rho: Floats
    """(np,)"""


@dataclass(frozen=True, eq=False)
class Problem:
    """Chains of data, the models of dynamics, actuators and observation, and the noise."""

    parameters: Parameters
    chains: Chains
    actuators: ActuatorModel
    dynamics: Dynamics
    observation: ObservationModel
    noise: NoiseModel
    frames: Floats | None = None
    """(n, 3, 3) that take the residual of a pose to the directions and units of its noise; those of the pose if None"""

    def at_poses(self, states: Matrix) -> Matrix:
        """States (n, nx) interpolated at the times of the poses."""
        at = self.chains.state[self.chains.step]
        share = self.chains.share[:, None]
        result: Matrix = (1.0 - share) * states[at] + share * states[at + 1]
        return result

    def pose_residuals(self, point: Point) -> Matrix:
        """(n, 3) predicted less observed, in the directions and units of their noise."""
        return self._pose_residuals(self.observation.predict(self.at_poses(point.states), point.rho))

    def linearised_poses(self, point: Point) -> tuple[Matrix, Floats, Floats]:
        """Residuals (n, 3) of poses, and derivatives by the interpolated state (n, 3, nx) and by rho (n, 3, np)."""
        predicted, by_state, by_rho = self.observation.linearise(self.at_poses(point.states), point.rho)
        residuals = self._pose_residuals(predicted)
        if self.frames is None:
            return residuals, by_state, by_rho
        return residuals, np.ascontiguousarray(self.frames @ by_state), np.ascontiguousarray(self.frames @ by_rho)

    def _pose_residuals(self, predicted: Matrix) -> Matrix:
        residuals = self.observation.residual(predicted, self.chains.poses)
        return residuals if self.frames is None else np.einsum("nij,nj->ni", self.frames, residuals)

    def dynamics_residuals(self, point: Point) -> Matrix:
        """(N, nx) next state less the step of the model."""
        x = point.states[self.chains.state]
        predicted = self.dynamics.step(x, point.controls, point.rho, self.chains.h)
        difference: Matrix = point.states[self.chains.state + 1] - predicted
        return difference

    def control_residuals(self, point: Point) -> Matrix:
        """(N, nu) applied controls less commands."""
        difference: Matrix = point.controls - self.actuators.mean(point.rho)[0]
        return difference

    def prior_residuals(self, rho: Floats) -> Floats:
        """(np,) in standard deviations; 0 for frozen ones."""
        residuals: Floats = np.where(self.parameters.free, (rho - self.parameters.nominal) / self.parameters.std, 0.0)
        return residuals

    def cost(self, point: Point) -> float:
        """Cost of a point."""
        distance = self.noise.distance(self.pose_residuals(point))
        return self.cost_of(self.dynamics_residuals(point), self.control_residuals(point), distance, point.rho)

    def cost_of(self, dynamics: Matrix, control: Matrix, distance: Floats, rho: Floats) -> float:
        """Half of the sum of squared residuals in standard deviations, with the robust loss for poses.

        Of the residuals (N, nx) of the dynamics and (N, nu) of the controls, the distances (n,) of the poses, see
        `NoiseModel.distance`, and rho (np,).
        """
        variance = self.noise.process**2 * self.chains.h[:, None]
        with np.errstate(over="ignore"):  # as in `NoiseModel.distance`
            squares = (dynamics**2 / variance).sum()
            squares += ((control / self.noise.control) ** 2).sum()
            squares += (self.prior_residuals(rho) ** 2).sum()
        return float(0.5 * squares) + float(self.noise.losses(distance).sum())


def assemble(segments: Sequence[Segment], logs: int, parameters: Parameters, noise: NoiseModel) -> Problem:
    """The least-squares problem of segments of `logs` logs."""
    return Problem(
        parameters,
        chains_of(segments, logs),
        ActuatorModel(segments, parameters),
        Dynamics(parameters),
        ObservationModel(parameters),
        noise,
    )


def starting_point(problem: Problem, data: SmoothedPoses, rho: Floats) -> Point:
    """Initial point: smoothed poses, other components of the state simulated with rho, controls as commanded."""
    controls = problem.actuators.mean(rho)[0]
    states = simulated(
        problem, initial_states(problem.parameters.vehicle, problem.chains.first[:-1], data), controls, rho
    )
    for k, name in enumerate(("x", "y", "theta")):
        if name in problem.parameters.vehicle.state:
            states[:, problem.parameters.vehicle.index(name)] = data.poses[:, k]
    return Point(states, controls, rho.copy())


def simulated(problem: Problem, start: Matrix, controls: Matrix, rho: Floats) -> Matrix:
    """States (S, nx) of all chains, open loop from `start` (chains, nx) with `controls` (N, nu)."""
    h = np.array([s.h for s in problem.chains.segments])
    states = problem.dynamics.simulate(start, padded(controls, problem.chains), rho, h)
    return stacked(states, problem.chains)


def padded(controls: Matrix, chains: Chains) -> Floats:
    """Controls (most steps, chains, nu) of the steps of each chain, from (N, nu); zeros beyond its last step."""
    steps = chains.steps
    found = np.zeros((int(steps.max()), len(steps), controls.shape[1]))
    for c, (begin, end) in enumerate(pairwise(chains.first_step)):
        found[: end - begin, c] = controls[begin:end]
    return found


def stacked(states: Floats, chains: Chains) -> Matrix:
    """(S, nx) of states (most steps + 1, chains, nx)."""
    stacked: Matrix = np.concatenate([states[: s.steps + 1, c] for c, s in enumerate(chains.segments)])
    return stacked


def residual_ratio(problem: Problem, point: Point) -> float:
    """Ratio of the squared residual of a typical pose to its expectation under the stated noise.

    The median is robust to outliers; the expectation accounts for the degrees of freedom of the states.
    """
    squares = problem.noise.distance(problem.pose_residuals(point)) ** 2
    shown = 3.0 if problem.observation.turns else 2.0
    taken = problem.dynamics.nx * len(problem.chains.log) / (shown * len(squares))
    median = 2.0 * float(gammaincinv(0.5 * shown, 0.5))  # of the chi-squared distribution
    return float(np.median(squares) / (median * max(1.0 - taken, 0.1)))
