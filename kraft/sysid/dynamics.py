"""The model's steps with friction of the drive, which the model does not know.

While the vehicle moves, friction takes its share of the throttle away, whatever is commanded: also of none, so that a
coasting vehicle comes to rest sooner than a lag alone would bring it there.  A dead band cannot do that.  What is left
of the full throttle counts as full: the model's speed at full throttle stays what it says.

Friction follows the speed at the end of a step, not at its beginning (implicit Euler's rule): however much it is, it
brings a vehicle to rest and never throws it back.
"""

from __future__ import annotations

import numpy as np

from kraft.sysid.auxiliary import speed_index
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.specialise import step_kernels
from ompl_ext.vehicle import Vehicle

BREAKAWAY = 0.05
"""Share of the top speed over which friction rises from nothing: smooth, so that it has derivatives at standstill."""
SENSE_TOLERANCE = 1e-10
"""Of the sense of motion, between -1 and 1."""
SENSE_ITERATIONS_MAX = 20
"""At finding it; two where the model's speed is linear in the throttle."""
DIFFERENCE_STEP = 1e-4
"""Change of a central difference, of what the component is about: errors of 1e-8 by curvature and 1e-12 by rounding."""


class Dynamics:
    """Steps of a vehicle's motion and their derivatives with respect to all of rho, of `nx` components."""

    def __init__(self, parameters: Parameters) -> None:
        """Load or compile the model's steps, and look up the friction."""
        vehicle = parameters.vehicle
        self._parameters, self.discrete_model = parameters, DiscreteModel(vehicle)
        self.nx, self.nu = self.discrete_model.nx, self.discrete_model.nu
        self._friction = parameters.auxiliary_index("friction")
        if self._friction >= 0:
            self._speed, self._breakaway = speed_index(vehicle), BREAKAWAY * vehicle.top_speed
            self._throttle = list(vehicle.controls).index("throttle")
            self._full = max(map(abs, vehicle.controls["throttle"]))

    def step(self, x: Matrix, u: Matrix, rho: Floats, h: Floats) -> Matrix:
        """States (n, nx) after steps of `h` (n,) s from `x` (n, nx) with controls `u` (n, nu) held."""
        return self.discrete_model.step(
            x, self._effective_controls(x, u, rho, h)[0], self._parameters.model_values(rho), h
        )

    def linearise(self, x: Matrix, u: Matrix, rho: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """The same, and derivatives (n, nx, nx + nu + np) with respect to state, control and rho."""
        own, count = self._parameters.model_size, self.nx + self.nu
        left, sense = self._effective_controls(x, u, rho, h)
        after, jacobian = self.discrete_model.linearise(x, left, self._parameters.model_values(rho), h)
        full = np.zeros((len(x), self.nx, count + len(rho)))
        full[:, :, : count + own] = jacobian[:, :, : count + own]
        if self._friction >= 0:
            share = self._remaining_share(rho)
            by_throttle = full[:, :, self.nx + self._throttle] / share
            full[:, :, self.nx + self._throttle] = by_throttle
            lost = (sense - u[:, self._throttle] / self._full) / share
            full[:, :, count + self._friction] = -by_throttle * lost[:, None]
            # all of these change the speed, that the sense, and that all components
            rising = rho[self._friction] * self._sense_slope(after[:, self._speed])
            follows = rising / (1.0 + rising * by_throttle[:, self._speed])
            full -= by_throttle[:, :, None] * (follows[:, None] * full[:, self._speed])[:, None, :]
        return after, full

    def simulate(self, start: Matrix, u: Floats, rho: Floats, h: Floats) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu) and steps of `h` (m,) s."""
        if self._friction < 0:
            own = np.tile(self._parameters.model_values(rho), (len(start), 1))
            return self.discrete_model.simulate(start, u, own, h)
        states = np.empty((len(u) + 1, *start.shape))
        states[0] = start
        for k, controls in enumerate(u):
            states[k + 1] = self.step(states[k], controls, rho, h)
        return states

    def _effective_controls(self, x: Matrix, u: Matrix, rho: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """Controls (n, nu) that friction leaves, and which way the vehicle moves (n,): 1 forward, -1 backward.

        The speed falls with the sense, and the sense rises with the speed, so there is one that fits: it is found along
        the line through the speeds for -1 and 1, then along parallels to it.
        """
        if self._friction < 0:
            return u, np.zeros(len(x))
        speeds = [self._speed_after(x, u, rho, h, np.full(len(x), side)) for side in (-1.0, 1.0)]
        middle, change = 0.5 * (speeds[0] + speeds[1]), 0.5 * (speeds[0] - speeds[1])
        sense = self._sense(middle, change)
        for _ in range(SENSE_ITERATIONS_MAX):
            found = self._sense(self._speed_after(x, u, rho, h, sense) + change * sense, change)
            off, sense = np.abs(found - sense).max(initial=0.0), found
            if off <= SENSE_TOLERANCE:
                break
        return self._less_friction(u, rho, sense), sense

    def _speed_after(self, x: Matrix, u: Matrix, rho: Floats, h: Floats, sense: Floats) -> Floats:
        """Speeds (n,) after the steps if the vehicle moves in this `sense` (n,)."""
        own = self._parameters.model_values(rho)
        speed: Floats = self.discrete_model.step(x, self._less_friction(u, rho, sense), own, h)[:, self._speed]
        return speed

    def _less_friction(self, u: Matrix, rho: Floats, sense: Floats) -> Matrix:
        """What friction leaves of controls: all of the full throttle, which drives as the model says."""
        left = u.copy()
        left[:, self._throttle] = (u[:, self._throttle] - rho[self._friction] * sense) / self._remaining_share(rho)
        return left

    def _remaining_share(self, rho: Floats) -> float:
        """What friction leaves of the full throttle."""
        return 1.0 - float(rho[self._friction]) / self._full

    def _sense(self, middle: Floats, change: Floats) -> Floats:
        """The sense s (n,) of the speed v = middle - change * s, by Newton's method.

        For v > 0 the left side of v + change * s(v) = middle is concave, so steps from below stay below its solution.
        """
        size, e = np.abs(middle), self._breakaway
        v = np.maximum(size - change, 0.0)
        for _ in range(SENSE_ITERATIONS_MAX):
            step = (size - v - change * v / np.hypot(v, e)) / (1.0 + change * self._sense_slope(v))
            v += step
            if np.abs(step).max(initial=0.0) <= SENSE_TOLERANCE * e:
                break
        sense: Floats = np.sign(middle) * v / np.hypot(v, e)
        return sense

    def _sense_slope(self, speed: Floats) -> Floats:
        """Derivative (n,) of the sense with respect to the speed, s/m."""
        slope: Floats = self._breakaway**2 / (speed**2 + self._breakaway**2) ** 1.5
        return slope


class DiscreteModel:
    """Steps of one vehicle's model, of `nx` state components, `nu` controls and `np` parameters."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Load or compile the steps."""
        self._kernels = step_kernels(vehicle)
        self._block = np.zeros(self._kernels.block)
        self.nx, self.nu, self.np = len(vehicle.state), len(vehicle.controls), len(vehicle.parameter_array)
        self._control_change = DIFFERENCE_STEP * np.ptp(vehicle.control_bounds, axis=1)

    def step(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> Matrix:
        """States (n, nx) after steps of `h` (n,) s from `x` (n, nx) with controls `u` (n, nu) held."""
        after = np.empty_like(x)
        self._kernels.linearise(x, u, p, h, np.empty(0), self._block, after, np.empty((0, 0, 0)))
        return after

    def linearise(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """The same, and derivatives (n, nx, nx + nu + np) with respect to state, control and parameters."""
        change = np.concatenate(
            [np.full(self.nx, DIFFERENCE_STEP), self._control_change, DIFFERENCE_STEP * np.maximum(np.abs(p), 0.05)]
        )
        after, jacobian = np.empty_like(x), np.zeros((len(x), self.nx, len(change)))
        self._kernels.linearise(x, u, p, h, change, self._block, after, jacobian)
        return after, jacobian

    def simulate(self, start: Matrix, u: Floats, p: Matrix, h: Floats) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu), `p` (m, np), `h` (m,)."""
        states = np.empty((len(u) + 1, *start.shape))
        self._kernels.simulate(start, u, p, h, self._block, states)
        return states
