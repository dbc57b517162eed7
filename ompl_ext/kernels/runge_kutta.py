"""Classical Runge-Kutta step over tuples of floats, for a vehicle's derivative."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ompl_ext.jit import inlined
from ompl_ext.kernels.unroll import per_component


def runge_kutta_4_stages(count: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled parts of a step: `shifted(a, k, x)`, where a stage is evaluated, and `combined(a, k1, k2, k3, k4, x)`.

    A stage is evaluated at `a` = h / 2, h / 2 and h along the derivatives of the stage before it; the step combines all
    stages with `a` = h / 6.
    """
    return (
        per_component("a, k, x", "x[{k}] + a * k[{k}]", count),
        per_component("a, k1, k2, k3, k4, x", "x[{k}] + a * (k1[{k}] + 2.0 * (k2[{k}] + k3[{k}]) + k4[{k}])", count),
    )


def runge_kutta_4(derivative: Callable[..., Any], count: int) -> Callable[..., Any]:
    """Compiled function `step(x, u, p, h)` of h s for `count` state components.

    It returns the state after the step, and the derivatives of the first and last stage.
    """
    shifted, combined = runge_kutta_4_stages(count)

    @inlined
    def step(x, u, p, h):  # type: ignore[no-untyped-def]
        k1 = derivative(x, u, p)
        k2 = derivative(shifted(0.5 * h, k1, x), u, p)
        k3 = derivative(shifted(0.5 * h, k2, x), u, p)
        k4 = derivative(shifted(h, k3, x), u, p)
        return combined(h / 6.0, k1, k2, k3, k4, x), k1, k4

    return step
