"""Processor that numba compiles for: wide vectors where they are faster, and its name and features.

LLVM prefers vectors of 256 bits on every Intel processor with AVX-512, because the first ones lowered their clock for
512 bits.  Those with AVX512-FP16 (Sapphire Rapids and later) do not, and search takes a sixth less time with them.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import binding
from numba.core.codegen import get_host_cpu_features

_config: Any = numba.config  # numba's stubs lack these
_host_features: Any = get_host_cpu_features
_llvm: Any = binding


def with_wide_vectors(features: str) -> str | None:
    """Features of a processor in LLVM's notation with vectors of 512 bits; None if it is better off without them."""
    return f"{features},-prefer-256-bit" if "+avx512fp16" in features.split(",") else None


if _config.CPU_FEATURES is None and _config.CPU_NAME is None:  # otherwise the user has chosen (NUMBA_CPU_FEATURES)
    _config.CPU_FEATURES = with_wide_vectors(_host_features())


def processor() -> str:
    """Name and features of the processor that numba compiles for: the machine code runs on no other."""
    name = _llvm.get_host_cpu_name() if _config.CPU_NAME is None else _config.CPU_NAME
    return f"{name} {_host_features() if _config.CPU_FEATURES is None else _config.CPU_FEATURES}"
