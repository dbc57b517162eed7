"""A vehicle's model of itself: prediction and derivatives of one state at a time.

Predictions use the planner's own compiled derivative and Runge-Kutta step, so they agree with the plan.
`kraft.driving.car_model` has the model of a car, and `model_of`, which makes the one that a vehicle needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import Final, Self

import numpy as np

from kraft.vehicles import check_state
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.kernels.moments import INSTANT, MAX_STEP, ROUNDING
from ompl_ext.kernels.specialise import StepKernels, kernels, step_kernels
from ompl_ext.kernels.stopping import stop_controls as compiled_stop_controls
from ompl_ext.vehicle import Vehicle

CHANGE: Final = 1e-5
"""Change of a component in a numeric derivative, SI."""
NO_EFFECT: Final = 0.01
"""Effect of a parameter on the speed, as a share of that on what turns the vehicle, below which it has none."""

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
        compiled = kernels(vehicle)
        self._step, self._roll_out = compiled.advance, compiled.roll_out
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
        """Change the parameters (np,), in the vehicle's order, for all who use this model or its `parameters`."""
        self._parameters[: len(values)] = values  # a vehicle without parameters has one entry all the same

    @property
    def present_vehicle(self) -> Vehicle:
        """The vehicle with the present parameters."""
        return self.vehicle.with_parameters(dict(zip(self.vehicle.parameters, self._parameters.tolist(), strict=False)))

    @property
    def fastest(self) -> float:
        """Speed that the vehicle reaches at most on a level floor, m/s; of a car by its present parameters."""
        return self.vehicle.top_speed

    def advance(self, state: Floats, control: Floats, duration: float) -> Floats:
        """State (nx,) after holding a control (nu,) for `duration` s; a copy of the state if that is not above 0."""
        result = np.array(state, dtype=np.float64)
        if duration <= 0.0:
            return result
        steps = math.ceil(duration / MAX_STEP - ROUNDING)
        held = np.ascontiguousarray(control, dtype=np.float64)
        for _ in range(steps):
            self._step(result, held, self._parameters, duration / steps, result)
        return result

    def after_commands(self, state: Floats, held: Iterable[tuple[Floats, float]]) -> Floats:
        """State (nx,) after controls (nu,) that are held one after the other, each with its duration (s)."""
        for control, duration in held:
            state = self.advance(state, control, duration)
        return state

    def linearised(self, states: Matrix, controls: Matrix, durations: Floats) -> tuple[Matrix, Floats, Floats]:
        """States (n, nx) after one step each, and their derivatives by state (n, nx, nx) and control (n, nx, nu).

        Step i holds controls[i] (n, nu) for durations[i] (n,) s from states[i] (n, nx).
        """
        steps, nx = self._steps, len(self.vehicle.state)
        changes = np.full(nx + len(self.vehicle.controls), CHANGE)
        after, jacobian = np.empty((len(states), nx)), np.zeros((len(states), nx, len(changes)))
        steps.linearise(
            np.ascontiguousarray(states), np.ascontiguousarray(controls), self._parameters,
            np.ascontiguousarray(durations), changes, np.zeros(steps.block), after, jacobian,
        )  # fmt: skip
        return after, jacobian[:, :, :nx], jacobian[:, :, nx:]

    def after(self, states: Matrix, control: Matrix | Floats, duration: float) -> Matrix:
        """States (n, nx) after one integration step of `duration` s from states (n, nx).

        `control` is that of each (n, nu) or of all (nu,).  As in `advance`, nothing moves in what rounding left of a
        time.
        """
        if duration / MAX_STEP - ROUNDING <= 0.0:
            return states.copy()
        motions, controls = np.empty((len(states), 2, states.shape[1])), np.empty((len(states), len(self.low)))
        motions[:, 0], controls[:] = states, control
        self._roll_out(motions, controls, self._parameters, np.full(len(states), duration))
        after: Matrix = motions[:, 1]
        return after

    def acts_on_turning(self) -> Bools:
        """Whether each parameter (np,) acts on how the vehicle turns, and not on its speed, in a turn."""
        state, own = np.zeros(len(self.vehicle.state)), self._parameters
        state[self.v] = 0.5
        rates = self.rates(state, self.drive_control(0.5, 0.5), np.vstack([own, own + CHANGE * np.eye(len(own))]))
        effects = np.abs(rates[1:] - rates[0])
        acts: Bools = effects[:, self.v] < NO_EFFECT * np.delete(effects, [self.x, self.y, self.v], axis=1).max(axis=1)
        return acts

    def rates(self, state: Floats, control: Floats, parameters: Matrix) -> Matrix:
        """Derivatives (n, nx) of a state (nx,) under a control (nu,) with each of `parameters` (n, np)."""
        kernels, count = self._steps, len(parameters)
        states = np.empty((2, count, len(state)))
        start, controls = np.empty((count, len(state))), np.empty((1, count, len(control)))
        start[:], controls[:] = state, control
        kernels.simulate(
            start, controls, np.ascontiguousarray(parameters), np.full((1, count), INSTANT), False,
            np.zeros(kernels.block), states,
        )  # fmt: skip
        rates: Matrix = (states[1] - state) / INSTANT
        return rates

    def acceleration_at_rest(self, parameters: Floats) -> float:
        """Acceleration at full power from rest with `parameters` (np,), in the weaker direction (m/s^2)."""
        rest = np.zeros(len(self.vehicle.state))
        full = (self.rates(rest, self.drive_control(drive, 0.0), parameters[None, :])[0] for drive in (-1.0, 1.0))
        return min(abs(float(rates[self.v])) for rates in full)

    @property
    def parameters(self) -> Floats:
        """Present parameters (np,): one array, which `set_parameters` changes."""
        return self._parameters

    def stop_control(self, state: Floats, number: int) -> Floats:
        """Control (nu,) of manoeuvre `number` in a state (nx,), by the present parameters."""
        return stop_control(self.vehicle, state, number, self._parameters)

    def clamped(self, control: Floats) -> Floats:
        """Control (nu,) clamped to its bounds."""
        inside: Floats = np.minimum(np.maximum(control, self.low), self.high)
        return inside

    def velocity_drift(self, speed_drift: float) -> Floats:
        """Variance rate (nx,) of the velocities if the speed drifts by `speed_drift` m/s in one second.

        Turning rates drift as if the speed of one side of the vehicle did.
        """
        rate = np.zeros(len(self.vehicle.state))
        rate[self.velocities] = (2.0 * speed_drift / self.vehicle.footprint.width) ** 2
        rate[self.v] = speed_drift**2
        return rate

    @cached_property
    def driven(self) -> Bools:
        """Controls (nu,) that move a vehicle from standstill; the others only steer one that moves."""
        standing = np.zeros((1, len(self.vehicle.state)))
        _, _, by_control = self.linearised(standing, self.rest[None, :], np.array([MAX_STEP]))
        moves: Bools = (by_control[0][self.velocities] != 0.0).any(axis=0)
        return moves

    def drive_control(self, drive: float, turn: float) -> Floats:
        """Control (nu,) that drives with a share `drive` in [-1, 1], positive forward, and turns left with `turn`.

        Without `drive`, a vehicle that does not slow down by itself brakes.
        """
        forward, backward, sideways, slowing = self._directions
        along = drive * forward if drive > 0.0 else -drive * backward if drive < 0.0 else slowing
        return self.clamped(along + turn * sideways)

    @cached_property
    def _steps(self) -> StepKernels:
        """Many steps at once; only some methods have them compiled."""
        return step_kernels(self.vehicle)

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


