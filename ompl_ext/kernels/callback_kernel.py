"""Kernel of DIRT over callbacks: `dirt` compiled with functions that call back into Python.

numba treats a ctypes function as a pointer that compiled code can call.  Python is called once per blossom and once per
SAFETY check instead of at every step of the algorithm, which would have to unpack the tree's arrays each time.
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

PROPAGATE = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)  # slot of the start state, number of lanes
SAFE = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_double)  # lane, start time of its edge (s)

_namedtuple: Any = collections.namedtuple  # mypy requires literal field names
CallbackLanes = _namedtuple("CallbackLanes", (*Lanes._fields, "propagate", "safe", "stop"))  # stop[0] = 1 ends a run

_typeof: Any = numba.typeof  # numba has no types
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
    """Kernel that retains edges, then visits nodes until `stop` is set or a better plan is found.

    Compiled, or loaded from the cache, on the first call.
    """
    signature = _types.void(TREE, PROBLEM, _CALLBACK_LANES, _types.float64[::1], RETAINED_EDGES, _types.int64)
    return compiled(_grow, signature=signature, nogil=False)  # Python is called back
