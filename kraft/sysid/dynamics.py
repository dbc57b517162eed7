"""Dynamics of the vehicle in discrete time: steps of the model, with the friction of its drive.

Friction of the drive is an auxiliary parameter.  While the vehicle moves, friction reduces the throttle by a
constant, even if no throttle is commanded, so that a coasting vehicle comes to rest sooner than with a lag alone.  A
dead band cannot model that.  The throttle that remains of the full throttle counts as full, so that the speed at full
throttle remains that of the model.  Friction depends on the speed at the end of a step, not at its beginning (implicit
Euler rule): friction of any size brings a vehicle to rest and never reverses it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kraft.sysid.parameters import Parameters, speed_index
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.kernels.specialise import step_kernels
from ompl_ext.vehicle import Vehicle

BREAKAWAY = 0.05
"""Share of the top speed over which friction rises from 0: smooth, so that it is differentiable at standstill."""
SENSE_TOLERANCE = 1e-10
"""Tolerance of the sense of motion, which is between -1 and 1."""
SENSE_ITERATIONS_MAX = 20
"""Most iterations for the sense of motion; two are needed where the speed is linear in the throttle."""
DIFFERENCE_STEP = 1e-4
"""Relative step of differences: central ones have errors of 1e-8 by curvature and of 1e-12 by rounding."""


PROBES = 8
"""Number of parameter vectors, and of states with each, at which dependences are sought.

