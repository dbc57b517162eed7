"""Synthetic logs of a car with a lag, and what an identification says of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.synthetic_logs import CommandSeries, synthetic_logs
from benchmarks.sysid import TRUTH
from kraft.logs.log import Log
from kraft.sysid import Identification
from kraft.vehicles.config import VehicleConfig, load_vehicle_config


@cache
def lag() -> VehicleConfig:
    return load_vehicle_config("mushr-lag")


@cache
def logs(count: int = 6, seconds: float = 10.0) -> tuple[Log, ...]:
    return tuple(synthetic_logs(lag(), TRUTH, range(count), seconds=seconds))


def commanded(steering: Sequence[float], throttle: Sequence[float] = (0.5, 0.9), seconds: float = 8.0) -> CommandSeries:
    """CommandSeries of equal length, one after the other."""
    count = max(len(steering), len(throttle))
    rows = [[throttle[i % len(throttle)], steering[i % len(steering)]] for i in range(count)]
    return seconds * np.arange(count) / count, np.array(rows)


def driven(*commands: CommandSeries, **options: object) -> list[Log]:
    return synthetic_logs(lag(), TRUTH, range(len(commands)), seconds=8.0, commands=commands, **options)  # type: ignore[arg-type]


def changed(log: Log, name: str = "", **arrays: object) -> Log:
    return replace(log, name=name or log.name, parts=tuple(replace(p, **arrays) for p in log.parts))  # type: ignore[arg-type]


def said(result: Identification, *words: str) -> bool:
    return any(all(word in warning for word in words) for warning in result.warnings)
