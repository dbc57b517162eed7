"""A car's model of itself: that of any vehicle, and the car's steady responses to throttle and steering.

The responses are tables of simulations, which have inverses: throttle for a speed, steering for a curvature.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np

from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError
from kraft.vehicles import CAR_CONTROLS, is_car
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.kernels.moments import MAX_STEP
from ompl_ext.names import FORCE
from ompl_ext.vehicle import Vehicle

SETTLING_TIME: Final = 20.0
"""Time after which the response to a constant control is taken as steady, s."""
TABLE_SIZE: Final = 65
"""Rows of a table of steady responses."""
UPDATED_SIZE: Final = 33
UPDATED_TIME: Final = 6.0
"""Size of the tables, and time until a response is taken as steady (s), when parameters change during a drive.

Half the rows and a third of the time of `TABLE_SIZE` and `SETTLING_TIME`: they are made between two ticks.
"""
AXLES: Final = 0.75
"""Usual wheelbase of a car, as a share of its length."""
Tables = tuple[list[float], list[float], list[float], list[float]]
"""Throttles with their steady speeds (m/s), and steerings with the curvatures of their paths (1/m)."""
_TABLES: Final[dict[tuple[str, bytes, bytes], Tables]] = {}
"""Tables by what they depend on, see `CarModel._key`."""
_UPDATED: Final[dict[tuple[str, bytes, bytes], Tables]] = {}
"""The same for the parameters that were learned last."""


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
        """Change of the wheels' angle per change of curvature at straight driving, m: of a bicycle its wheelbase."""
        return self._steering_per_curvature / self.steering_per_radian

    @property
    def steering_per_radian(self) -> float:
        """Steering per radian of the wheels at straight driving: 1 for steering in rad.

        A model that takes commands in any unit states it (`kraft.vehicles.car`).  Of others, steering whose unit turns
        the car less than an angle of one radian would with a wheelbase as long as the car is not in rad; its wheelbase
        is then taken as `AXLES` of the length.
        """
        values, length = self.vehicle.parameters, self.vehicle.footprint.length
        if "full_steering" in values and "steer" in values:
            return float(values["full_steering"] / values["steer"])
        across = self._steering_per_curvature
        return 1.0 if across <= length else across / (AXLES * length)

    @property
    def full_throttle(self) -> float:
        """Throttle that counts as full: 1, that of a model that states it, or the largest one if that is above 1."""
        full = self.vehicle.parameters.get("full_throttle")
        return max(1.0, self._bounds[self.throttle][1]) if full is None else float(full)

    @property
    def _steering_per_curvature(self) -> float:
        """Change of steering per change of curvature at straight driving, in the steering's unit times m."""
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


def model_of(vehicle: Vehicle) -> VehicleModel:
    """Model of a vehicle: a `CarModel` if its controls are throttle and steering.

    Raises:
        InputError: if its state lacks a pose or a speed, or it is a car that does not move.
    """
    return CarModel(vehicle) if is_car(vehicle) else VehicleModel(vehicle)


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
