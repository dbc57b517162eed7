"""Mean and covariance of a state of which a vehicle's model moves a part, while the vehicle holds its commands.

The state is that of the vehicle, the excess of its speed over the model's, and errors that decay.  The vehicle moves as
in its model, and faster by the excess along the course of an additional motion.  Derivatives are forward differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from numba import types

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.functions import ADVANCE, call_advance
from ompl_ext.kernels.kernel_types import numba_type

MAX_STEP = 0.05  # longest integration step (s)
ROUNDING = 1e-9  # share of such a step that counts as an error of rounded times, not as time
EXCESS_TIME = 2.0  # time constant with which an excess of speed decays without observations (s)
CHANGE = 1e-5  # step of a derivative by the state (SI)
SHARE = 1e-3  # the same by the parameters (standard deviations)
INSTANT = 1e-3  # duration over which rates and the direction of motion are measured (s)
FASTER = 0.05  # change of the speed that shows the course (m/s)
STILL = 1e-12  # distance below which there is no course (m)

# Indices of Process.where: components of the state, and the number of those of the vehicle
AT_X, AT_Y, AT_THETA, AT_V, AT_NX = range(5)


class Process(NamedTuple):
    """What moves a state (n,): the model with `parameters`, which are uncertain by the rows of `spread`.

    `rate` is the variance per second that the state gains.  The errors after the excess decay with their `times`.
    What the model's derivative gains by uncertain parameters counts as the same for `same` s; errors between two
    indices of `varying` gain as much variance as they are large, too.
    """

    functions: Ints
    parameters: Floats  # (np,)
    spread: Matrix  # (m, np) standard deviations along the axes of their covariance
    where: Ints  # (5,)
    rate: Floats  # (n,)
    same: Floats  # (nx,) s
    times: Floats  # (n - nx - 1,) s
    varying: Ints  # (2,)


@part
def course(state: Floats, control: Floats, process: Process, faster: Floats, slower: Floats) -> tuple[float, float]:
    """Curvature (1/m) and slip angle (rad) of the additional motion if the speed alone were a little higher."""
    x, y, theta, v, nx = (process.where[AT_X], process.where[AT_Y], process.where[AT_THETA], process.where[AT_V],
                          process.where[AT_NX])  # fmt: skip
    for k in range(nx):
        faster[k] = slower[k] = state[k]
    faster[v] += FASTER
    slower[v] -= FASTER
    call_advance(process.functions[ADVANCE], (faster, control, process.parameters, INSTANT, faster))
    call_advance(process.functions[ADVANCE], (slower, control, process.parameters, INSTANT, slower))
    dx, dy, turn = faster[x] - slower[x], faster[y] - slower[y], faster[theta] - slower[theta]
    length = math.hypot(dx, dy)
    if length < STILL:
        return 0.0, 0.0
    slip = math.atan2(dy, dx) - state[theta]
    return turn / length, slip - math.tau * round(slip / math.tau)


@part
def move(state: Floats, control: Floats, duration: float, process: Process, block: Matrix) -> None:
    """Advance a state while a control is held for `duration` s."""
    x, y, theta, nx = process.where[AT_X], process.where[AT_Y], process.where[AT_THETA], process.where[AT_NX]
    steps = math.ceil(duration / MAX_STEP - ROUNDING)
    if steps <= 0:
        return
    h = duration / steps
    left = math.exp(-h / EXCESS_TIME)
    before, after = block[0], block[1]
    for _ in range(steps):
        curvature, slip = course(state, control, process, before, after)
        for k in range(nx):
            before[k] = state[k]
        call_advance(process.functions[ADVANCE], (before, control, process.parameters, h, after))
        distance = state[nx] * EXCESS_TIME * (1.0 - left)
        turn = curvature * distance
        direction = 0.5 * (before[theta] + after[theta]) + 0.5 * turn + slip
        for k in range(nx):
            state[k] = after[k]
        state[x] += distance * math.cos(direction)
        state[y] += distance * math.sin(direction)
        state[theta] += turn
        state[nx] *= left


@part
def rate_variance(state: Floats, control: Floats, process: Process, block: Matrix, variance: Floats) -> None:
    """Variance (nx,) of the derivative of the vehicle's state by the uncertainty of the parameters."""
    nx, count = process.where[AT_NX], len(process.parameters)
    now, nominal, varied, parameters = block[0], block[1], block[2], block[3]
    for k in range(nx):
        now[k], variance[k] = state[k], 0.0
    if len(process.spread) == 0:
        return
    call_advance(process.functions[ADVANCE], (now, control, process.parameters, INSTANT, nominal))
    for row in range(len(process.spread)):
        for k in range(count):
            parameters[k] = process.parameters[k] + SHARE * process.spread[row, k]
        call_advance(process.functions[ADVANCE], (now, control, parameters, INSTANT, varied))
        for k in range(nx):
            change = (varied[k] - nominal[k]) / (INSTANT * SHARE)
            variance[k] += change * change


