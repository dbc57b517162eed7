"""Functions over tuples with every component written out.

A loop over a tuple's components hides the values from LLVM's vectoriser; straight-line code does not.  The number of
components is known once the vehicle is, so the lines are written out here instead of by hand for each vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ompl_ext.jit import inlined


def per_component(arguments: str, item: str, count: int) -> Callable[..., Any]:
    """A compiled function of `arguments` returning the tuple of `item`, `{k}` standing for the component."""
    items = "".join(item.replace("{k}", str(k)) + ", " for k in range(count))
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def unrolled({arguments}):\n    return ({items})\n", namespace)
    return inlined(namespace["unrolled"])


def total_of_components(arguments: str, item: str, components: list[int]) -> Callable[..., Any]:
    """A compiled function of `arguments` returning the sum of `item` over some components."""
    items = " + ".join("(" + item.replace("{k}", str(k)) + ")" for k in components)
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def total({arguments}):\n    return {items}\n", namespace)
    return inlined(namespace["total"])


def store_components(count: int, width: int) -> Callable[..., Any]:
    """A compiled `store(array, start, lane, values)` writing component k at `start + k * width + lane`."""
    lines = "".join(f"    array[start + lane + {k * width}] = values[{k}]\n" for k in range(count))
    namespace: dict[str, Callable[..., Any]] = {}
    exec(f"def store(array, start, lane, values):\n{lines or '    pass'}\n", namespace)
    return inlined(namespace["store"])
