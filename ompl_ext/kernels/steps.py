"""Many steps of a vehicle's model at once, with or without their derivatives, for identification and prediction.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
As in `lanes`, lane i of component c has index c * WIDTH + i of a flat working block, so that LLVM vectorises the loop
over lanes; here every lane has its own state, control, parameters and step.
"""

from __future__ import annotations

from numba import types

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.kernel_types import LANE_WIDTH
from ompl_ext.kernels.runge_kutta import runge_kutta_4
from ompl_ext.kernels.specialise import vehicle_being_compiled, vehicle_cache_folder
from ompl_ext.kernels.unroll import per_component, store_components

VEHICLE = vehicle_being_compiled()
FOLDER = vehicle_cache_folder(VEHICLE)
NX = len(VEHICLE.state)
NU = len(VEHICLE.controls)
NP = len(VEHICLE.parameter_array)
WIDTH = LANE_WIDTH
AT_CONTROL = NX * WIDTH  # the working block: state, control, parameters, step, state after the step
AT_PARAMETERS = AT_CONTROL + NU * WIDTH
AT_STEP = AT_PARAMETERS + NP * WIDTH
AT_NEXT = AT_STEP + WIDTH
SPEED = VEHICLE.rest_indices[0] if VEHICLE.rest else -1  # of its direction forces depend: brakes, friction
CROSSING_ROUNDS = 4  # false position on a nearly linear speed: to the order of 1e-6 of a step
VECTOR, SINGLE_MAX = 8, 2  # lanes that are advanced at once; those beyond a multiple that are advanced one by one
BLOCK = AT_NEXT + NX * WIDTH

derivative = VEHICLE.derivative
actuation = VEHICLE.actuation or per_component("u, p", "u[{k}]", NU)
load_state = per_component("a, i", f"a[i + {{k}} * {WIDTH}]", NX)
load_control = per_component("a, i", f"a[{AT_CONTROL} + i + {{k}} * {WIDTH}]", NU)
load_parameters = per_component("a, i", f"a[{AT_PARAMETERS} + i + {{k}} * {WIDTH}]", NP)
rk4_step = runge_kutta_4(derivative, NX)
store_next = store_components(NX, WIDTH)


@part
def step_lanes(block: Floats, lanes: int) -> None:
    """Advance every lane of the working block by its step; this loop vectorises."""
    for i in range(lanes):
        p = load_parameters(block, i)
        u = actuation(load_control(block, i), p)
        after, _, _ = rk4_step(load_state(block, i), u, p, block[AT_STEP + i])
        store_next(block, AT_NEXT, i, after)


@part
def step_over_standstill(block: Floats, i: int) -> None:
    """Repeat the step of lane i, in which the speed changes its sign, as one step to standstill and one from there.

    Forces jump at standstill.  A step across a jump has an error of its own order, which depends on where in the step
    the jump is, so that motions are not smooth functions of the parameters.
    """
    p = load_parameters(block, i)
    u = actuation(load_control(block, i), p)
    x = load_state(block, i)
    whole, speed, reached = block[AT_STEP + i], x[SPEED], block[AT_NEXT + SPEED * WIDTH + i]
    until, middle = whole, x
    for _ in range(CROSSING_ROUNDS):
        until = min(until * speed / (speed - reached), whole)
        middle, _, _ = rk4_step(x, u, p, until)
        reached = middle[SPEED]
    after, _, _ = rk4_step(middle, u, p, whole - until)
    store_next(block, AT_NEXT, i, after)


@part
def load_lanes(first: int, lanes: int, x: Matrix, u: Matrix, p: Floats, h: Floats, block: Floats) -> None:
    """Fill the working block with steps first ... first + lanes - 1."""
    for i in range(lanes):
        for k in range(NX):
            block[k * WIDTH + i] = x[first + i, k]
        for k in range(NU):
            block[AT_CONTROL + k * WIDTH + i] = u[first + i, k]
        for k in range(NP):
            block[AT_PARAMETERS + k * WIDTH + i] = p[k]
        block[AT_STEP + i] = h[first + i]


@part
def add_change(first: int, lanes: int, j: int, change: float, factor: float, block: Floats, jacobian: Floats) -> None:
    """Step with component j changed, and add `factor` times the states after it to column j of the derivatives."""
    for i in range(lanes):
        block[j * WIDTH + i] += change
    step_lanes(block, lanes)
    for i in range(lanes):
        for k in range(NX):
            jacobian[first + i, k, j] += factor * block[AT_NEXT + k * WIDTH + i]


