"""The vehicle's compiled steps with the arrays they need: many steps at once, as numpy sees them."""

from __future__ import annotations

import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.specialise import step_kernels
from ompl_ext.vehicle import Vehicle

CHANGE = 1e-4
"""Change of a central difference, of what the component is about: errors of 1e-8 by curvature and 1e-12 by rounding."""


class Motion:
    """Steps of one vehicle's model, of `nx` state components, `nu` controls and `np` parameters."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Load or compile the steps."""
        self._kernels = step_kernels(vehicle)
        self._block = np.zeros(self._kernels.block)
        self.nx, self.nu, self.np = len(vehicle.state), len(vehicle.controls), len(vehicle.parameter_array)
        self._control_change = CHANGE * np.ptp(vehicle.control_bounds, axis=1)

    def after(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> Matrix:
        """States (n, nx) after steps of `h` (n,) s from `x` (n, nx) with controls `u` (n, nu) held."""
        after = np.empty_like(x)
        self._kernels.linearise(x, u, p, h, np.empty(0), self._block, after, np.empty((0, 0, 0)))
        return after

    def linearise(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """The same, and derivatives (n, nx, nx + nu + np) with respect to state, control and parameters."""
        change = np.concatenate([np.full(self.nx, CHANGE), self._control_change, CHANGE * np.maximum(np.abs(p), 0.05)])
        after, jacobian = np.empty_like(x), np.zeros((len(x), self.nx, len(change)))
        self._kernels.linearise(x, u, p, h, change, self._block, after, jacobian)
        return after, jacobian

    def simulate(self, start: Matrix, u: Floats, p: Matrix, h: Floats) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu), `p` (m, np), `h` (m,)."""
        states = np.empty((len(u) + 1, *start.shape))
        self._kernels.simulate(start, u, p, h, self._block, states)
        return states
