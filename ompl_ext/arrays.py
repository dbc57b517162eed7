"""Short names for the array types that cross module borders: vectors, and C-contiguous matrices.

The two kinds are the same to numpy and to a type checker that knows no shapes; the names let a reader, and the kernel
signatures made from them, tell them apart.
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
IntMatrix = np.ndarray[tuple[int, int], np.dtype[np.int64]]

int64 = cast(Callable[[int], int], np.int64)
"""Makes a number an int64 to numba where a literal would have every callee compiled once more for that literal."""
