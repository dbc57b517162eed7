"""The same function for many numbers, in processes of this machine."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

from kraft.driving.method import load_method
from kraft.evaluation.statistics import grouped_share_interval, wilson
from kraft.planning.compilation import ensure_compiled
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

Result = TypeVar("Result")
TELL_EVERY = 30.0  # s


def each(function: Callable[[int], Result], numbers: range, jobs: int, chunk: int = 1) -> list[Result]:
    """Results in the order of the numbers; `function` is sent to other processes if there is more than one job."""
    if jobs == 1:
        return list(_told(map(function, numbers), len(numbers)))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        return list(_told(pool.map(function, numbers, chunksize=chunk), len(numbers)))


def _told(results: Iterable[Result], total: int) -> Iterator[Result]:
    """The same, telling how far it has come."""
    said = time.monotonic()
    for done, result in enumerate(results, 1):
        yield result
        if time.monotonic() - said > TELL_EVERY:
            said = time.monotonic()
            print(f"  {done:,} of {total:,}", file=sys.stderr, flush=True)


def planning_vehicle(method: str, name: str | None = None) -> Vehicle:
    """Vehicle of that name, or the one that a bundled method plans with, compiled."""
    vehicle = load_vehicle(name or load_method(method).planner.vehicle or "mushr")
    ensure_compiled(vehicle, lambda text: print(text, file=sys.stderr))
    return vehicle


def interval(count: int, total: int) -> str:
    """Share with its 95 % Wilson interval, in percent."""
    low, high = wilson(count, total)
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def grouped_interval(counts: Sequence[int], sizes: Sequence[int]) -> str:
    """95 % interval of a share, in percent, by the bootstrap over groups of alike drives: `counts` of their `sizes`."""
    low, high = grouped_share_interval(counts, sizes)
    return f"{100 * low:.1f} to {100 * high:.1f} %"
