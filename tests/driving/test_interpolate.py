"""Interpolation in plain numbers gives what numpy's does, to the last bit."""

from __future__ import annotations

import numpy as np

from kraft.driving.car_model import interpolate


def test_it_is_numpys_also_at_the_knots_and_beyond_the_ends() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 7):
        xs, ys = np.sort(rng.uniform(size=count)), rng.normal(size=count)
        for x in (*rng.uniform(-0.2, 1.2, 50), *xs):
            assert interpolate(float(x), xs.tolist(), ys.tolist()) == np.interp(x, xs, ys)
