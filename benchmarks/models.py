"""The vehicles' models written down once more, in numpy, to check with what the planner returns.

States have shape (n, nx), controls (n, nu): n motions at a time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

Model = Callable[[Matrix, Matrix], Matrix]
Law = Callable[[Floats], Floats]

MUSHR_LAG = 0.1  # s
APPROACH = 6.0  # 1/s


def model_of(vehicle: Vehicle) -> Model:
    """dx/dt of a state and a control."""
    p = vehicle.parameters
    if vehicle.name == "benchmark":
        return car(p["wheelbase"], p["gain"], 1.0 / p["rate"], p["steering_max"], 0.0)
    if vehicle.name == "mushr":
        return car(p["L"], p["v_delta"], MUSHR_LAG, 1.0, p["phi_diff"])
    if vehicle.name == "unicycle2":
        return unicycle(p["a_max"], p["alpha_max"], p["v_max"], p["omega_max"])
    if vehicle.name == "f1tenth":
        return f1tenth(p["L"], p["phi_diff"], p["v_delta"], p["tau"], p["a_grip"], p["a_yaw"])
    if vehicle.name == "jackal":
        return two_sides(p["track"], p["tau"], p["tau_turn"], p["gain"])
    raise KeyError(f"there is no second model of {vehicle.name}")


def car(wheelbase: float, gain: float, lag: float, steering_scale: float, steering_offset: float) -> Model:
    """Bicycle about its centre whose speed follows the throttle with a lag."""

    def derivative(x: Matrix, u: Matrix) -> Matrix:
        theta, v = x[:, 2], x[:, 3]
        beta = np.arctan(np.tan(steering_scale * u[:, 1] + steering_offset) / 2)
        turning = 2 * v * np.sin(beta) / wheelbase
        rows = [v * np.cos(theta + beta), v * np.sin(theta + beta), turning, (gain * u[:, 0] - v) / lag]
        return np.column_stack(rows)

    return derivative


def f1tenth(wheelbase: float, offset: float, gain: float, lag: float, grip: float, yaw: float) -> Model:
    """Bicycle about its centre with limited grip and yaw acceleration, whose wheels turn at a limited rate."""
    servo_lag, servo_rate = 0.06, 3.2  # s, rad/s

    def derivative(x: Matrix, u: Matrix) -> Matrix:
        theta, v, delta = x[:, 2], x[:, 3], x[:, 4]
        beta = np.arctan(np.tan(delta + offset) / 2)
        curvature = 2 * np.sin(beta) / wheelbase
        turning = v * curvature * (1 + (v**2 * curvature / grip) ** 8) ** -0.125
        rate = (u[:, 1] - delta) / servo_lag
        rate = rate / np.hypot(1.0, rate * np.hypot(1.0 / servo_rate, v / (wheelbase * yaw)))
        rows = [v * np.cos(theta + beta), v * np.sin(theta + beta), turning, (gain * u[:, 0] - v) / lag, rate]
        return np.column_stack(rows)

    return derivative


def two_sides(track: float, lag: float, lag_turning: float, gain: float) -> Model:
    """Robot whose speed and turning rate follow the speeds of its two sides."""

    def derivative(x: Matrix, u: Matrix) -> Matrix:
        theta, v, omega = x[:, 2], x[:, 3], x[:, 4]
        dv = (gain * u.mean(axis=1) - v) / lag
        domega = (gain * (u[:, 1] - u[:, 0]) / track - omega) / lag_turning
        return np.column_stack([v * np.cos(theta), v * np.sin(theta), omega, dv, domega])

    return derivative


def unicycle(a_max: float, alpha_max: float, v_max: float, omega_max: float) -> Model:
    """Unicycle whose accelerations fade where a speed reaches its limit."""

    def derivative(x: Matrix, u: Matrix) -> Matrix:
        theta, v, omega = x[:, 2], x[:, 3], x[:, 4]
        dv = faded(a_max * u[:, 0], v, v_max - v)
        domega = faded(alpha_max * u[:, 1], omega_max + omega, omega_max - omega)
        return np.column_stack([v * np.cos(theta), v * np.sin(theta), omega, dv, domega])

    return derivative


def faded(acceleration: Floats, below: Floats, above: Floats) -> Floats:
    """An acceleration with that much room below and above its speed: a parabola from full to APPROACH * room."""
    room = np.where(acceleration >= 0, above, below)
    share = np.clip(APPROACH * room / np.maximum(np.abs(acceleration), 1e-300), 0.0, 2.0)  # 2: not faded
    back = APPROACH * (np.minimum(above, 0.0) - np.minimum(below, 0.0))  # from beyond a limit
    result: Floats = acceleration * share * (1.0 - share / 4.0) + back
    return result


def law_of(vehicle: Vehicle, manoeuvre: str) -> Law:
    """Control (nu,) of a contingency manoeuvre in a state (nx,)."""
    turn = {"straight": 0.0, "left": 0.5, "right": -0.5, "hard-left": 1.0, "hard-right": -1.0}[manoeuvre]
    if vehicle.name == "unicycle2":
        p = vehicle.parameters

        def brake(x: Floats) -> Floats:
            wanted = turn * p["omega_max"] * x[3] / p["v_max"]
            return np.array([-1.0, np.clip(APPROACH * (wanted - x[4]) / p["alpha_max"], -1.0, 1.0)])

        return brake
    steering = turn * vehicle.controls["steering"][1]
    return lambda x: np.array([0.0, steering])


def rk4(model: Model, x: Matrix, u: Matrix, h: Floats) -> Matrix:
    """One classical step of each motion by its own `h` (n,), s."""
    h = h[:, None]
    k1 = model(x, u)
    k2 = model(x + h / 2 * k1, u)
    k3 = model(x + h / 2 * k2, u)
    k4 = model(x + h * k3, u)
    stepped: Matrix = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return stepped
