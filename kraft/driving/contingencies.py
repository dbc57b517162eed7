"""Contingencies as the controller tracks them, in one ranking, and the emergency manoeuvre.

Alg. 2 of the paper verifies a manoeuvre as the model drives it.  What the car drives is the controller's tracking of
that manoeuvre, which differs from it by centimetres.  Here the closed loop is predicted until standstill instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from kraft.driving.messages import ContingencyOrigin, PredictedMotion, Reference, ReferenceKind
from kraft.driving.prediction import ClosedLoopPredictor
from kraft.driving.references import manoeuvre_reference
from kraft.driving.vehicle_model import VehicleModel, stop_control
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.poses import poses_of
from ompl_ext.solver import DirtSolver

FOLLOWED: Final = (0.3, 0.6, 1.0)
"""Times for which a plan is followed before the vehicle stops, s."""
CREEPING_SPEED: Final = 0.2
"""Speed at which the path of a plan is followed, m/s."""
CREEPING_LENGTH: Final = 0.6
"""Length of the path that is followed at that speed, m."""
BACKWARDS: Final = 0.01
"""Speed backwards from which on a path changes its direction, m/s."""
NOWHERE: Final = 1e-3
"""Length of a path up to which it leads nowhere, m."""
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
    def rounded_slack(self) -> int:
        """Least slack in 1 / RESOLUTION m."""
        return _rounded(self.predicted.slack)

    @property
    def rank(self) -> tuple[bool, float, int, float]:
        """Sort key: verified, the lowest impact speed, the largest least slack, the earliest standstill."""
        return self.is_verified, -self.impact_speed, self.rounded_slack, -float(self.predicted.times[-1])


class Begin(NamedTuple):
    """Where contingencies begin: in `state` (nx,) at `time` s; the clearance grows from `cycle_start` s on."""

    state: Floats
    time: float
    cycle_start: float


class ContingencyRanking:
    """Ranks contingencies by the least slack of their tracked motion."""

    def __init__(self, dirt: DirtSolver, predict: ClosedLoopPredictor, model: VehicleModel) -> None:
        """`dirt` has the obstacles and the clearance, `predict` the controller, `model` the vehicle."""
        self._dirt, self._predict, self._model = dirt, predict, model

    def best(self, begin: Begin, in_hand: Reference | None, plans: Sequence[Reference]) -> TrackedContingency:
        """Best contingency from `begin`; an emergency if none keeps the clearance.

        Candidates are all manoeuvres, the contingency `in_hand`, and those that follow one of the `plans` first.
        """
        here = _Motion(np.array([begin.time]), np.asarray(begin.state)[None, :])
        (bound,) = self._rounded_slacks(begin, [here])  # all candidates begin here
        found: TrackedContingency | None = None
        for candidates in (self._immediate(begin, in_hand), self._along(begin, plans)):
            if found is None or found.rounded_slack < bound:
                found = self._better(found, list(candidates), begin, bound)
        assert found is not None, "a vehicle has manoeuvres"
        return found if found.is_verified else replace(found, origin=ContingencyOrigin.EMERGENCY)

    def _better(
        self, found: TrackedContingency | None, candidates: list[_Candidate], begin: Begin, bound: int
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
            tracked = self._track(begin, candidate.reference(), candidate.origin)
            found = tracked if found is None or tracked.rank > found.rank else found
        return found

    def _track(self, begin: Begin, reference: Reference, origin: ContingencyOrigin) -> TrackedContingency:
        predicted = self._predict.until_rest(begin.state, begin.time, reference, begin.cycle_start)
        if predicted.slack >= 0.0:
            return TrackedContingency(reference, origin, predicted)
        states, vehicle = predicted.states, self._dirt.vehicle
        contact = self._dirt.exact.first_contact(poses_of(states, vehicle))
        if contact is None:
            return TrackedContingency(reference, origin, predicted)
        before = states[max(contact - 1, 0)]  # it may stand where it touches
        return TrackedContingency(reference, origin, predicted, abs(float(before[vehicle.rest_indices[0]])))

    def _rounded_slacks(self, begin: Begin, motions: Sequence[_Motion]) -> list[int]:
        """Least slacks of motions in the model (in 1 / RESOLUTION m)."""
        if not motions:
            return []
        times, states = (np.concatenate(each) for each in zip(*motions, strict=True))
        ends = np.cumsum([len(each.times) for each in motions])
        return [_rounded(slack) for slack in self._dirt.least_slacks(states, times - begin.cycle_start, ends).tolist()]

    def _times(self, begin: float, states: Matrix) -> Floats:
        """Times (n,) of the states (n, nx) of a manoeuvre that begins at `begin` s."""
        times: Floats = begin + self._dirt.safety.step * np.arange(len(states), dtype=float)
        return times

    def _immediate(self, begin: Begin, in_hand: Reference | None) -> Iterator[_Candidate]:
        """All manoeuvres, and the contingency in hand."""
        state, time, _ = begin
        for number, states in enumerate(self._dirt.manoeuvres(state)):
            build, times = partial(self._manoeuvre, number, time, states), self._times(time, states)
            yield _Candidate(_Motion(times, states), float(times[-1]), ContingencyOrigin.SAFE, build)
        if in_hand is not None:
            left = in_hand.times >= min(time, in_hand.end)
            motion = _Motion(np.maximum(in_hand.times[left], time), in_hand.states[left])
            yield _Candidate(motion, in_hand.end, ContingencyOrigin.IN_HAND, lambda: in_hand)

    def _along(self, begin: Begin, plans: Sequence[Reference]) -> Iterator[_Candidate]:
        """Contingencies that follow a plan first; they do not move a vehicle that stands."""
        state, time, _ = begin
        if self._dirt.safety.is_resting(self._dirt.vehicle, state):
            return
        for plan in plans:
            for leaves in (time + duration for duration in FOLLOWED if time + duration < plan.end):
                during, followed = _part(plan, time, leaves)
                for number, states in enumerate(self._dirt.manoeuvres(followed[-1])):
                    times = self._times(leaves, states)
                    motion = _Motion(np.concatenate([during, times]), np.vstack([followed, states]))
                    build = partial(self._after, plan, time, number, leaves, states)
                    yield _Candidate(motion, float(times[-1]), ContingencyOrigin.PLAN_THEN_STOP, build)
            creeping = self._creeping(state, time, plan)
            if creeping is not None:
                yield creeping

    def _manoeuvre(self, number: int, time: float, states: Matrix) -> Reference:
        return manoeuvre_reference(self._dirt.vehicle, number, self._times(time, states), states)

    def _after(self, plan: Reference, begin: float, number: int, leaves: float, states: Matrix) -> Reference:
        return _joined(plan, begin, self._manoeuvre(number, leaves, states))

    def _creeping(self, state: Floats, time: float, plan: Reference) -> _Candidate | None:
        """Path of a plan from `time` s on, at low speed as soon as the brakes allow, then standstill.

        None if the plan is over, leads nowhere from here, or goes backwards within that length.
        """
        model = self._model
        if time >= plan.end or float(state[model.v]) <= 0.0:
            return None
        planned, path = _part(plan, time, plan.end)
        places = np.concatenate([[0.0], np.hypot(*np.diff(path[:, [model.x, model.y]], axis=0).T).cumsum()])
        backwards = path[places <= CREEPING_LENGTH, model.v] < -BACKWARDS
        if places[-1] < NOWHERE or backwards.any():
            return None
        speeds, arc_lengths = self._creeping_speeds(state, min(CREEPING_LENGTH, float(places[-1])))
        states = interpolated_rows(np.array(arc_lengths), places, path)
        others = model.velocities[1:]  # they stay in proportion to the speed
        states[:, others] *= (np.array(speeds) / np.maximum(states[:, model.v], speeds))[:, None]
        states[:, model.v] = speeds
        times, stop = self._times(time, states), self._dirt.manoeuvres(states[-1])[0]
        stopping = self._times(float(times[-1]), stop)
        motion = _Motion(np.concatenate([times[:-1], stopping]), np.vstack([states[:-1], stop]))
        planned_at = np.interp(arc_lengths[:-1], places, planned)
        build = partial(self._creeping_reference, plan, _Motion(times, states), planned_at, stop)
        return _Candidate(motion, float(stopping[-1]), ContingencyOrigin.CREEPING, build)

    def _creeping_reference(self, plan: Reference, creeping: _Motion, planned_at: Floats, stop: Matrix) -> Reference:
        """Reference of a creeping motion and the stop (m, nx) after it; its steps follow what is planned at times (n,).

        Its controls take longer than the motion, and few candidates are tracked.
        """
        model, (times, states) = self._model, creeping
        pairs = zip(planned_at, states[:-1], states[1:], strict=True)
        step = self._dirt.safety.step
        controls = np.array([model.control_to(x, plan.control_at(float(t)), after, step) for t, x, after in pairs])
        moving = Reference(ReferenceKind.PLAN, times, states, controls, plan.rest)
        return _joined(moving, float(times[0]), self._manoeuvre(0, float(times[-1]), stop))

    def _creeping_speeds(self, state: Floats, length: float) -> tuple[list[float], list[float]]:
        """Speeds (m/s) and arc lengths (m) up to `length`, one for each step: braking first, then creeping."""
        step, braking = self._dirt.safety.step, self._dirt.manoeuvres(state)[0][:, self._model.v]
        speeds, arc_lengths = [float(state[self._model.v])], [0.0]
        slow = max(min(CREEPING_SPEED, speeds[0]), 0.1 * CREEPING_SPEED)
        while arc_lengths[-1] < length:
            speeds.append(max(float(braking[min(len(speeds), len(braking) - 1)]), slow))
            arc_lengths.append(arc_lengths[-1] + 0.5 * step * (speeds[-2] + speeds[-1]))
        return speeds, arc_lengths


class _Motion(NamedTuple):
    """States (n, nx) in the model at `times` (n,) s."""

    times: Floats
    states: Matrix


@dataclass(frozen=True)
class _Candidate:
    """Contingency before it is tracked: motion in the model, end (s), origin, reference."""

    motion: _Motion
    end: float
    origin: ContingencyOrigin
    reference: Callable[[], Reference]


def _rounded(slack: float) -> int:
    return round(slack * RESOLUTION)


def _part(plan: Reference, begin: float, end: float) -> _Motion:
    """Times and states of a reference between two times (s)."""
    inner = _between(plan, begin, end)
    times: Floats = np.concatenate([[begin], plan.times[inner], [end]])
    return _Motion(times, np.vstack([plan.state_at(begin), plan.states[inner], plan.state_at(end)]))


def _between(plan: Reference, begin: float, end: float) -> Ints:
    """Numbers of the samples of a reference between two times (s)."""
    return np.flatnonzero((plan.times > begin + 1e-6) & (plan.times < end - 1e-6))


def _joined(plan: Reference, begin: float, stop: Reference) -> Reference:
    """A plan from `begin` s on until a manoeuvre begins, and that manoeuvre."""
    times, states = _part(plan, begin, stop.start)
    controls = np.vstack([plan.control_at(begin), plan.controls[_between(plan, begin, stop.start)]])
    return Reference(
        ReferenceKind.CONTINGENCY,
        np.concatenate([times[:-1], stop.times]),
        np.vstack([states[:-1], stop.states]),
        np.vstack([controls, stop.controls]),
        stop.rest,
        stop.stop,
    )


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
