"""The kernel of DIRT over callbacks: `dirt` compiled with three functions that call back into Python.

A ctypes function is to numba a pointer that compiled code can call.  Python is then entered once for a blossom instead
of once for every step of the algorithm, each of which would have to unpack the tree's arrays.
"""

from __future__ import annotations

import collections
import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
from numba import types

from ompl_ext.arrays import Floats, int64
from ompl_ext.jit import compiled, part
from ompl_ext.kernels import dirt
from ompl_ext.kernels.kernel_types import FULL, LANES, PROBLEM, RETAINED_EDGES, TREE, Lanes, Problem, Retained, Tree

PROPAGATE = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)  # from a state's place, so many lanes
SAFE = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_double)  # a lane whose edge begins at a time (s)

_namedtuple: Any = collections.namedtuple  # mypy wants the names of fields written out
CallbackLanes = _namedtuple("CallbackLanes", (*Lanes._fields, "propagate", "safe", "stop"))  # stop[0]: 1 to end

_typeof: Any = numba.typeof  # without types of their own
_types: Any = types
_CALLBACKS = [_typeof(kind()) for kind in (PROPAGATE, SAFE)]
_CALLBACK_LANES = _types.NamedTuple([*LANES.types, *_CALLBACKS, types.int64[::1]], CallbackLanes)

Grow = Callable[[Tree, Problem, Any, Floats, Retained, int], None]


@part
def _propagate(source: Floats, lanes: int, problem: Problem, work: Any) -> None:
    work.propagate(int64(source[0]), lanes)


@part
def _check(lane: int, start_time: float, problem: Problem, work: Any) -> float:
    slack: float = work.slack[lane]
    return slack


@part
def _safe(lane: int, start_time: float, problem: Problem, work: Any, brake: Any) -> int:
    number: int = work.safe(lane, start_time)
    return number


def _grow(tree: Tree, problem: Problem, work: Any, q: Floats, retained: Retained, iterations: int) -> None:
    dirt.retain(tree, problem, work, work, retained, _propagate, _check, _safe)
    best = tree.best[0]
    for _ in range(iterations):
        dirt.visit(tree, problem, work, work, q, _propagate, _check, _safe)
        if tree.count[FULL] == 1 or work.stop[0] == 1 or tree.best[0] < best:
            return


@cache
def grow() -> Grow:
    """The kernel: retain edges, then visit nodes until told to stop or a better plan is found.

    Compiled, or loaded from the cache, on the first call.
    """
    signature = _types.void(TREE, PROBLEM, _CALLBACK_LANES, _types.float64[::1], RETAINED_EDGES, _types.int64)
    return compiled(_grow, signature=signature)
