"""A vehicle's model of itself: prediction and derivatives of one state at a time; of a car also its steady responses.

Predictions use the planner's own compiled derivative and Runge-Kutta step, so they agree with the plan.  The steady
responses of a car to throttle and steering have inverses.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Final, Self

import numpy as np

from kraft.errors import Code, InputError
from kraft.vehicles import CAR_CONTROLS, check_state, is_car
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.kernels.moments import INSTANT, MAX_STEP, ROUNDING
from ompl_ext.kernels.specialise import StepKernels, kernels, step_kernels
from ompl_ext.kernels.stopping import stop_controls as compiled_stop_controls
from ompl_ext.names import FORCE
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


SETTLING_TIME: Final = 20.0
"""Time after which the response to a constant control is taken as steady, s."""
TABLE_SIZE: Final = 65  # rows of a table of steady responses
UPDATED_SIZE: Final = 33
UPDATED_TIME: Final = 6.0
"""Size of the tables, and time until a response is taken as steady (s), when parameters change during a drive."""
Tables = tuple[list[float], list[float], list[float], list[float]]
"""Throttles with their steady speeds (m/s), and steerings with the curvatures of their paths (1/m)."""
_TABLES: Final[dict[tuple[str, bytes, bytes], Tables]] = {}
_UPDATED: Final[dict[tuple[str, bytes, bytes], Tables]] = {}  # those of the parameters that were learned last


def model_of(vehicle: Vehicle) -> VehicleModel:
    """Model of a vehicle: a `CarModel` if its controls are throttle and steering.

    Raises:
        InputError: if its state lacks a pose or a speed, or it is a car that does not move.
    """
    return CarModel(vehicle) if is_car(vehicle) else VehicleModel(vehicle)


class CarModel(VehicleModel):
    """Dynamics of a car whose controls are throttle and steering, and its steady responses to them.

    `throttle` and `steering` are indices into a control (nu,).
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Load the vehicle's compiled step and tabulate its steady speeds and curvatures.

        Raises:
            InputError: if the vehicle is not such a car.
        """
        if not is_car(vehicle):
            has, expected = ", ".join(vehicle.controls), "expected throttle and steering, the controls of a car"
            raise InputError.of(vehicle.name, f"has the controls {has}", expected, Code.MISMATCH)
        super().__init__(vehicle)
        names = list(vehicle.controls)
        self.throttle, self.steering = (names.index(name) for name in CAR_CONTROLS)
        self._bounds: list[tuple[float, float]] = list(zip(self.low.tolist(), self.high.tolist(), strict=True))
        self._tabulate()

    @property
    def fastest(self) -> float:
        """Speed that the car reaches at most on a level floor, m/s: its stated one, or what full throttle leads to."""
        level = self._parameters.copy()
        level[[k for k, name in enumerate(self.vehicle.parameters) if name in FORCE]] = 0.0
        states = np.zeros((1, round(UPDATED_TIME / MAX_STEP) + 1, len(self.vehicle.state)))
        full = self.command(self._bounds[self.throttle][1], 0.0)[np.newaxis]
        self._roll_out(states, full, level, np.array([MAX_STEP]))
        return max(self.vehicle.top_speed, float(states[0, -1, self.v]))

    def set_parameters(self, values: Floats) -> None:
        """Change the parameters (np,), in the vehicle's order, for all who use this model.

        The tables are made of fewer and shorter simulations than at first, in 1 ms, once for the models of a vehicle
        that learn the same.  If the car does not move at full throttle, the tables stay as they are; if it does
        not move at full steering, those of the turns.
        """
        super().set_parameters(values)
        known = _UPDATED.get(self._key)
        if known is not None:
            self._throttles, self._speeds, self._steerings, self._curvatures = known
            return
        moves = self._update_speeds() and self._update_turns()
        _UPDATED.clear()
        if moves:  # else the tables depend on those before
            _UPDATED[self._key] = self._throttles, self._speeds, self._steerings, self._curvatures

    def _update_speeds(self) -> bool:
        """Make the tables of the speed for the present parameters; whether the car moves at full throttle."""
        throttles = np.linspace(self.low[self.throttle], self.high[self.throttle], UPDATED_SIZE)
        speeds = self._responses(self.throttle, throttles, 0.0)[:, self.v]
        if not speeds[-1] > 0.0:
            return False
        self._throttles, self._speeds = list(map(float, throttles)), list(map(float, np.maximum.accumulate(speeds)))
        return True

    def _update_turns(self) -> bool:
        """Make the table of the curvature for the present parameters; whether the car moves at all steerings."""
        steerings = np.linspace(self.low[self.steering], self.high[self.steering], UPDATED_SIZE)
        throttle = self.throttle_for(0.5 * self._speeds[-1])
        before = self._responses(self.steering, steerings, throttle)
        if not np.all(before[:, self.v] > 0.0):
            return False
        before[:, self.pose] = 0.0
        controls = np.array([self.command(throttle, steering) for steering in steerings.tolist()])
        turned = self.after(before, controls, MAX_STEP)[:, self.theta].tolist()
        curvatures = [_curvature(float(x[self.v]), turn) for x, turn in zip(before, turned, strict=True)]
        self._steerings = list(map(float, steerings))
        self._curvatures = list(map(float, np.maximum.accumulate(curvatures)))
        return True

    @property
    def _key(self) -> tuple[str, bytes, bytes]:
        """What the tables depend on."""
        return self.vehicle.hash, self._parameters.tobytes(), self.vehicle.control_bounds.tobytes()

    def _responses(self, varied: int, values: Floats, throttle: float) -> Matrix:
        """States (n, nx) after `UPDATED_TIME` s from standstill with each of `values` (n,) of the control `varied`."""
        kernels = self._steps
        steps, count = round(UPDATED_TIME / MAX_STEP), len(values)
        controls = np.tile(self.command(throttle, 0.0), (steps, count, 1))
        controls[:, :, varied] = values
        states = np.empty((steps + 1, count, len(self.vehicle.state)))
        kernels.simulate(
            np.zeros((count, len(self.vehicle.state))), controls, np.tile(self._parameters, (count, 1)),
            np.full((steps, count), MAX_STEP), False, np.zeros(kernels.block), states,
        )  # fmt: skip
        last: Matrix = states[-1]
        return last

    @cached_property
    def driven(self) -> Bools:
        """Controls (nu,) that move the car: the throttle, also where one of 0 is in its dead zone."""
        driven: Bools = np.arange(len(self.low)) == self.throttle
        return driven

    def velocity_drift(self, speed_drift: float) -> Floats:
        """Zeros (nx,): the speed follows the throttle."""
        return np.zeros(len(self.vehicle.state))

    def drive_control(self, drive: float, turn: float) -> Floats:
        """Control (nu,) with shares of the largest throttle, either way, and of the largest steering to either side."""
        steering = float(min(self.high[self.steering], -self.low[self.steering]))
        full = self.high if drive > 0.0 else -self.low
        return self.command(drive * float(full[self.throttle]), turn * steering)

    def control_to(self, state: Floats, control: Floats, after: Floats, duration: float) -> Floats:
        """Control (nu,) with the throttle that leads to the speed of `after`: the brakes' while the car is faster."""
        result, speed = control.copy(), float(after[self.v])
        if float(state[self.v]) > speed + 1e-3:
            result[self.throttle] = self.stop_control(state, 0)[self.throttle]
        else:
            result[self.throttle] = self.throttle_for(speed)
        return result

    def command(self, throttle: float, steering: float) -> Floats:
        """Control (nu,) from throttle and steering, clamped to their bounds."""
        control = self.rest.copy()
        for k, value in ((self.throttle, throttle), (self.steering, steering)):
            low, high = self._bounds[k]
            control[k] = min(max(value, low), high)
        return control

    def steady_speed(self, throttle: float) -> float:
        """Speed (m/s) that a throttle leads to when it is held: inverse of `throttle_for`."""
        return interpolate(throttle, self._throttles, self._speeds)

    def throttle_for(self, speed: float) -> float:
        """Throttle whose steady speed is `speed` (m/s), or the nearest possible one."""
        return _inverse(speed, self._speeds, self._throttles)

    def curvature(self, steering: float) -> float:
        """Curvature of the path at a constant steering, 1/m, positive to the left."""
        return interpolate(steering, self._steerings, self._curvatures)

    def steering_for(self, curvature: float) -> float:
        """Steering whose path has a curvature (1/m), or the nearest possible one."""
        return _inverse(curvature, self._curvatures, self._steerings)

    @property
    def wheelbase(self) -> float:
        """Change of steering per change of curvature at straight driving, m; for a bicycle model its wheelbase."""
        reach = 0.1 * max(abs(self._curvatures[0]), abs(self._curvatures[-1]))
        return (self.steering_for(reach) - self.steering_for(-reach)) / (2.0 * reach)

    def _tabulate(self) -> None:
        """Make the tables of steady responses once per vehicle and process; this takes as long as planning a cycle."""
        key = self._key
        if key not in _TABLES:
            self._throttles, self._speeds = self._steady_speeds()
            _TABLES[key] = self._throttles, self._speeds, *self._steady_turns()
        self._throttles, self._speeds, self._steerings, self._curvatures = _TABLES[key]

    def _steady_speeds(self) -> tuple[list[float], list[float]]:
        throttles = np.linspace(self.low[self.throttle], self.high[self.throttle], TABLE_SIZE)
        speeds = [float(self._steady_state(self.command(u, 0.0))[self.v]) for u in throttles]
        if not speeds[-1] > 0.0:
            raise InputError.of(
                self.vehicle.name, "does not move at full throttle", "expected a speed above 0", Code.MISMATCH
            )
        return list(map(float, throttles)), list(map(float, np.maximum.accumulate(speeds)))

    def _steady_turns(self) -> tuple[list[float], list[float]]:
        steerings = np.linspace(self.low[self.steering], self.high[self.steering], TABLE_SIZE)
        throttle = self.throttle_for(0.5 * self._speeds[-1])
        curvatures = []
        for steering in steerings:
            control = self.command(throttle, float(steering))
            before = self._steady_state(control)
            if before[self.v] == 0.0:  # curvatures of 0 would make a table that cannot steer
                problem = f"does not move at throttle {throttle:.3g} and steering {steering:.3g}"
                raise InputError.of(self.vehicle.name, problem, "expected a speed above 0", Code.MISMATCH)
            turn = float(self.advance(before, control, MAX_STEP)[self.theta])
            curvatures.append(_curvature(float(before[self.v]), turn))
        if not curvatures[-1] > curvatures[0]:  # the laws for cars would steer away from the path
            ends = " and ".join(f"{curvatures[k]:.3g}/m at steering {steerings[k]:.3g}" for k in (0, -1))
            problem = f"does not turn further to the left with larger steering: its curvature is {ends}"
            expected = "expected steering that is positive to the left: negate it in the derivative"
            raise InputError.of(self.vehicle.name, problem, expected, Code.MISMATCH)
        return list(map(float, steerings)), list(map(float, np.maximum.accumulate(curvatures)))

    def _steady_state(self, control: Floats) -> Floats:
        """Steady state after holding a control from standstill, moved to the origin."""
        state = self.advance(np.zeros(len(self.vehicle.state)), control, SETTLING_TIME)
        state[self.pose] = 0.0
        return state


def _curvature(speed: float, turn: float) -> float:
    """Curvature (1/m) of a step of `MAX_STEP` s at a speed (m/s) in which the heading turns by `turn` rad."""
    return turn / (MAX_STEP * speed)


def _inverse(value: float, values: list[float], arguments: list[float]) -> float:
    """Inverse of `interpolate` for an ascending table: the first argument with a value, clamped to the table's ends."""
    k = bisect_left(values, value)
    if k == 0:
        return arguments[0]
    if k == len(values):
        return arguments[-1]
    share = (value - values[k - 1]) / (values[k] - values[k - 1])
    return arguments[k - 1] + share * (arguments[k] - arguments[k - 1])


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Linear interpolation at `x` in (xs, ys), both (n,), xs ascending: `numpy.interp` for one value, but faster."""
    k = bisect_right(xs, x) - 1
    if k < 0:
        return ys[0]
    if k >= len(xs) - 1:
        return ys[-1]
    return (ys[k + 1] - ys[k]) / (xs[k + 1] - xs[k]) * (x - xs[k]) + ys[k]
