"""Functions over tuples with every component written out.

LLVM vectorises straight-line code but not a loop over a tuple's components.  The number of components depends on the
vehicle, so the source is generated for each vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ompl_ext.jit import inlined


def per_component(arguments: str, item: str, count: int) -> Callable[..., Any]:
    """Compiled function of `arguments` that returns the tuple of `item` with `{k}` replaced by each component."""
    items = "".join(item.replace("{k}", str(k)) + ", " for k in range(count))
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def unrolled({arguments}):\n    return ({items})\n", namespace)
    return inlined(namespace["unrolled"])


def total_of_components(arguments: str, item: str, components: list[int]) -> Callable[..., Any]:
    """Compiled function of `arguments` that returns the sum of `item` over some components."""
    items = " + ".join("(" + item.replace("{k}", str(k)) + ")" for k in components)
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def total({arguments}):\n    return {items}\n", namespace)
    return inlined(namespace["total"])


def store_components(count: int, width: int) -> Callable[..., Any]:
    """Compiled `store(array, start, lane, values)` that writes component k at `start + k * width + lane`."""
    lines = "".join(f"    array[start + lane + {k * width}] = values[{k}]\n" for k in range(count))
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def store(array, start, lane, values):\n{lines or '    pass'}\n", namespace)
    return inlined(namespace["store"])
