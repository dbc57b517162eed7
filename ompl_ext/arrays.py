"""Array types used across modules: vectors and C-contiguous matrices.

numpy and type checkers do not distinguish the two kinds; readers and the kernel signatures made from the types do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Ints32 = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.uint64]
Matrix = np.ndarray[tuple[int, int], np.dtype[np.float64]]
Matrix32 = np.ndarray[tuple[int, int], np.dtype[np.float32]]
Words16 = npt.NDArray[np.uint16]
Words16Matrix = np.ndarray[tuple[int, int], np.dtype[np.uint16]]
Cube = np.ndarray[tuple[int, int, int], np.dtype[np.float64]]
Floats32Cube = np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
IntMatrix32 = np.ndarray[tuple[int, int], np.dtype[np.int32]]
IntMatrix = np.ndarray[tuple[int, int], np.dtype[np.int64]]

int64 = cast(Callable[[int], int], np.int64)
"""Conversion to int64: numba compiles every callee once more for each literal argument."""
