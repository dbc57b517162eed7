"""The least-squares problem of Sec. IV-A: what is unknown, and what a value of it costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kraft.sysid.chains import Chains
from kraft.sysid.commands import Commands
from kraft.sysid.dynamics import Dynamics
from kraft.sysid.noise_model import NoiseModel
from kraft.sysid.observation import Observation
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Matrix


@dataclass(frozen=True, eq=False)
class Point:
    """A value of everything that is unknown."""

    states: Matrix
    """(S, nx)"""
    controls: Matrix
    """(N, nu) applied in the steps"""
    rho: Floats
    """(np,)"""


@dataclass(frozen=True, eq=False)
class Problem:
    """Chains of data, the model that shall explain them, and what deviations cost."""

    parameters: Parameters
    chains: Chains
    commands: Commands
    dynamics: Dynamics
    observation: Observation
    noise: NoiseModel

    def between(self, states: Matrix) -> Matrix:
        """States (n, nx) at the poses, interpolated."""
        at = self.chains.state[self.chains.step]
        share = self.chains.share[:, None]
        result: Matrix = (1.0 - share) * states[at] + share * states[at + 1]
        return result

    def pose_residuals(self, point: Point) -> Matrix:
        """(n, 3) predicted less observed."""
        return self.observation.residual(self.between(point.states), point.rho, self.chains.poses)

    def dynamics_residuals(self, point: Point) -> Matrix:
        """(N, nx) next state less where the model leads."""
        x = point.states[self.chains.state]
        led = self.dynamics.after(x, point.controls, point.rho, self.chains.h)
        difference: Matrix = point.states[self.chains.state + 1] - led
        return difference

    def control_residuals(self, point: Point) -> Matrix:
        """(N, nu) applied controls less commands."""
        difference: Matrix = point.controls - self.commands.mean(point.rho)[0]
        return difference

    def prior_residuals(self, rho: Floats) -> Floats:
        """(np,) in standard deviations; 0 for frozen ones."""
        residuals: Floats = np.where(self.parameters.free, (rho - self.parameters.nominal) / self.parameters.std, 0.0)
        return residuals

    def cost(self, point: Point) -> float:
        """Half of the squared residuals in standard deviations, poses under the robust loss."""
        variance = self.noise.process**2 * self.chains.h[:, None]
        squares = np.sum(self.dynamics_residuals(point) ** 2 / variance)
        squares += np.sum((self.control_residuals(point) / self.noise.control) ** 2)
        squares += np.sum(self.prior_residuals(point.rho) ** 2)
        return float(0.5 * squares) + self.noise.loss(self.pose_residuals(point))
