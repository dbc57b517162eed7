"""What the robot expects of itself: the controller tracking a reference over the model, tick by tick."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass

import numpy as np

from kraft.control import Controller
from kraft.driving import Estimate, Motion, Reference
from ompl_ext.arrays import Floats
from ompl_ext.solver import Dirt


@dataclass(frozen=True)
class Roller:
    """Rolls the closed loop out: `dirt` has the model and the obstacles, `period` is that of the controller (s)."""

    dirt: Dirt
    controller: Controller
    period: float

    def __call__(self, state: Floats, begin: float, end: float, reference: Reference) -> Motion:
        """Track `reference` from `state` at `begin` s until `end` s; SAFETY's cycle begins at `begin`.

        The controller itself is left as it is.
        """
        controller = copy.deepcopy(self.controller)
        ticks = max(0, math.ceil((end - begin) / self.period - 1e-9))
        times = np.minimum(begin + self.period * np.arange(ticks + 1), end)
        states, slack = [np.asarray(state, dtype=float)], math.inf
        for now, after in itertools.pairwise(times):
            control = controller.command(Estimate(float(now), states[-1], 0.0), reference)
            trajectory, spare = self.dirt.edge(states[-1], control, float(after - now), float(now - begin))
            states.append(trajectory[-1])
            slack = min(slack, spare)
        return Motion(times, np.array(states), slack)
