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
    """Results of a function of each item, on all cores; in turn if this is one of the threads that do so already."""
    if getattr(_thread, "working", False):
        return [function(item) for item in items]

    return list(_pool().map(lambda item: _alone(function, item), items))


def begin(function: Callable[[Item], Found], item: Item) -> Future[Found]:
    """Begin a function of an item on one core, beside what follows."""
    return _pool().submit(_alone, function, item)


def _alone(function: Callable[[Item], Found], item: Item) -> Found:
    """Result of a function that uses no other core."""
    _thread.working = True
    return function(item)


_thread = threading.local()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores(), "sysid")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has no threads
