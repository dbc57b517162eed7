"""Contingencies as the controller tracks them, in one ranking, and the emergency manoeuvre.

Alg. 2 of the paper verifies a manoeuvre as the model drives it.  What the car drives is the controller's tracking of
that manoeuvre, which differs from it by centimetres.  Here the closed loop is predicted until standstill instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.contingency_candidates import Begin, ContingencyCandidate, ContingencyCandidates, ModelMotion
from kraft.driving.messages import ContingencyOrigin, PredictedMotion, Reference
from kraft.driving.prediction import ClosedLoopPredictor
from kraft.driving.references import manoeuvre_reference
from kraft.driving.vehicle_model import VehicleModel, stop_control
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.poses import poses_of
from ompl_ext.solver import DirtSolver

TRACKING: Final = 0.03
"""Difference between the slack of a contingency in the model and when it is tracked that is allowed for, m."""
PREDICTIONS: Final = 8
"""Number of predictions of tracked contingencies, if one of them is verified; without one, twice as many."""
RESOLUTION: Final = 1000.0
"""Slacks that are equal when rounded to 1 / RESOLUTION m are equal."""


@dataclass(frozen=True)
class TrackedContingency:
    """Contingency with the predicted motion of the closed loop until standstill.

    `impact_speed` is that at the first contact with an obstacle (m/s), 0 without one.
    """

    reference: Reference
    origin: ContingencyOrigin
    predicted: PredictedMotion
    impact_speed: float = 0.0

    @property
    def is_verified(self) -> bool:
        """Whether the motion keeps the clearance that SAFETY asks for."""
        return self.predicted.slack >= 0.0

    @property
    def rounded_slack(self) -> float:
        """Least slack in 1 / RESOLUTION m, see `_rounded`."""
        return _rounded(self.predicted.slack)

    @property
    def rank(self) -> tuple[bool, float, float, float]:
        """Sort key: verified, the lowest impact speed, the largest least slack, the earliest standstill."""
        return self.is_verified, -self.impact_speed, self.rounded_slack, -float(self.predicted.times[-1])


class ContingencyRanking:
    """Ranks contingencies by the least slack of their tracked motion."""

    def __init__(self, dirt: DirtSolver, predict: ClosedLoopPredictor, model: VehicleModel) -> None:
        """`dirt` has the obstacles and the clearance, `predict` the controller, `model` the vehicle."""
        self._dirt, self._predict = dirt, predict
        self.candidates = ContingencyCandidates(dirt, model)

    def best(self, begin: Begin, in_hand: Reference | None, plans: Sequence[Reference]) -> TrackedContingency:
        """Best contingency from `begin`; an emergency if none keeps the clearance.

        Candidates are all manoeuvres, the contingency `in_hand`, and those that follow one of the `plans` first.
        """
        here = ModelMotion(np.array([begin.time]), np.asarray(begin.state)[None, :])
        (bound,) = self._rounded_slacks(begin, [here])  # all candidates begin here
        found: TrackedContingency | None = None
        for candidates in (self.candidates.immediate(begin, in_hand), self.candidates.along(begin, plans)):
            if found is None or found.rounded_slack < bound:
                found = self._better(found, list(candidates), begin, bound)
        assert found is not None, "a vehicle has manoeuvres"
        return found if found.is_verified else replace(found, origin=ContingencyOrigin.EMERGENCY)

    def _better(
        self, found: TrackedContingency | None, candidates: list[ContingencyCandidate], begin: Begin, bound: float
    ) -> TrackedContingency | None:
        """Best of `found` and of the candidates; only those are tracked that can be better."""
        slacks = self._rounded_slacks(begin, [each.motion for each in candidates])
        ranked = sorted(zip(slacks, candidates, strict=True), key=lambda pair: (-pair[0], pair[1].end))
        for count, (slack, candidate) in enumerate(ranked):
            if found is not None and found.is_verified:
                beaten = slack + TRACKING * RESOLUTION < found.rounded_slack
                if beaten or found.rounded_slack >= bound or count >= PREDICTIONS:
                    break
            elif count >= 2 * PREDICTIONS:
                break
            tracked = self.track(begin, candidate.reference(), candidate.origin)
            found = tracked if found is None or tracked.rank > found.rank else found
        return found

    def track(self, begin: Begin, reference: Reference, origin: ContingencyOrigin) -> TrackedContingency:
        """Predict the closed loop of a contingency from `begin` until standstill."""
        predicted = self._predict.until_rest(begin.state, begin.time, reference, begin.cycle_start)
        if predicted.slack >= 0.0:
            return TrackedContingency(reference, origin, predicted)
        states, vehicle = predicted.states, self._dirt.vehicle
        contact = self._dirt.exact.first_contact(poses_of(states, vehicle))
        if contact is None:
            return TrackedContingency(reference, origin, predicted)
        before = states[max(contact - 1, 0)]  # it may stand where it touches
        return TrackedContingency(reference, origin, predicted, abs(float(before[vehicle.rest_indices[0]])))

    def _rounded_slacks(self, begin: Begin, motions: Sequence[ModelMotion]) -> list[float]:
        """Least slacks of motions in the model (in 1 / RESOLUTION m), see `_rounded`."""
        if not motions:
            return []
        times, states = (np.concatenate(each) for each in zip(*motions, strict=True))
        ends = np.cumsum([len(each.times) for each in motions])
        return [_rounded(slack) for slack in self._dirt.least_slacks(states, times - begin.cycle_start, ends).tolist()]


def _rounded(slack: float) -> float:
    """A slack (m) in 1 / RESOLUTION m; that of a motion with states that are not numbers is less than any other."""
    return -math.inf if math.isnan(slack) else round(slack * RESOLUTION, 0)


def emergency_reference(dirt: DirtSolver, state: Floats, start: float) -> Reference:
    """Manoeuvre with the largest distance to obstacles, or the lowest impact speed if all of them collide.

    It is used when no manoeuvre can be verified, which means that an assumption was violated; the alternative would be
    to drive on.
    """
    manoeuvres = [_PredictedManoeuvre.of(dirt, state, number) for number in range(len(dirt.vehicle.manoeuvres))]
    best = max(manoeuvres, key=lambda each: (each.distance, -each.impact_speed))
    times: Floats = start + dirt.safety.step * np.arange(len(best.states), dtype=float)
    return manoeuvre_reference(dirt.vehicle, best.number, times, best.states)


@dataclass(frozen=True)
class _PredictedManoeuvre:
    """States (m, nx) of manoeuvre `number`, one for each step of SAFETY until standstill.

    `distance` is the smallest to an obstacle (m), and `impact_speed` that at the first contact (m/s; 0 without one).
    """

    number: int
    states: Matrix
    distance: float
    impact_speed: float

    @classmethod
    def of(cls, dirt: DirtSolver, state: Floats, number: int) -> _PredictedManoeuvre:
        """Predict manoeuvre `number` from a state (nx,) with the model, and measure its distances with FCL."""
        vehicle, safety = dirt.vehicle, dirt.safety
        states, distance, impact_speed = [np.asarray(state, dtype=float)], math.inf, 0.0
        for _ in range(round(safety.horizon / safety.step)):
            samples, _slack = dirt.edge(states[-1], stop_control(vehicle, states[-1], number), safety.step)
            poses = poses_of(samples, vehicle)
            nearest = dirt.least_distance(poses)
            if distance > 0.0 >= nearest:
                impact_speed = abs(float(states[-1][vehicle.rest_indices[0]]))
            distance = min(distance, nearest)
            states.append(samples[-1])
            if safety.is_resting(vehicle, states[-1]):
                break
        return cls(number, np.array(states), distance, impact_speed)
