"""The vehicle's model with one more number in its state: how much faster the vehicle moves than the model says."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from kraft.model import STEP, Model
from ompl_ext.arrays import Floats, Matrix

MEMORY: Final = 2.0
"""Time constant with which an excess of speed that is no longer observed is forgotten, s."""
PROBE: Final = 1e-5
"""Step of the numeric derivatives, SI."""


class DriftModel:
    """State (nx + 1,): the vehicle's, then the excess of its speed (m/s).

    A speed that follows the commands in the model cannot be corrected for long by observations, the model pulls it
    back.  So the excess stands beside it: the model's motion plus that of driving `excess` m/s faster along the same
    curve.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.size = len(model.vehicle.state) + 1

    def advance(self, state: Floats, control: Floats, duration: float) -> Floats:
        """State (nx + 1,) after a control (nu,) was held for `duration` s."""
        steps = max(1, math.ceil(duration / STEP - 1e-9))
        for _ in range(steps if duration > 0.0 else 0):
            state = self._step(state, control, duration / steps)
        return state

    def linearised(self, state: Floats, control: Floats, duration: float) -> tuple[Floats, Matrix]:
        """The state (nx + 1,) after `duration` s and its derivative (nx + 1, nx + 1) by the state before."""
        after = self.advance(state, control, duration)
        jacobian = np.eye(self.size)
        for k in range(self.size):
            if k not in (self._model.x, self._model.y):  # a car moves alike everywhere
                probed = state.copy()
                probed[k] += PROBE
                jacobian[:, k] = (self.advance(probed, control, duration) - after) / PROBE
        return after, jacobian

    def _step(self, state: Floats, control: Floats, duration: float) -> Floats:
        model, excess = self._model, float(state[-1])
        after = np.empty(self.size)
        after[:-1] = model.advance(state[:-1], control, duration)
        kept = math.exp(-duration / MEMORY)
        way = excess * MEMORY * (1.0 - kept)
        steering = float(control[model.steering])
        turn = model.curvature(steering) * way
        direction = 0.5 * float(state[model.theta] + after[model.theta]) + 0.5 * turn + model.slip(steering)
        after[model.x] += way * math.cos(direction)
        after[model.y] += way * math.sin(direction)
        after[model.theta] += turn
        after[-1] = kept * excess
        return after
