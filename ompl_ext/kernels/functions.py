"""Functions that the kernels of all vehicles call by their addresses, which are in `Problem.functions`.

Those of a vehicle are compiled in `lanes`, those of the layout of its state in `checks`.  A call by address takes a few
tens of nanoseconds, a visit of the search some microseconds; a function inlined in the search would have to be compiled
with it for every vehicle, in a multiple of the time.
"""

from __future__ import annotations

from typing import Any

from numba import types

from ompl_ext.jit import caller
from ompl_ext.kernels.kernel_types import LANES, PROBLEM

PROPAGATE, BRAKE, CYCLE_END = 0, 1, 2  # of the vehicle
FINISH, CUT, CHECK, FIRST_SAFE = 3, 4, 5, 6  # of the layout of its state
INTERVALS = 7  # of the vehicle, for the local optimisation; 0 before that is loaded
STOP, ADVANCE = 8, 9  # of the vehicle
FUNCTIONS = 10

_FLOATS, _MATRIX = types.float64[::1], types.float64[:, ::1]
SIGNATURES: dict[int, Any] = {
    PROPAGATE: types.void(_FLOATS, types.int64, PROBLEM, LANES),
    BRAKE: types.int64(_FLOATS, PROBLEM, LANES),
    CYCLE_END: types.void(types.int64, types.float64, PROBLEM, LANES, _FLOATS),
    FINISH: types.void(types.int64, PROBLEM, LANES),
    CUT: types.boolean(types.int64, PROBLEM, LANES),
    CHECK: types.float64(types.int64, types.float64, PROBLEM, LANES),
    FIRST_SAFE: types.int64(types.int64, PROBLEM, LANES),
    INTERVALS: types.void(types.int64, types.int64, types.int64, types.float64, PROBLEM, _MATRIX, _MATRIX, _FLOATS),
    STOP: types.void(_FLOATS, _FLOATS, types.int64, _FLOATS),
    ADVANCE: types.void(_FLOATS, _FLOATS, _FLOATS, types.float64, _FLOATS),
}
call_propagate = caller(SIGNATURES[PROPAGATE])
call_brake = caller(SIGNATURES[BRAKE])
call_cycle_end = caller(SIGNATURES[CYCLE_END])
call_finish = caller(SIGNATURES[FINISH])
call_cut = caller(SIGNATURES[CUT])
call_check = caller(SIGNATURES[CHECK])
call_first_safe = caller(SIGNATURES[FIRST_SAFE])
call_intervals = caller(SIGNATURES[INTERVALS])
call_stop = caller(SIGNATURES[STOP])
call_advance = caller(SIGNATURES[ADVANCE])
