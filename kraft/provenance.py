"""Where a result comes from: versions of the software, and hashes of what it was made with."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from pydantic import BaseModel

from kraft.version import VERSION

PLANNING: Final = ("numba", "numpy", "ompl")
"""Distributions that shape a plan."""
SIMULATION: Final = (*PLANNING, "mujoco", "scipy")
"""Distributions that shape a trial."""
IDENTIFICATION: Final = ("gtsam", "numba", "numpy", "scipy")
"""Distributions that shape identified parameters."""


def versions(distributions: Iterable[str]) -> dict[str, str]:
    """Versions of kraft, of the named distributions and of Python."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"kraft": VERSION, **{name: version(name) for name in distributions}, "python": python}


def plain(value: Any) -> Any:
    """A value as nested lists and dictionaries; arrays as their shape and the hash of their bytes.

    What a dataclass leaves out of comparisons (where in a file a value was written) is left out here too.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, np.ndarray):
        return [list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        return {type(value).__name__: {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.compare}}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def plain_hash(value: Any) -> str:
    """SHA-256 of a value's plain data."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()
