"""Integration of a batch of candidate edges as vector lanes: the planner's innermost loop.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
Lane i of component c has index c * WIDTH + i of a flat array: with constant strides in one array LLVM can prove the
lanes independent and vectorise the loop over them.  What follows the integration does not depend on the vehicle's
functions and is compiled apart: `checks` once for each layout of the state, `search` once for all.
"""

from __future__ import annotations

from numba import types

from ompl_ext.arrays import Floats, Matrix, int64
from ompl_ext.jit import callee, compiled, inlined
from ompl_ext.kernels import functions
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BRAKE_STEP,
    BRAKE_STEPS,
    CYCLE,
    LANE_WIDTH,
    REACH,
    STEPS,
    Lanes,
    Problem,
    block_layout,
)
from ompl_ext.kernels.runge_kutta import runge_kutta_4, runge_kutta_4_stages
from ompl_ext.kernels.specialise import layout_module_of, vehicle_being_compiled, vehicle_cache_folder
from ompl_ext.kernels.unroll import per_component, store_components, total_of_components

Values = tuple[float, ...]

VEHICLE = vehicle_being_compiled()
FOLDER = vehicle_cache_folder(VEHICLE)
NX = len(VEHICLE.state)
NU = len(VEHICLE.controls)
NI = len(VEHICLE.inputs) or NU
X, Y, THETA = (VEHICLE.index(name) for name in ("x", "y", "theta"))
MANOEUVRES = len(VEHICLE.manoeuvres)
WIDTH = LANE_WIDTH
AT_STEP, AT_DEVIATION, AT_OUTSIDE, _, _, AT_STAGES, AT_INPUT = block_layout(NX)
STAGE = NX * WIDTH

is_resting = layout_module_of(VEHICLE, "checks").is_resting
derivative = VEHICLE.derivative
actuation = VEHICLE.actuation or per_component("u, p", "u[{k}]", NU)
stop = VEHICLE.stop or per_component("x, p, k", "0.0", NU)
load_state = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NX)
load_input = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NI)
load_control = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NU)
first_state = per_component("a", "a[{k}]", NX)
first_control = per_component("a", "a[{k}]", NU)
load_parameters = per_component("p", "p[{k}]", len(VEHICLE.parameter_array))
load_low = per_component("limits", "limits[{k}, 0]", NX)
load_high = per_component("limits", "limits[{k}, 1]", NX)
rk4_step = runge_kutta_4(derivative, NX)
shifted, combined = runge_kutta_4_stages(NX)
outside = total_of_components(
    "x, low, high",
    "(0.0 if low[{k}] <= x[{k}] else 1.0) + (0.0 if x[{k}] <= high[{k}] else 1.0)",
    [k for k, name in enumerate(VEHICLE.state) if name in ("x", "y", "theta", *VEHICLE.limits)],
)
store_state = store_components(NX, WIDTH)
store_input = store_components(NI, WIDTH)


@inlined
def rate_change(first: Values, last: Values) -> tuple[float, float]:
    """Change of the rates of position (m/s, as the sum over both axes) and heading (rad/s) between two derivatives."""
    turning = abs(last[THETA] - first[THETA]) if THETA >= 0 else 0.0
    return abs(last[X] - first[X]) + abs(last[Y] - first[Y]), turning


@inlined
def integrate_lanes(block: Floats, lanes: int, p: Values, low: Values, high: Values, reach: float) -> None:
    """Advance every lane of the working block by its step; these loops vectorise.

    There is one loop for each stage of the Runge-Kutta step.  A stage is one chain of dependent operations, and with
    all four in one loop the processor would look no further ahead than to the chain of one vector of lanes.

    If a rate changes by d within a step of h s, the motion deviates from one at a constant rate by up to h d / 8.  The
    rest of the margin is left to `step_margin`, because most edges are never checked.
    """
    for i in range(lanes):
        k1 = derivative(load_state(block, 0, i), load_input(block, AT_INPUT, i), p)
        store_state(block, AT_STAGES, i, k1)
    for i in range(lanes):
        x = shifted(0.5 * block[AT_STEP + i], load_state(block, AT_STAGES, i), load_state(block, 0, i))
        store_state(block, AT_STAGES + STAGE, i, derivative(x, load_input(block, AT_INPUT, i), p))
    for i in range(lanes):
        x = shifted(0.5 * block[AT_STEP + i], load_state(block, AT_STAGES + STAGE, i), load_state(block, 0, i))
        store_state(block, AT_STAGES + 2 * STAGE, i, derivative(x, load_input(block, AT_INPUT, i), p))
    for i in range(lanes):
        x, h = load_state(block, 0, i), block[AT_STEP + i]
        first, k3 = load_state(block, AT_STAGES, i), load_state(block, AT_STAGES + 2 * STAGE, i)
        last = derivative(shifted(h, k3, x), load_input(block, AT_INPUT, i), p)
        y = combined(h / 6.0, first, load_state(block, AT_STAGES + STAGE, i), k3, last, x)
        shift, spin = rate_change(first, last)
        store_state(block, 0, i, y)
        block[AT_OUTSIDE + i] += outside(y, low, high)
        block[AT_DEVIATION + i] = 0.125 * h * (shift + reach * spin)


@inlined
def record_lanes(work: Lanes, step: int, lanes: int) -> None:
    """Copy state and deviation of every lane from the working block into the trajectory."""
    for k in range(NX):
        for i in range(lanes):
            work.trajectory[(step * NX + k) * WIDTH + i] = work.block[k * WIDTH + i]
    for i in range(lanes):
        work.deviation[step * WIDTH + i] = work.block[AT_DEVIATION + i]