def stop_control(vehicle: Vehicle, state: Floats, number: int, parameters: Floats | None = None) -> Floats:
    """Control (nu,) of manoeuvre `number` in a state, within its bounds; zero without a `stop` function."""
    control: Floats = stop_controls(vehicle, np.asarray(state)[None, :], number, parameters)[0]
    return control


def stop_controls(vehicle: Vehicle, states: Matrix, number: int, parameters: Floats | None = None) -> Matrix:
    """Controls (n, nu) of manoeuvre `number` in states (n, nx), by the vehicle's `parameters` (np,) or by others."""
    low, high = vehicle.control_bounds.T
    controls = np.zeros((len(states), len(low)))
    if vehicle.stop is not None:
        rows = np.ascontiguousarray(states, dtype=np.float64)
        values = vehicle.parameter_array if parameters is None else parameters
        compiled_stop_controls()(kernels(vehicle).functions, rows, values, number, controls)
    inside: Matrix = np.clip(controls, low, high)
    return inside


def braking_control(vehicle: Vehicle, state: Floats, held: Floats) -> Floats:
    """Control (nu,) that brakes in a state (nx,) with the wheels as they are, by the steering of `held` (nu,)."""
    control = stop_control(vehicle, state, 0)
    kept = [k for k, name in enumerate(vehicle.controls) if name == "steering"]
    control[kept] = held[kept]
    return control
