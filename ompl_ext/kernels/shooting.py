"""Integration of the intervals of a trajectory, for the local optimisation of one vehicle's plans.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
"""

from __future__ import annotations

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.jit import callee
from ompl_ext.kernels import functions
from ompl_ext.kernels.kernel_types import LANE_WIDTH, Problem
from ompl_ext.kernels.runge_kutta import runge_kutta_4
from ompl_ext.kernels.specialise import vehicle_being_compiled, vehicle_cache_folder
from ompl_ext.kernels.unroll import per_component, store_components

VEHICLE = vehicle_being_compiled()
NX, NU = len(VEHICLE.state), len(VEHICLE.controls)
M = NU + 1
NI = len(VEHICLE.inputs) or NU
WIDTH = LANE_WIDTH
SUBSTEPS = 4  # of the integration of an interval
AT_CONTROL = NX * WIDTH  # the working block: state, control, duration, input
AT_STEP = AT_CONTROL + NU * WIDTH
AT_INPUT = AT_STEP + WIDTH
BLOCK = AT_INPUT + NI * WIDTH

derivative = VEHICLE.derivative
actuation = VEHICLE.actuation or per_component("u, p", "u[{k}]", NU)
load_state = per_component("a, i", f"a[i + {{k}} * {WIDTH}]", NX)
load_control = per_component("a, i", f"a[{AT_CONTROL} + i + {{k}} * {WIDTH}]", NU)
load_input = per_component("a, i", f"a[{AT_INPUT} + i + {{k}} * {WIDTH}]", NI)
load_parameters = per_component("p", "p[{k}]", len(VEHICLE.parameter_array))
rk4_step = runge_kutta_4(derivative, NX)
store_state = store_components(NX, WIDTH)
store_input = store_components(NI, WIDTH)


def integrate(
    first: int, lanes: int, column: int, change: float, problem: Problem, states: Matrix, inputs: Matrix, block: Floats
) -> None:
    """Integrate intervals `first` ... with one component of state, control and duration changed; this vectorises."""
    p = load_parameters(problem.parameters)
    for i in range(lanes):
        for k in range(NX):
            block[k * WIDTH + i] = states[first + i, k]
        for k in range(M):
            block[AT_CONTROL + k * WIDTH + i] = inputs[first + i, k]
        if column >= 0:
            block[column * WIDTH + i] += change
    for i in range(lanes):
        store_input(block, AT_INPUT, i, actuation(load_control(block, i), p))
    for _ in range(SUBSTEPS):
        for i in range(lanes):
            x, _, _ = rk4_step(load_state(block, i), load_input(block, i), p, block[AT_STEP + i] * (1.0 / SUBSTEPS))
            store_state(block, 0, i, x)


ADDRESS = callee(integrate, vehicle_cache_folder(VEHICLE), functions.SIGNATURES[functions.INTERVALS])
