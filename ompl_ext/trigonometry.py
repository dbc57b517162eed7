"""Branch-free trigonometric functions for vehicle derivatives.

Calls of the C library keep LLVM from vectorising the loop over lanes.  These functions are polynomials without branches
or tables, so that candidate edges are integrated together as vector lanes; being plain IEEE arithmetic they give the
same bits on every machine.  Absolute error is below 1e-11 for |x| < 1000 rad
(`sin`, `cos`) and below 1e-9 (`atan`); `tests/ompl_ext/test_kernel_trigonometry.py` measures it.
"""

from __future__ import annotations

from ompl_ext.jit import inlined

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding and subtracting it rounds a double to the nearest integer
_TWO_OVER_PI = 0.6366197723675814
_HALF_PI_HI = 1.5707963267948966
_HALF_PI_LO = 6.123233995736766e-17
_QUARTER_PI = 0.7853981633974483


@inlined
def _reduced(x: float) -> tuple[float, float, float]:
    """Sine and cosine of x minus its nearest multiple of pi/2, and the quadrant 0, 1, 2 or 3."""
    n = (x * _TWO_OVER_PI + _ROUND) - _ROUND
    r = (x - n * _HALF_PI_HI) - n * _HALF_PI_LO  # in [-pi/4, pi/4]
    quadrant = n - 4.0 * (((n * 0.25 - 0.375) + _ROUND) - _ROUND)
    z = r * r
    s = -2.505210838544172e-8  # Taylor, degree 11
    s = 2.7557319223985893e-6 + z * s
    s = -1.984126984126984e-4 + z * s
    s = 8.333333333333333e-3 + z * s
    s = -1.6666666666666666e-1 + z * s
    c = 2.08767569878681e-9  # Taylor, degree 12
    c = -2.755731922398589e-7 + z * c
    c = 2.48015873015873e-5 + z * c
    c = -1.388888888888889e-3 + z * c
    c = 4.1666666666666664e-2 + z * c
    c = -0.5 + z * c
    return r + r * z * s, 1.0 + z * c, quadrant


@inlined
def sin(x: float) -> float:
    """Sine of `x` (rad).  Together with `cos` of the same argument the compiler computes the shared part once."""
    s, c, quadrant = _reduced(x)
    value = s if quadrant == 0.0 or quadrant == 2.0 else c
    return value if quadrant < 2.0 else -value


@inlined
def cos(x: float) -> float:
    """Cosine of `x` (rad)."""
    s, c, quadrant = _reduced(x)
    value = c if quadrant == 0.0 or quadrant == 2.0 else s
    return -value if quadrant == 1.0 or quadrant == 2.0 else value


@inlined
def tan(x: float) -> float:
    """Tangent of `x` (rad)."""
    return sin(x) / cos(x)


@inlined
def atan(x: float) -> float:
    """Arc tangent of `x`, in (-pi/2, pi/2)."""
    a = abs(x)
    inverse = a > 1.0
    y = 1.0 / a if inverse else a
    shifted = y > 0.4142135623730950
    w = (y - 1.0) / (y + 1.0) if shifted else y  # |w| <= tan(pi/8)
    z = w * w
    p = -0.05263157894736842
    p = 0.058823529411764705 + z * p
    p = -0.06666666666666667 + z * p
    p = 0.07692307692307693 + z * p
    p = -0.09090909090909091 + z * p
    p = 0.1111111111111111 + z * p
    p = -0.14285714285714285 + z * p
    p = 0.2 + z * p
    p = -0.3333333333333333 + z * p
    p = w + w * z * p
    p = p + _QUARTER_PI if shifted else p
    p = _HALF_PI_HI - p if inverse else p
    return -p if x < 0.0 else p