@inlined
def load_source(source: Floats, work: Lanes, lanes: int, low: Values, high: Values) -> None:
    """Set every lane to one start state."""
    block = work.block
    for i in range(lanes):
        for k in range(NX):
            block[k * WIDTH + i] = source[k]
        block[AT_DEVIATION + i] = 0.0
        block[AT_OUTSIDE + i] = outside(load_state(block, 0, i), low, high)
    record_lanes(work, int64(0), lanes)


def propagate(source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
    """Integrate `lanes` candidate edges from `source`."""
    scalar, steps = problem.scalar, problem.option[STEPS]
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    load_source(source, work, lanes, low, high)
    for i in range(lanes):
        store_input(work.block, AT_INPUT, i, actuation(load_control(work.control, 0, i), p))
        work.block[AT_STEP + i] = work.duration[i] / work.steps[i]
    for step in range(1, steps + 1):
        for i in range(lanes):  # a lane with fewer steps than the others stays at its end
            if step > work.steps[i]:
                work.block[AT_STEP + i] = 0.0
        integrate_lanes(work.block, lanes, p, low, high, scalar[REACH])
        record_lanes(work, step, lanes)


def state_at_cycle_end(lane: int, start_time: float, problem: Problem, work: Lanes, source: Floats) -> None:
    """Write the state where an edge crosses the end of the cycle, or ends before it, into `source`."""
    p = load_parameters(problem.parameters)
    h = work.duration[lane] / work.steps[lane]
    into = min((problem.scalar[CYCLE] - start_time) / h, float(work.steps[lane]))
    step = min(max(int(into), 0), work.steps[lane])
    x = load_state(work.trajectory, step * NX * WIDTH, lane)
    u = actuation(load_control(work.control, 0, lane), p)
    x, _, _ = rk4_step(x, u, p, max(into - step, 0.0) * h)
    for k in range(NX):
        source[k] = x[k]


def brake(source: Floats, problem: Problem, brake: Lanes) -> int:
    """Integrate the contingency manoeuvres from `source` until all are at standstill; returns the number of steps."""
    manoeuvres = int64(MANOEUVRES)  # not a literal: numba compiles the callees once more for each
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    load_source(source, brake, manoeuvres, low, high)
    for i in range(manoeuvres):
        brake.block[AT_STEP + i] = problem.scalar[BRAKE_STEP]
    step, moving = int64(0), True
    while moving and step < problem.option[BRAKE_STEPS]:
        step += 1
        for i in range(manoeuvres):  # a manoeuvre is a control law, held over one step, within the vehicle's bounds
            u = stop(load_state(brake.block, 0, i), p, i)
            for k in range(NU):
                brake.control[k * WIDTH + i] = min(max(u[k], problem.controls[k, 0]), problem.controls[k, 1])
            store_input(brake.block, AT_INPUT, i, actuation(load_control(brake.control, 0, i), p))
        integrate_lanes(brake.block, manoeuvres, p, low, high, problem.scalar[REACH])
        record_lanes(brake, step, manoeuvres)
        moving = False
        for i in range(manoeuvres):
            moving = moving or not is_resting(brake, step, i, problem)
    return step


def stop_control(state: Floats, parameters: Floats, number: int, control: Floats) -> None:
    """Write the control of contingency manoeuvre `number` in a state."""
    u = stop(first_state(state), load_parameters(parameters), number)
    for k in range(NU):
        control[k] = u[k]


@inlined
def step_state(state: Floats, control: Floats, parameters: Floats, h: float, result: Floats) -> None:
    """Write the state after one step of `h` s."""
    p = load_parameters(parameters)
    y, _, _ = rk4_step(first_state(state), actuation(first_control(control), p), p, h)
    for k in range(NX):
        result[k] = y[k]


def advance_state(state: Floats, control: Floats, parameters: Floats, h: float, result: Floats) -> None:
    """Write the state after one step of `h` s, for kernels; numba caches it apart from what Python calls."""
    step_state(state, control, parameters, h, result)


def _advance(state: Floats, control: Floats, parameters: Floats, h: float, result: Floats) -> None:
    step_state(state, control, parameters, h, result)


def _roll_out(states: Floats, controls: Matrix, parameters: Floats, h: Floats) -> None:
    p = load_parameters(parameters)
    for motion in range(states.shape[0]):
        x, u = first_state(states[motion, 0]), actuation(first_control(controls[motion]), p)
        for step in range(1, states.shape[1]):
            x, _, _ = rk4_step(x, u, p, h[motion])
            for k in range(NX):
                states[motion, step, k] = x[k]


_FLOATS = types.float64[::1]
FUNCTIONS = {
    functions.PROPAGATE: propagate,
    functions.BRAKE: brake,
    functions.CYCLE_END: state_at_cycle_end,
    functions.STOP: stop_control,
    functions.ADVANCE: advance_state,
}
ADDRESSES = {number: callee(each, FOLDER, functions.SIGNATURES[number]) for number, each in FUNCTIONS.items()}
_STEP = types.void(_FLOATS, _FLOATS, _FLOATS, types.float64, _FLOATS)
advance = compiled(_advance, folder=FOLDER, signature=_STEP, nogil=False)  # too short to release the lock for it
roll_out = compiled(
    _roll_out,
    folder=FOLDER,
    signature=types.void(types.float64[:, :, ::1], types.float64[:, ::1], _FLOATS, _FLOATS),
)
