"""Seeded random generator with its state in an array: a plan depends on its seed alone.

SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014): a counter through a mixing
function.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ompl_ext.jit import inlined

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30 = np.uint64(30)
_S27 = np.uint64(27)
_S31 = np.uint64(31)
_S11 = np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2**-53


@inlined
def uniform(rng: npt.NDArray[np.uint64]) -> float:
    """Next number in [0, 1); `rng` is the generator's state, shape (1,)."""
    rng[0] += _GOLDEN
    z = (rng[0] ^ (rng[0] >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    z = z ^ (z >> _S31)
    return np.float64(z >> _S11) * _TO_UNIT


def generator(seed: int) -> npt.NDArray[np.uint64]:
    """Generator state for `seed` (any integer; reduced modulo 2**64), shape (1,)."""
    return np.array([(seed * 0xD1342543DE82EF95 + 0x2545F4914F6CDD1D) % 2**64], dtype=np.uint64)