@part
def linearise(
    mean: Floats, control: Floats, duration: float, process: Process, block: Matrix, jacobian: Matrix
) -> None:
    """Advance the mean, and write the derivatives (n, n) by the state before."""
    size, last = len(mean), process.where[AT_NX]
    nominal, varied = block[4], block[5]
    for a in range(size):
        nominal[a] = mean[a]
        for b in range(size):
            jacobian[a, b] = 1.0 if a == b else 0.0
    move(nominal, control, duration, process, block)
    for b in range(last + 1):
        if b not in (process.where[AT_X], process.where[AT_Y]):  # the motion does not depend on the position
            for k in range(size):
                varied[k] = mean[k]
            varied[b] += CHANGE
            move(varied, control, duration, process, block)
            for a in range(last + 1):
                jacobian[a, b] = (varied[a] - nominal[a]) / CHANGE
    for a in range(last + 1):
        mean[a] = nominal[a]
    for k in range(last + 1, size):
        left = math.exp(-duration / process.times[k - last - 1])
        mean[k] *= left
        jacobian[k, k] = left


@part
def predict(
    mean: Floats, covariance: Matrix, control: Floats, duration: float, process: Process, block: Matrix
) -> None:
    """Advance mean (n,) and covariance (n, n) while a control (nu,) is held for `duration` s."""
    size, nx = len(mean), process.where[AT_NX]
    variance, added = block[6], block[7]
    jacobian, product = block[8 : 8 + size], block[8 + size : 8 + 2 * size]
    rate_variance(mean, control, process, block, variance)
    for a in range(size):
        added[a] = process.rate[a] * duration
    for a in range(nx):
        added[a] += variance[a] * process.same[a] * duration
    for a in range(process.varying[0], process.varying[1]):
        added[a] += 2.0 * mean[a] * mean[a] / process.times[a - nx - 1] * duration
    linearise(mean, control, duration, process, block, jacobian)
    for a in range(size):
        for b in range(size):
            total = 0.0
            for k in range(size):
                total += jacobian[a, k] * covariance[k, b]
            product[a, b] = total
    for a in range(size):
        for b in range(size):
            total = added[a] if a == b else 0.0
            for k in range(size):
                total += product[a, k] * jacobian[b, k]
            covariance[a, b] = total


def _predict(
    mean: Floats, covariance: Matrix, controls: Matrix, durations: Floats, process: Process, block: Matrix
) -> None:
    for i in range(len(durations)):
        predict(mean, covariance, controls[i], durations[i], process, block)


def _advance(mean: Floats, controls: Matrix, durations: Floats, process: Process, block: Matrix) -> None:
    for i in range(len(durations)):
        move(mean, controls[i], durations[i], process, block)
        for k in range(process.where[AT_NX] + 1, len(mean)):
            mean[k] *= math.exp(-durations[i] / process.times[k - process.where[AT_NX] - 1])


def _rate_variance(state: Floats, control: Floats, process: Process, block: Matrix, variance: Floats) -> None:
    rate_variance(state, control, process, block, variance)


@dataclass(frozen=True)
class Moments:
    """Compiled functions; `block` has 8 + 2 n rows, as long as a state and the parameters.

    `predict(mean, covariance, controls, durations, process, block)` advances mean (n,) and covariance (n, n), and
    `advance(mean, controls, durations, process, block)` the mean alone, while controls (m, nu) are held one after the
    other for their durations (m,) s.  `rate_variance(state, control, process, block, variance)` is the function above.
    """

    predict: Callable[[Floats, Matrix, Matrix, Floats, Process, Matrix], None]
    advance: Callable[[Floats, Matrix, Floats, Process, Matrix], None]
    rate_variance: Callable[[Floats, Floats, Process, Matrix, Floats], None]


@cache
def moments() -> Moments:
    """The compiled functions; compiled, or loaded from the cache, on the first call."""
    process = numba_type(Process)
    floats, matrix = types.float64[::1], types.float64[:, ::1]
    return Moments(
        compiled(_predict, signature=types.void(floats, matrix, matrix, floats, process, matrix)),
        compiled(_advance, signature=types.void(floats, matrix, floats, process, matrix)),
        compiled(_rate_variance, signature=types.void(floats, floats, process, matrix, floats)),
    )
