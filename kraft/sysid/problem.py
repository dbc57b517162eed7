"""The least-squares problem of Sec. IV-A: unknowns, residuals and cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.chains import Chains, Segment, chains_of
from kraft.sysid.dynamics import Dynamics
from kraft.sysid.initial_values import SmoothedPoses, initial_states
from kraft.sysid.observation import NoiseModel, Observation
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Matrix


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
    observation: Observation
    noise: NoiseModel

    def at_poses(self, states: Matrix) -> Matrix:
        """States (n, nx) interpolated at the times of the poses."""
        at = self.chains.state[self.chains.step]
        share = self.chains.share[:, None]
        result: Matrix = (1.0 - share) * states[at] + share * states[at + 1]
        return result

    def pose_residuals(self, point: Point) -> Matrix:
        """(n, 3) predicted less observed."""
        return self.observation.residual(self.at_poses(point.states), point.rho, self.chains.poses)

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
        """Half of the sum of squared residuals in standard deviations, with the robust loss for poses."""
        variance = self.noise.process**2 * self.chains.h[:, None]
        squares = np.sum(self.dynamics_residuals(point) ** 2 / variance)
        squares += np.sum((self.control_residuals(point) / self.noise.control) ** 2)
        squares += np.sum(self.prior_residuals(point.rho) ** 2)
        return float(0.5 * squares) + self.noise.loss(self.pose_residuals(point))


def assemble(segments: Sequence[Segment], logs: int, parameters: Parameters, noise: NoiseModel) -> Problem:
    """The least-squares problem of segments of `logs` logs."""
    return Problem(
        parameters,
        chains_of(segments, logs),
        ActuatorModel(segments, parameters),
        Dynamics(parameters),
        Observation(parameters),
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
    steps = np.diff(chains.first) - 1
    found = np.zeros((int(steps.max()), len(steps), controls.shape[1]))
    for c, count in enumerate(steps):
        begin = int(chains.first[c]) - c  # of its steps
        found[:count, c] = controls[begin : begin + count]
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
    return float(np.median(squares) / (chi2.median(shown) * max(1.0 - taken, 0.1)))
