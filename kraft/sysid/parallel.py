"""Work of a fit on all cores: compiled kernels and large arrays release Python's global lock."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from ompl_ext.cores import usable_cores

Item = TypeVar("Item")
Found = TypeVar("Found")


def in_parallel(function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
    """Results of a function of each item, in their order, by threads on all cores; within such a thread in turn."""
    if getattr(_thread, "working", False):
        return [function(item) for item in items]

    return list(_pool().map(lambda item: _alone(function, item), items))


def begin(function: Callable[[Item], Found], item: Item) -> Future[Found]:
    """Start a function in a thread and return at once; `result()` waits for it, and raises what it raised."""
    return _pool().submit(_alone, function, item)


def _alone(function: Callable[[Item], Found], item: Item) -> Found:
    """Result of a function in a thread, whose own calls of `in_parallel` start no others."""
    _thread.working = True
    return function(item)


_thread = threading.local()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores(), "sysid")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has no threads
