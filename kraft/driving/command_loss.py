"""Loss of commands: the way of a robot that its multiplexer stops, and the clearance on it.

Without commands a robot holds the last one for the multiplexer's timeout.  Then it brakes with its wheels as they are.
No controller tracks anything meanwhile, so the contingency on board does not help: a plan has to leave room for this.
The search does not know that, so a plan that leaves no room is driven more slowly in its first cycle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.messages import PredictedMotion
from kraft.driving.references import plan_reference
from kraft.driving.vehicle_model import braking_control
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver
from ompl_ext.times import SAME_TIME

MOMENTS: Final = 0.1
"""Time between two moments at which the loss of commands is examined, s."""
STEP: Final = 0.05
"""Time for which a control of the braking robot is held in the prediction, s."""
SHARES: Final = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)
"""Shares of the drive with which a plan that leaves no room is tried in turn."""


@dataclass(frozen=True)
class CommandLoss:
    """Predicts where a robot stops without commands; `dirt` has the model and the obstacles, `timeout` is in s."""

    dirt: DirtSolver
    timeout: float

    def slack(self, motion: PredictedMotion) -> float:
        """Least slack (m) if commands are lost in a cycle; not all of it is examined once it is negative."""
        assert motion.controls is not None, "the motion of a cycle is predicted with its controls"
        begin = due = float(motion.times[0])
        worst = math.inf
        for time, state, control in zip(motion.times[:-1], motion.states[:-1], motion.controls, strict=True):
            if time < due - SAME_TIME:
                continue
            due = float(time) + MOMENTS
            worst = min(worst, self._slack_after(state, control, float(time) - begin))
            if worst < 0.0:
                break
        return worst

    def _slack_after(self, state: Floats, held: Floats, since: float) -> float:
        """Slack from the last command to standstill, negative if the robot does not stand within SAFETY's horizon.

        The last command is sent `since` s after the beginning of the cycle, from which on the clearance grows.
        """
        dirt, horizon, brakes = self.dirt, self.dirt.safety.horizon, since + self.timeout
        with dirt.with_clearance_until(brakes + horizon + STEP):
            trajectory, slack = dirt.edge(state, held, self.timeout, since)
            for step in range(math.ceil(horizon / STEP)):
                if slack < 0.0 or dirt.safety.is_resting(dirt.vehicle, trajectory[-1]):
                    return slack
                control = braking_control(dirt.vehicle, trajectory[-1], held)
                trajectory, step_slack = dirt.edge(trajectory[-1], control, STEP, brakes + step * STEP)
                slack = min(slack, step_slack)
        return -1.0

    def keeps(self, plan: Plan, cycle: float) -> bool:
        """Whether a robot on a plan stops with clearance if commands are lost within its first `cycle` s."""
        reference = plan_reference(self.dirt.vehicle, plan, 0.0)
        last = min(int(np.searchsorted(reference.times, cycle - SAME_TIME)), len(reference.controls))
        times, states = reference.times[: last + 1], reference.states[: last + 1]
        return self.slack(PredictedMotion(times, states, 0.0, controls=reference.controls[:last])) >= 0.0

    @cached_property
    def _driven(self) -> Bools:
        return model_of(self.dirt.vehicle).driven

    def slower(self, plan: Plan, root: Floats, cycle: float, seed: int) -> Iterator[Plan]:
        """The plan from `root` (nx,) with less and less drive in its first `cycle` s, where that is free and safe.

        Then it goes on as it was, as far as it is free, and it has a contingency if SAFETY asks for one.  The tree of
        `dirt` is replaced, with `seed` for its numbers.
        """
        dirt = self.dirt
        for share in SHARES if len(plan.durations) > 0 else ():
            controls, durations, slowed = _slowed_edges(plan, self._driven, share, cycle, dirt.settings.longest)
            dirt.start(root, seed)
            retained = dirt.retain_edges(np.arange(len(durations)) - 1, controls, durations, optimised=True)
            if retained < slowed:
                continue
            slower = dirt.plan_to(int(dirt.retained_nodes[retained - 1]))
            # one that ends within the cycle ends where no plan had to: short of the goal that the faster one reached
            if slower.contingency is not None or not dirt.safety.enabled:
                yield slower


def _slowed_edges(plan: Plan, driven: Bools, share: float, cycle: float, longest: float) -> tuple[Matrix, Floats, int]:
    """Controls (n, nu) and durations (n,) of a plan with a share of its drive in the first `cycle` s.

    An edge that is slowed takes as much longer as it is slower, so it ends about where it did; it is divided where it
    would take more than `longest` s.  The number of the edges that are slowed comes last.
    """
    controls, durations, time, slowed = list[Floats](), list[float](), 0.0, 0
    for control, duration in zip(plan.controls, plan.durations.tolist(), strict=True):
        slow, left = min(duration / share, max(0.0, cycle - time)), duration
        if slow > SAME_TIME:
            parts = math.ceil(slow / longest - 1e-9)
            controls += parts * [np.where(driven, share * control, control)]
            durations += parts * [slow / parts]
            time, slowed, left = time + slow, len(durations), duration - share * slow
        if left > SAME_TIME:
            controls.append(control)
            durations.append(left)
    return np.array(controls), np.array(durations), slowed