@part
def load_motions(first: int, lanes: int, start: Matrix, p: Matrix, block: Floats) -> None:
    """Fill the working block with the states and the parameters of lanes first ... first + lanes - 1."""
    for i in range(lanes):
        for k in range(NX):
            block[k * WIDTH + i] = start[first + i, k]
        for k in range(NP):
            block[AT_PARAMETERS + k * WIDTH + i] = p[first + i, k]


@part
def store_states(first: int, lanes: int, block: Floats, at: int, states: Matrix) -> None:
    """Copy the states of some lanes, at index `at` of the working block, to rows first ... first + lanes - 1."""
    for i in range(lanes):
        for k in range(NX):
            states[first + i, k] = block[at + k * WIDTH + i]


@part
def whole_vectors(lanes: int) -> int:
    """Number of lanes to advance: the last few of a vector take as long one by one as a whole vector does."""
    rest = lanes % VECTOR
    return lanes + (VECTOR - rest) if rest > SINGLE_MAX else lanes


@part
def last_step(first: int, lanes: int, h: Matrix) -> int:
    """Number of steps (rows of `h`) of those of some lanes that have most."""
    steps = len(h)
    while steps > 0:
        for i in range(lanes):
            if h[steps - 1, first + i] != 0.0:
                return steps
        steps -= 1
    return 0


def _linearise(
    x: Matrix, u: Matrix, p: Floats, h: Floats, change: Floats, block: Floats, after: Matrix, jacobian: Floats
) -> None:
    """States (n, nx) after steps `h` (n,) from `x` (n, nx) with controls `u` (n, nu), and their derivatives.

    `jacobian` (n, nx, changes), zeros, receives central differences by `change` in state, control and parameters, in
    this order; without changes only the states are computed.
    """
    for first in range(0, len(h), WIDTH):
        lanes = min(WIDTH, len(h) - first)
        load_lanes(first, lanes, x, u, p, h, block)
        step_lanes(block, lanes)
        for i in range(lanes):
            for k in range(NX):
                after[first + i, k] = block[AT_NEXT + k * WIDTH + i]
        for j in range(len(change)):
            factor = 0.5 / change[j]
            add_change(first, lanes, j, change[j], factor, block, jacobian)
            add_change(first, lanes, j, -2.0 * change[j], -factor, block, jacobian)
            for i in range(lanes):
                block[j * WIDTH + i] += change[j]


def _simulate(
    start: Matrix, u: Floats, p: Matrix, h: Matrix, to_standstill: bool, block: Floats, states: Floats
) -> None:
    """Open-loop motions: `states` (steps + 1, m, nx) from `start` (m, nx) with controls `u` (steps, m, nu).

    Lane i of m has parameters `p` (m, np); its step k takes h[k, i] s, 0 beyond its last one.  With `to_standstill` a
    step in which the speed changes its sign is split there.
    """
    for first in range(0, len(start), WIDTH):
        lanes = min(WIDTH, len(start) - first)
        steps, wide = last_step(first, lanes, h), whole_vectors(lanes)
        load_motions(first, lanes, start, p, block)
        store_states(first, lanes, block, 0, states[0])
        for step in range(steps):
            for i in range(lanes):
                block[AT_STEP + i] = h[step, first + i]
                for k in range(NU):
                    block[AT_CONTROL + k * WIDTH + i] = u[step, first + i, k]
            step_lanes(block, wide)
            if to_standstill and SPEED >= 0:
                for i in range(lanes):
                    if block[SPEED * WIDTH + i] * block[AT_NEXT + SPEED * WIDTH + i] < 0.0:
                        step_over_standstill(block, i)
            store_states(first, lanes, block, AT_NEXT, states[step + 1])
            for i in range(lanes):
                for k in range(NX):
                    block[k * WIDTH + i] = block[AT_NEXT + k * WIDTH + i]
        for step in range(steps, len(u)):
            store_states(first, lanes, block, 0, states[step + 1])


_VECTOR, _MATRIX, _CUBE = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
linearise = compiled(
    _linearise,
    folder=FOLDER,
    signature=types.void(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _MATRIX, _CUBE),
)
simulate = compiled(
    _simulate,
    folder=FOLDER,
    signature=types.void(_MATRIX, _CUBE, _MATRIX, _MATRIX, types.boolean, _VECTOR, _CUBE),
)
