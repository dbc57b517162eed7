"""The model's steps with friction of the drive, which the model does not know.

While the vehicle moves, friction takes its share of the throttle away, whatever is commanded: also of none, so that a
coasting vehicle comes to rest sooner than a lag alone would bring it there.  A dead band cannot do that.  What is left
of the full throttle counts as full: the model's speed at full throttle stays what it says.
"""

from __future__ import annotations

import numpy as np

from kraft.sysid.extras import speed_index
from kraft.sysid.motion import Motion
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Matrix

BREAKAWAY = 0.05
"""Share of the top speed over which friction rises from nothing: smooth, so that a step may go over standstill."""


class Dynamics:
    """Steps of a vehicle's motion and their derivatives with respect to all of rho, of `nx` components."""

    def __init__(self, parameters: Parameters) -> None:
        """Load or compile the model's steps, and look up the friction."""
        vehicle = parameters.vehicle
        self._parameters, self.motion = parameters, Motion(vehicle)
        self.nx, self.nu = self.motion.nx, self.motion.nu
        self._friction = parameters.extra("friction")
        if self._friction >= 0:
            self._speed, self._breakaway = speed_index(vehicle), BREAKAWAY * vehicle.top_speed
            self._throttle = list(vehicle.controls).index("throttle")
            self._full = vehicle.controls["throttle"][1]

    def after(self, x: Matrix, u: Matrix, rho: Floats, h: Floats) -> Matrix:
        """States (n, nx) after steps of `h` (n,) s from `x` (n, nx) with controls `u` (n, nu) held."""
        return self.motion.after(x, self._left(x, u, rho), self._parameters.model_values(rho), h)

    def linearise(self, x: Matrix, u: Matrix, rho: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """The same, and derivatives (n, nx, nx + nu + np) with respect to state, control and rho."""
        own, count = self._parameters.own, self.nx + self.nu
        after, jacobian = self.motion.linearise(x, self._left(x, u, rho), self._parameters.model_values(rho), h)
        full = np.zeros((len(x), self.nx, count + len(rho)))
        full[:, :, : count + own] = jacobian[:, :, : count + own]
        if self._friction >= 0:
            share = self._share(rho)
            by_throttle = full[:, :, self.nx + self._throttle]
            by_throttle /= share
            rising = self._breakaway**2 / (x[:, self._speed] ** 2 + self._breakaway**2) ** 1.5
            full[:, :, self._speed] -= by_throttle * (rho[self._friction] * rising)[:, None]
            lost = (self._sense(x) - u[:, self._throttle] / self._full) / share
            full[:, :, count + self._friction] = -by_throttle * lost[:, None]
        return after, full

    def simulate(self, start: Matrix, u: Floats, rho: Floats, h: Floats) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu) and steps of `h` (m,) s."""
        if self._friction < 0:
            own = np.tile(self._parameters.model_values(rho), (len(start), 1))
            return self.motion.simulate(start, u, own, h)
        states = np.empty((len(u) + 1, *start.shape))
        states[0] = start
        for k, controls in enumerate(u):
            states[k + 1] = self.after(states[k], controls, rho, h)
        return states

    def _left(self, x: Matrix, u: Matrix, rho: Floats) -> Matrix:
        """Controls (n, nu) that friction leaves: all of the full throttle, which drives as the model says."""
        if self._friction < 0:
            return u
        left = u.copy()
        left[:, self._throttle] -= rho[self._friction] * self._sense(x)
        left[:, self._throttle] /= self._share(rho)
        return left

    def _share(self, rho: Floats) -> float:
        """What friction leaves of the full throttle."""
        return 1.0 - float(rho[self._friction]) / self._full

    def _sense(self, x: Matrix) -> Floats:
        """Which way the vehicle moves (n,): 1 forward, -1 backward, between them about standstill."""
        speed = x[:, self._speed]
        sense: Floats = speed / np.sqrt(speed**2 + self._breakaway**2)
        return sense