At almost any point a slope tells the dependence; these 64 also leave the dead zones and limits, where it is zero.
"""


class Dynamics:
    """Steps of a vehicle's motion and their derivatives with respect to all of rho, of `nx` components."""

    def __init__(self, parameters: Parameters) -> None:
        """Load or compile the steps of the model, and look up the friction."""
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
        """States (n, nx) after the steps, and derivatives (n, nx, nx + nu + np) by state, control and rho."""
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
            # each argument changes the speed, the speed changes the sense, and the sense changes all components
            rising = rho[self._friction] * self._sense_slope(after[:, self._speed])
            follows = rising / (1.0 + rising * by_throttle[:, self._speed])
            full -= by_throttle[:, :, None] * (follows[:, None] * full[:, self._speed])[:, None, :]
        return after, full

    def causes(self, components: Sequence[int]) -> Bools:
        """Components (np,) of rho that move some components of the state, by differences at random points."""
        p, rng = self._parameters, np.random.default_rng(0)
        bounds, h = p.vehicle.control_bounds, np.full(PROBES, 0.05)
        moved = np.zeros((self.nx, self.nx + self.nu + len(p.names)), dtype=bool)
        for _ in range(PROBES):
            x, u = rng.uniform(-1.0, 1.0, (PROBES, self.nx)), rng.uniform(bounds[:, 0], bounds[:, 1], (PROBES, self.nu))
            slopes = self.linearise(x, u, rng.uniform(p.low, p.high), h)[1]
            moved |= np.any(slopes != 0.0, axis=0)
        own = np.isin(np.arange(self.nx), components)
        for _ in range(self.nx):  # and what moves those that move these
            own |= np.any(moved[own, : self.nx], axis=0)
        found: Bools = np.any(moved[own, self.nx + self.nu :], axis=0)
        return found

    def simulate(self, start: Matrix, u: Floats, rho: Floats, h: Floats, own: Matrix | None = None) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu) and steps of `h` s.

        `h` is (m,) or (steps, m).  `own` (m, np) are parameters of the model of each motion in place of those of rho.
        """
        own = np.tile(self._parameters.model_values(rho), (len(start), 1)) if own is None else own
        if self._friction < 0:
            return self.discrete_model.simulate(start, u, own, h)
        states = np.empty((len(u) + 1, *start.shape))
        states[0] = start
        for k, (controls, step) in enumerate(zip(u, np.broadcast_to(h, u.shape[:2]), strict=True)):
            left = self._effective_controls(states[k], controls, rho, step, own)[0]
            states[k + 1] = self.discrete_model.simulate(states[k], left[None], own, step)[1]
        return states

    def _effective_controls(
        self, x: Matrix, u: Matrix, rho: Floats, h: Floats, own: Matrix | None = None
    ) -> tuple[Matrix, Floats]:
        """Controls (n, nu) less friction, and the sense of motion (n,): 1 forward, -1 backward.

        The speed decreases with the sense, and the sense increases with the speed, so that the solution is unique.  The
        search starts on the line through the speeds for -1 and 1 and continues on parallels to it.
        """
        if self._friction < 0:
            return u, np.zeros(len(x))
        speeds = [self._speed_after(x, u, rho, h, np.full(len(x), side), own) for side in (-1.0, 1.0)]
        middle, change = 0.5 * (speeds[0] + speeds[1]), 0.5 * (speeds[0] - speeds[1])
        sense = self._sense(middle, change)
        for _ in range(SENSE_ITERATIONS_MAX):
            found = self._sense(self._speed_after(x, u, rho, h, sense, own) + change * sense, change)
            off, sense = np.abs(found - sense).max(initial=0.0), found
            if off <= SENSE_TOLERANCE:
                break
        return self._less_friction(u, rho, sense), sense

    def _speed_after(self, x: Matrix, u: Matrix, rho: Floats, h: Floats, sense: Floats, own: Matrix | None) -> Floats:
        """Speeds (n,) after the steps for a given `sense` (n,) of motion."""
        left = self._less_friction(u, rho, sense)
        if own is None:
            after = self.discrete_model.step(x, left, self._parameters.model_values(rho), h)
        else:
            after = self.discrete_model.simulate(x, left[None], own, h)[1]
        speed: Floats = after[:, self._speed]
        return speed

    def _less_friction(self, u: Matrix, rho: Floats, sense: Floats) -> Matrix:
        """Controls (n, nu) less friction, scaled so that the full throttle remains the full throttle."""
        left = u.copy()
        left[:, self._throttle] = (u[:, self._throttle] - rho[self._friction] * sense) / self._remaining_share(rho)
        return left

    def _remaining_share(self, rho: Floats) -> float:
        """Share of the full throttle that remains with friction."""
        return 1.0 - float(rho[self._friction]) / self._full

    def _sense(self, middle: Floats, change: Floats) -> Floats:
        """The sense s (n,) of the speed v = middle - change * s, by Newton's method.

        For v > 0 the left side of v + change * s(v) = middle is concave, so that steps from below stay below.
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
    """Steps of the model of one vehicle, with `nx` state components, `nu` controls and `np` parameters."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Load or compile the steps."""
        self._kernels = step_kernels(vehicle)
        self.nx, self.nu, self.np = len(vehicle.state), len(vehicle.controls), len(vehicle.parameter_array)
        self._control_change = DIFFERENCE_STEP * np.ptp(vehicle.control_bounds, axis=1)

    def step(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> Matrix:
        """States (n, nx) after steps of `h` (n,) s from `x` (n, nx) with controls `u` (n, nu) held."""
        after = np.empty_like(x)
        self._kernels.linearise(x, u, p, h, np.empty(0), self._block(), after, np.empty((0, 0, 0)))
        return after

    def linearise(self, x: Matrix, u: Matrix, p: Floats, h: Floats) -> tuple[Matrix, Floats]:
        """States (n, nx) after the steps, and derivatives (n, nx, nx + nu + np) by state, control and parameters."""
        change = np.concatenate(
            [np.full(self.nx, DIFFERENCE_STEP), self._control_change, DIFFERENCE_STEP * np.maximum(np.abs(p), 0.05)]
        )
        after, jacobian = np.empty_like(x), np.zeros((len(x), self.nx, len(change)))
        self._kernels.linearise(x, u, p, h, change, self._block(), after, jacobian)
        return after, jacobian

    def simulate(self, start: Matrix, u: Floats, p: Matrix, h: Floats) -> Floats:
        """Open-loop motions (steps + 1, m, nx) from `start` (m, nx) with `u` (steps, m, nu) and `p` (m, np).

        `h` is (m,) or (steps, m), s.
        """
        states = np.empty((len(u) + 1, *start.shape))
        steps = np.ascontiguousarray(h) if h.ndim == 2 else np.tile(h, (len(u), 1))
        self._kernels.simulate(start, u, p, steps, True, self._block(), states)
        return states

    def _block(self) -> Floats:
        """Working block of a call: threads may call at the same time."""
        return np.zeros(self._kernels.block)
