"""A vehicle's model of itself, one state at a time: prediction, derivatives, and its speed components.

Predictions use the planner's own compiled derivative and Runge-Kutta step, so they agree with the plan.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Final, Self

import numpy as np

from kraft.errors import Code, InputError
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.specialise import kernels, step_kernels
from ompl_ext.vehicle import Vehicle

MAX_STEP: Final = 0.05
"""Longest integration step, s."""
CHANGE: Final = 1e-5
"""Change of a component in a numeric derivative, SI."""
INSTANT: Final = 1e-3
"""Duration over which the direction of motion is measured, s."""

COASTING: Final = 2.0
"""Time within which a vehicle that slows down by itself has lost half of its speed, s."""
EFFECT: Final = 0.3
"""Share of the largest effect of a control from which on a control counts as driving or turning."""


class VehicleModel:
    """Dynamics of any vehicle whose state has x, y, theta and components that vanish at rest.

    `x`, `y`, `theta`, `v` are indices into a state (nx,), `pose` the first three, and `velocities` those of the
    components that vanish at rest, of which the speed `v` is the first; `low` and `high` (nu,) bound a control.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Load the vehicle's compiled step.

        Raises:
            InputError: if its state lacks a pose or a speed.
        """
        check_state(vehicle)
        self.vehicle = vehicle
        self._step = kernels(vehicle).advance
        self._parameters = vehicle.parameter_array
        self.x, self.y, self.theta = (vehicle.index(name) for name in ("x", "y", "theta"))
        self.pose = [self.x, self.y, self.theta]
        self.velocities = list(vehicle.rest_indices)
        self.v = self.velocities[0]
        self.low, self.high = vehicle.control_bounds[:, 0].copy(), vehicle.control_bounds[:, 1].copy()
        self.rest = self.clamped(np.zeros(len(vehicle.controls)))

    def __deepcopy__(self, memo: object) -> Self:
        """Return the model itself: copies of a controller or an estimator are of the same vehicle."""
        return self

    def set_parameters(self, values: Floats) -> None:
        """Change the parameters (np,), in the vehicle's order, for all who use this model."""
        self._parameters = np.ascontiguousarray(values, dtype=np.float64)

    def advance(self, state: Floats, control: Floats, duration: float) -> Floats:
        """State (nx,) after holding a control (nu,) for `duration` s; a copy of the state if that is not above 0."""
        result = np.array(state, dtype=np.float64)
        if duration <= 0.0:
            return result
        steps = math.ceil(duration / MAX_STEP - 1e-9)
        held = np.ascontiguousarray(control, dtype=np.float64)
        for _ in range(steps):
            self._step(result, held, self._parameters, duration / steps, result)
        return result

    def linearised(self, states: Matrix, controls: Matrix, durations: Floats) -> tuple[Matrix, Floats, Floats]:
        """States (n, nx) after one step each, and their derivatives by state (n, nx, nx) and control (n, nx, nu).

        Step i holds controls[i] (n, nu) for durations[i] (n,) s from states[i] (n, nx).
        """
        steps, nx = step_kernels(self.vehicle), len(self.vehicle.state)
        changes = np.full(nx + len(self.vehicle.controls), CHANGE)
        after, jacobian = np.empty((len(states), nx)), np.zeros((len(states), nx, len(changes)))
        steps.linearise(
            np.ascontiguousarray(states), np.ascontiguousarray(controls), self._parameters,
            np.ascontiguousarray(durations), changes, np.zeros(steps.block), after, jacobian,
        )  # fmt: skip
        return after, jacobian[:, :, :nx], jacobian[:, :, nx:]

    def turning_rates(self, state: Floats, control: Floats, parameters: Matrix) -> Floats:
        """Turning rates (n,) in a state (nx,) under a control (nu,) with each of `parameters` (n, np), rad/s."""
        held, after = np.ascontiguousarray(control, dtype=np.float64), np.empty(len(state))
        rates = np.empty(len(parameters))
        for k, values in enumerate(np.ascontiguousarray(parameters)):
            self._step(state, held, values, INSTANT, after)
            rates[k] = (after[self.theta] - state[self.theta]) / INSTANT
        return rates

    @property
    def parameters(self) -> Floats:
        """Present parameters (np,)."""
        return self._parameters

    def clamped(self, control: Floats) -> Floats:
        """Control (nu,) clamped to its bounds."""
        inside: Floats = np.minimum(np.maximum(control, self.low), self.high)
        return inside

    def course(self, state: Floats, control: Floats) -> tuple[float, float]:
        """Curvature (1/m) and slip angle (rad) of the additional motion if the speed alone were a little higher."""
        faster, slower = np.array(state, dtype=np.float64), np.array(state, dtype=np.float64)
        faster[self.v] += 0.05
        slower[self.v] -= 0.05
        gained = self.advance(faster, control, INSTANT) - self.advance(slower, control, INSTANT)
        dx, dy, turn = (float(gained[k]) for k in self.pose)
        if (length := math.hypot(dx, dy)) < 1e-12:
            return 0.0, 0.0
        return turn / length, math.remainder(math.atan2(dy, dx) - float(state[self.theta]), math.tau)

    def velocity_drift(self, speed_drift: float) -> Floats:
        """Variance rate (nx,) of the velocities if the speed drifts by `speed_drift` m/s in one second.

        Turning rates drift as if the speed of one side of the vehicle did.
        """
        rate = np.zeros(len(self.vehicle.state))
        rate[self.velocities] = (2.0 * speed_drift / self.vehicle.footprint.width) ** 2
        rate[self.v] = speed_drift**2
        return rate

    def drive_control(self, drive: float, turn: float) -> Floats:
        """Control (nu,) that drives with a share `drive` in [-1, 1], positive forward, and turns left with `turn`.

        Without `drive`, a vehicle that does not slow down by itself brakes.
        """
        forward, backward, sideways, slowing = self._directions
        along = drive * forward if drive > 0.0 else -drive * backward if drive < 0.0 else slowing
        return self.clamped(along + turn * sideways)

    @cached_property
    def _directions(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Controls (nu,) that drive forward and backward at full power, turn left besides, and let it slow down.

        They are found by the model's derivatives: a control counts if its effect is at least `EFFECT` of the largest.
        """
        span, nx = self.high - self.low, len(self.vehicle.state)
        _, _, by_control = self.linearised(np.zeros((1, nx)), self.rest[None, :], np.array([MAX_STEP]))
        gain = by_control[0][self.v] * span
        counts = np.abs(gain) >= EFFECT * np.abs(gain).max()
        forward = np.where(counts, np.where(gain > 0.0, self.high, self.low), 0.0)
        backward = np.where(counts, np.where(gain > 0.0, self.low, self.high), 0.0)
        moving = self.advance(np.zeros(nx), self.clamped(0.5 * forward), 1.0)
        _, _, by_control = self.linearised(moving[None, :], self.clamped(0.5 * forward)[None, :], np.array([MAX_STEP]))
        turned = by_control[0][self.theta] * span
        counts = np.abs(turned) >= EFFECT * np.abs(turned).max()
        sideways = np.where(counts, 0.5 * np.sign(turned) * span, 0.0)
        coasted = self.advance(moving, self.rest, COASTING)
        slows = float(coasted[self.v]) < 0.5 * float(moving[self.v])
        return forward, backward, sideways, self.rest if slows else self.clamped(-forward)

    def control_to(self, state: Floats, control: Floats, after: Floats, duration: float) -> Floats:
        """Control (nu,) near `control` that leads from a state to the velocities of `after`, as nearly as one can."""
        reached, _, by_control = self.linearised(state[None, :], control[None, :], np.array([duration]))
        half = 0.5 * (self.high - self.low)
        missing = after[self.velocities] - reached[0, self.velocities]
        change, *_ = np.linalg.lstsq(by_control[0][self.velocities] * half, missing)
        return self.clamped(control + half * change)


def check_state(vehicle: Vehicle) -> None:
    """Check that the state of a vehicle has x, y, theta and a speed.

    Raises:
        InputError: if it lacks one of them.
    """
    missing = [name for name in ("x", "y", "theta") if vehicle.index(name) < 0]
    if missing or not vehicle.rest:
        lacks = (
            f"has no {' and no '.join(missing)} in its state" if missing else "names no speed in its rest components"
        )
        raise InputError.of(vehicle.name, lacks, "expected a state with x, y, theta and a speed", Code.MISMATCH)


def stop_control(vehicle: Vehicle, state: Floats, number: int) -> Floats:
    """Control (nu,) of manoeuvre `number` in a state; without a `stop` function it is zero."""
    if vehicle.stop is None:
        return np.zeros(len(vehicle.controls))
    return np.array(vehicle.stop(tuple(map(float, state)), tuple(vehicle.parameter_array), number), dtype=float)
