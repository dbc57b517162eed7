"""Replays of trials, read back as the page of the report does."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ompl_ext.arrays import Floats


def unpacked(text: str) -> Any:
    """JSON of a compressed text."""
    return json.loads(zlib.decompress(base64.b64decode(text, validate=True)))


def values_of(series: Sequence[Any]) -> Floats:
    """Numbers of a series."""
    quantum, order, integers = series
    values = np.asarray(integers, dtype=np.int64)
    for _ in range(order):
        values = np.cumsum(values)
    return np.asarray(values * quantum, dtype=float)
