"""What the tests of online identification share: simulated drives of a car that differs from its model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np

from kraft.driving.car_model import CarModel
from kraft.driving.estimation.adaptive import online_parameters
from kraft.driving.estimation.drive_history import RecordedDrive
from kraft.driving.estimation.sliding_window import SlidingWindow
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.messages import Observation
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle
from support.driving import RATE, Truth

BEGIN = np.array([1.0, 0.5, 1.2, 0.0])
SETTINGS = Adaptive(kind="adaptive")
OTHER = {"L": 0.39, "phi_diff": 0.06, "v_delta": 0.6}
POSITION, HEADING = 0.005, 0.01
"""Noise of the poses of `recorded`, m and rad."""


@cache
def vehicle() -> Vehicle:
    return load_vehicle("mushr-force")


def exciting(time: float) -> Floats:
    """Steps of throttle and steering, which tell the parameters and the delay apart."""
    return np.array([0.9 if int(time / 1.5) % 3 else 0.5, (0.3, -0.3, 0.0, 0.25, -0.2)[int(time / 0.8) % 5]])


def straight(time: float) -> Floats:
    """Constant throttle, straight on."""
    return np.array([0.7, 0.0])


def standing(time: float) -> Floats:
    """No throttle, straight wheels."""
    return np.zeros(2)


def driven(
    command: Callable[[float], Floats],
    seconds: float,
    parameters: Mapping[str, float],
    delay: float,
    change: tuple[float, Mapping[str, float]] | None = None,
) -> tuple[Matrix, Matrix]:
    """True states (n + 1, nx) at each tick of RATE and commands (n, nu), which act `delay` s later.

    From the time (s) of a `change` on the car has its parameters in addition.
    """
    truth = Truth(CarModel(vehicle().with_parameters(parameters)), BEGIN, delay=round(delay * RATE))
    states, commands = [BEGIN], []
    for k in range(round(seconds * RATE)):
        if change is not None and k == round(change[0] * RATE):
            truth.model = CarModel(vehicle().with_parameters({**parameters, **change[1]}))
        commands.append(command(k / RATE))
        truth.step(commands[-1])
        states.append(truth.state.copy())
    return np.array(states), np.array(commands)


def recorded(
    command: Callable[[float], Floats],
    seconds: float,
    parameters: Mapping[str, float],
    delay: float,
    seed: int = 0,
    rest: float = 0.0,
    change: tuple[float, Mapping[str, float]] | None = None,
) -> RecordedDrive:
    """Recorded drive of `seconds` s, then `rest` s without throttle; the vehicle stood before it, as all know."""
    states, commands = driven(
        lambda time: command(time) if time < seconds else standing(time), seconds + rest, parameters, delay, change
    )
    times, before = np.arange(len(states)) / RATE, np.arange(-0.5, -0.05, 0.1)
    noise = np.random.default_rng(seed).normal(size=(len(states), 3)) * [POSITION, POSITION, HEADING]
    return RecordedDrive(
        np.concatenate([before, times]),
        np.vstack([np.tile(BEGIN[:3], (len(before), 1)), states[:, :3] + noise]),
        np.vstack([np.tile(BEGIN, (len(before), 1)), states]),
        np.concatenate([[-1.0], times[:-1]]),
        np.vstack([np.zeros((1, 2)), commands]),
    )


def window() -> SlidingWindow:
    """Window with the noise of the default settings and enough iterations to converge at once."""
    process = np.full(len(vehicle().state), SETTINGS.speed_drift)
    process[:3] = SETTINGS.drift, SETTINGS.drift, math.radians(SETTINGS.heading_drift_deg)
    low, high = vehicle().control_bounds.T
    control = SETTINGS.control_share * (high - low)
    turning = np.append(CarModel(vehicle()).acts_on_turning(), False)
    return SlidingWindow(online_parameters(vehicle(), SETTINGS), 6.0, SETTINGS.step, process, control, 20, turning)


def correlated(rng: np.random.Generator, count: int, sigmas: Floats, share: float, time: float = 0.7) -> Matrix:
    """Pose errors (count, 3) with standard deviations (3,), a share of whose variance is a first-order process."""
    kept = math.exp(-1.0 / RATE / time)
    slow = [rng.normal(size=3)]
    for _ in range(count - 1):
        slow.append(kept * slow[-1] + math.sqrt(1.0 - kept * kept) * rng.normal(size=3))
    errors: Matrix = sigmas * (math.sqrt(share) * np.array(slow) + math.sqrt(1.0 - share) * rng.normal(size=(count, 3)))
    return errors


def pose_at(k: int, state: Floats, error: Floats) -> Observation:
    """Pose of tick k, observed with an error (3,) and without latency."""
    x, y, theta = state[:3] + error
    return Observation(k / RATE, k / RATE, x, y, math.remainder(theta, math.tau))
