"""Controls of a contingency manoeuvre in many states at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from numba import types

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.jit import compiled
from ompl_ext.kernels import functions as at
from ompl_ext.kernels.functions import call_stop


def _stop_controls(functions: Ints, states: Matrix, parameters: Floats, number: int, controls: Matrix) -> None:
    for k in range(len(states)):
        call_stop(functions[at.STOP], (states[k], parameters, number, controls[k]))


@cache
def stop_controls() -> Callable[[Ints, Matrix, Floats, int, Matrix], None]:
    """Function that writes controls (n, nu) of manoeuvre `number` in states (n, nx), not limited to their bounds.

    `functions` are those of the vehicle.  It is compiled, or loaded from the cache, on the first call.
    """
    floats, matrix = types.float64[::1], types.float64[:, ::1]
    return compiled(_stop_controls, signature=types.void(types.int64[::1], matrix, floats, types.int64, matrix))
