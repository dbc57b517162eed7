"""Prediction of the closed loop: how the controller will track a reference, and how much clearance that leaves."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from kraft.driving.control import Controller, compiled_law, tracking_law
from kraft.driving.messages import Commitment, Estimate, PredictedMotion, Reference
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.tracking import Ticks
from ompl_ext.solver import DirtSolver
from ompl_ext.times import SAME_TIME


@dataclass(frozen=True)
class ClosedLoopPredictor:
    """Predicts the closed loop; `dirt` has the model and the obstacles, `period` is that of the controller (s)."""

    dirt: DirtSolver
    controller: Controller
    period: float

    def __call__(self, state: Floats, begin: float, end: float, commitment: Commitment) -> PredictedMotion:
        """Track the reference on board from `state` at `begin` s until `end` s; SAFETY's cycle starts at `begin`.

        A copy of the controller tracks, so the controller keeps its state.
        """
        ticks = max(0, math.ceil((end - begin) / self.period - 1e-9))
        times = np.minimum(begin + self.period * np.arange(ticks + 1), end)
        on_board = [(commitment.reference, ticks)]
        if commitment.contingency is not None:
            switch = int(np.searchsorted(times[:-1], commitment.switch - SAME_TIME))
            on_board = [(commitment.reference, switch), (commitment.contingency, ticks)]
        controller, first, slack = copy.deepcopy(self.controller), 0, math.inf
        at, controls = np.asarray(state, dtype=float), [np.zeros((0, len(self.dirt.vehicle.controls)))]
        states = [at[None, :]]
        for reference, last in on_board:
            during = self._ticks(times[first:last], np.diff(times[first : last + 1]), times[first:last] - begin)
            driven, commands, least = self._drive(controller, reference, at, during)
            states.append(driven[1:])
            controls.append(commands)
            at, first, slack = driven[-1], last, min(slack, least)
        return PredictedMotion(times, np.vstack(states), slack, controls=np.vstack(controls))

    def until_rest(self, state: Floats, begin: float, contingency: Reference, cycle_start: float) -> PredictedMotion:
        """Track a contingency from `state` at `begin` s until standstill, with SAFETY's clearance all the way.

        The clearance grows from `cycle_start` s on.  A vehicle that still moves when SAFETY's horizon is over after the
        end of the contingency has negative slack.
        """
        latest = max(begin, contingency.end) + self.dirt.safety.horizon
        times: Floats = begin + self.period * np.arange(math.ceil((latest - begin) / self.period) + 2, dtype=float)
        ticks = int(np.searchsorted(times, latest, side="right"))
        during = self._ticks(times[:ticks], np.full(ticks, self.period), times[:ticks] - cycle_start)
        start = np.asarray(state, dtype=float)
        law = copy.deepcopy(tracking_law(self.controller, contingency))  # a predictive controller has more to copy
        with self.dirt.with_clearance_until(float(times[-1]) - cycle_start):
            states, _, worst = self._drive(law, contingency, start, during, contingency.end - SAME_TIME)
        if len(states) > ticks and not self.dirt.safety.is_resting(self.dirt.vehicle, states[-1]):
            worst = -1.0
        least = least_slack(self.dirt, states, times[: len(states)] - cycle_start)
        worst = worst if len(states) > 1 else least  # a vehicle at rest has no edge
        slack = min(worst, least) if worst < 0.0 else max(least, 0.0)
        return PredictedMotion(times[: len(states)], states, slack)

    def _ticks(self, times: Floats, durations: Floats, since: Floats) -> Ticks:
        """Ticks at `times` (n,) s, `since` (n,) s after the cycle's start; each but the last takes one period."""
        steps = np.full(len(times), self.dirt.steps_of(self.period))
        if len(times) > 0:
            steps[-1] = self.dirt.steps_of(float(durations[-1]))
        return Ticks(times, durations, steps, since)

    def _drive(
        self, controller: Controller, reference: Reference, state: Floats, ticks: Ticks, until: float = math.inf
    ) -> tuple[Matrix, Matrix, float]:
        """Track a reference from `state` (nx,): states (n + 1, nx), controls (n, nu), and the least slack (m).

        It ends early at standstill at or after `until` (s).
        """
        law = compiled_law(controller, reference)
        if law is not None:
            return law.drive(self.dirt, reference, state, ticks, until)
        states, controls, slack = [state], [np.zeros((0, len(self.dirt.vehicle.controls)))], math.inf
        for time, duration, since in zip(
            ticks.time.tolist(), ticks.duration.tolist(), ticks.since.tolist(), strict=True
        ):
            if time >= until and self.dirt.safety.is_resting(self.dirt.vehicle, states[-1]):
                break
            control = controller.command(Estimate(time, states[-1], 0.0), reference)
            trajectory, step_slack = self.dirt.edge(states[-1], control, duration, since)
            states.append(trajectory[-1])
            controls.append(control[None, :])
            slack = min(slack, step_slack)
        return np.array(states), np.vstack(controls), slack


def required_clearance(dirt: DirtSolver, states: Matrix, since: Floats | float = math.inf) -> Floats:
    """Clearance delta(t, v) (n,) that SAFETY asks of states (n, nx) `since` s, or (n,), after the cycle's start, m."""
    speeds = states[:, dirt.vehicle.rest_indices[0]]
    return dirt.safety.clearance(speeds, np.broadcast_to(since, len(states)))


def least_slack(dirt: DirtSolver, states: Matrix, since: Floats | float) -> float:
    """Smallest clearance of states (n, nx) beyond the one that SAFETY asks for (m), a lower bound; `since` as above."""
    return float(dirt.least_slacks(states, np.full(len(states), since), np.array([len(states)]))[0])
