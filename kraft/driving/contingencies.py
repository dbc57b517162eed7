"""Contingencies as the controller tracks them: references, the predicted closed loop, one ranking, and the watchdog.

Alg. 2 of the paper verifies a manoeuvre as the model drives it.  What the car drives is the controller's tracking of
that manoeuvre, which differs from it by centimetres.  Here the closed loop is predicted until standstill instead.  The
car has its newest message on board, and a watchdog that stops it without poses or messages (`OnBoard`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from kraft.driving.control import Controller, compiled_law
from kraft.driving.messages import (
    Commitment,
    ContingencyOrigin,
    Estimate,
    PredictedMotion,
    Reference,
    ReferenceKind,
    Stop,
)
from kraft.driving.method import PlannerSettings
from kraft.driving.vehicle_model import VehicleModel, braking_control, stop_control
from kraft.planning.workspace import poses_of
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.tracking import Ticks
from ompl_ext.plan import Contingency, Plan
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle


def plan_reference(vehicle: Vehicle, plan: Plan, start: float, cycle: float = 0.0) -> Reference:
    """Reference of a plan that starts at `start` s of the trial; after its end the vehicle is held.

    A plan that ends within its `cycle` (s), in the goal, is followed by its contingency: the vehicle may be fast there.
    """
    edges = np.searchsorted(np.cumsum(plan.durations), plan.times[:-1] + 1e-9, side="right")
    controls = plan.controls[np.minimum(edges, max(0, len(plan.durations) - 1))]
    rest = holding_control(vehicle, plan.trajectory[-1])
    reference = Reference(ReferenceKind.PLAN, start + plan.times, plan.trajectory, controls, rest)
    if plan.contingency is None or plan.cost >= cycle:
        return reference
    stop = contingency_reference(vehicle, plan.contingency)
    return replace(
        reference,
        times=np.concatenate([reference.times, reference.end + stop.times[1:] - stop.start]),
        states=np.vstack([reference.states, stop.states[1:]]),
        controls=np.vstack([controls, stop.controls]),
        rest=stop.rest,
    )


def contingency_reference(vehicle: Vehicle, contingency: Contingency) -> Reference:
    """Reference of a contingency whose times are those of the trial (s); after its end the car is held."""
    number = vehicle.manoeuvres.index(contingency.manoeuvre)
    return manoeuvre_reference(vehicle, number, contingency.times, contingency.states)


def manoeuvre_reference(vehicle: Vehicle, number: int, times: Floats, states: Matrix) -> Reference:
    """Reference of manoeuvre `number` with states (m, nx) at `times` (m,) s; after its end the car is held."""
    controls = np.array([stop_control(vehicle, state, number) for state in states[:-1]])
    controls = controls.reshape(-1, len(vehicle.controls))
    rest = holding_control(vehicle, states[-1])
    return Reference(ReferenceKind.CONTINGENCY, times, states, controls, rest, Stop(number, float(times[0])))


def holding_control(vehicle: Vehicle, state: Floats) -> Floats:
    """Control (nu,) that holds a vehicle that stands: on level ground zero, against a force the throttle against it.

    It is the first manoeuvre's at a speed of 0: brakes that stay on would push a standing car backwards.
    """
    standing = np.array(state, dtype=float)
    standing[list(vehicle.rest_indices)] = 0.0
    return stop_control(vehicle, standing, 0) + 0.0  # without negative zeros


def emergency_reference(dirt: DirtSolver, state: Floats, start: float) -> Reference:
    """Manoeuvre with the largest distance to obstacles, or the lowest impact speed if all of them collide.

    It is used when no manoeuvre can be verified, which means that an assumption was violated; the alternative would be
    to drive on.
    """
    manoeuvres = [_PredictedManoeuvre.of(dirt, state, number) for number in range(len(dirt.vehicle.manoeuvres))]
    return max(manoeuvres, key=lambda each: (each.distance, -each.impact_speed)).reference(start, dirt.safety.step)


def required_clearance(dirt: DirtSolver, states: Matrix, since: float = math.inf) -> Floats:
    """Clearance delta(t, v) (n,) that SAFETY asks of states (n, nx) `since` s after the begin of the cycle, m."""
    speeds = states[:, dirt.vehicle.rest_indices[0]]
    return dirt.safety.clearance(speeds, np.full(len(states), since))


def least_slack(dirt: DirtSolver, states: Matrix, since: float = math.inf) -> float:
    """Smallest clearance of states (n, nx) beyond the one that SAFETY asks for (m), a lower bound."""
    poses = poses_of(states, dirt.vehicle)
    return float((dirt.clearances(poses) - required_clearance(dirt, states, since)).min())


@dataclass(frozen=True)
class _PredictedManoeuvre:
    """States (m, nx) of a manoeuvre until standstill, controls (m - 1, nu) between them, `rest` (nu,) afterwards.

    `distance` is the smallest to an obstacle (m), and `impact_speed` that at the first contact (m/s; 0 without one).
    """

    number: int
    states: Matrix
    controls: Matrix
    rest: Floats
    distance: float
    impact_speed: float

    @classmethod
    def of(cls, dirt: DirtSolver, state: Floats, number: int) -> _PredictedManoeuvre:
        """Predict manoeuvre `number` from a state (nx,) with the model, and measure its distances with FCL."""
        vehicle, safety = dirt.vehicle, dirt.safety
        states, controls, distance, impact_speed = [np.asarray(state, dtype=float)], [], math.inf, 0.0
        for _ in range(round(safety.horizon / safety.step)):
            controls.append(stop_control(vehicle, states[-1], number))
            samples, _slack = dirt.edge(states[-1], controls[-1], safety.step)
            poses = poses_of(samples, vehicle)
            nearest = float(dirt.exact.distances(poses).min())
            if distance > 0.0 >= nearest:
                impact_speed = abs(float(states[-1][vehicle.rest_indices[0]]))
            distance = min(distance, nearest)
            states.append(samples[-1])
            if is_resting(dirt, states[-1]):
                break
        rest = holding_control(vehicle, states[-1])
        return cls(number, np.array(states), np.array(controls), rest, distance, impact_speed)

    def reference(self, start: float, step: float) -> Reference:
        """Reference that starts at `start` s, with a state every `step` s."""
        times: Floats = start + step * np.arange(len(self.states), dtype=float)
        return Reference(
            ReferenceKind.CONTINGENCY, times, self.states, self.controls, self.rest, Stop(self.number, start)
        )


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
            switch = int(np.searchsorted(times[:-1], commitment.switch - 1e-9))
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

    def until_rest(self, state: Floats, begin: float, contingency: Reference) -> PredictedMotion:
        """Track a contingency from `state` at `begin` s until standstill, with SAFETY's clearance all the way.

        A vehicle that still moves when SAFETY's horizon is over after the end of the contingency has negative slack.
        """
        latest = max(begin, contingency.end) + self.dirt.safety.horizon
        times: Floats = begin + self.period * np.arange(math.ceil((latest - begin) / self.period) + 2, dtype=float)
        ticks = int(np.searchsorted(times, latest, side="right"))
        during = self._ticks(times[:ticks], np.full(ticks, self.period), np.zeros(ticks))
        start = np.asarray(state, dtype=float)
        worst = self.dirt.edge(start, np.zeros(len(self.dirt.vehicle.controls)), 0.0, 0.0)[1]
        controller = copy.deepcopy(self.controller)
        states, _, slack = self._drive(controller, contingency, start, during, contingency.end - 1e-9)
        worst = min(worst, slack)
        if len(states) > ticks and not is_resting(self.dirt, states[-1]):
            worst = -1.0
        least = least_slack(self.dirt, states)
        slack = min(worst, least) if worst < 0.0 else max(least, 0.0)
        return PredictedMotion(times[: len(states)], states, slack)

    def _ticks(self, times: Floats, durations: Floats, since: Floats) -> Ticks:
        """Ticks at `times` (n,) s, `since` s after the begin, for `durations` (n,): a period, but for the last."""
        steps = np.full(len(times), self.dirt.steps_of(self.period))
        if len(times) > 0:
            steps[-1] = self.dirt.steps_of(float(durations[-1]))
        return Ticks(times, durations, steps, since)

    def _drive(
        self, controller: Controller, reference: Reference, state: Floats, ticks: Ticks, until: float = math.inf
    ) -> tuple[Matrix, Matrix, float]:
        """Track a reference from `state` (nx,): states (n + 1, nx), controls (n, nu), and the least spare clearance.

        It ends early at standstill at or after `until` (s).
        """
        law = compiled_law(controller, reference)
        if law is not None:
            return law.drive(self.dirt, reference, state, ticks, until)
        states, controls, slack = [state], [np.zeros((0, len(self.dirt.vehicle.controls)))], math.inf
        for time, duration, since in zip(
            ticks.time.tolist(), ticks.duration.tolist(), ticks.since.tolist(), strict=True
        ):
            if time >= until and is_resting(self.dirt, states[-1]):
                break
            control = controller.command(Estimate(time, states[-1], 0.0), reference)
            trajectory, step_slack = self.dirt.edge(states[-1], control, duration, since)
            states.append(trajectory[-1])
            controls.append(control[None, :])
            slack = min(slack, step_slack)
        return np.array(states), np.vstack(controls), slack


def is_resting(dirt: DirtSolver, state: Floats) -> bool:
    """Whether a state (nx,) is at standstill."""
    return all(abs(state[k]) <= dirt.safety.rest_speed for k in dirt.vehicle.rest_indices)


FOLLOWED: Final = (0.3, 0.6, 1.0)
"""Times for which a plan is followed before the vehicle stops, s."""
CREEPING_SPEED: Final = 0.2
"""Speed at which the path of a plan is followed, m/s."""
CREEPING_LENGTH: Final = 0.6
"""Length of the path that is followed at that speed, m."""
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
    def slack(self) -> int:
        """Least slack in 1 / RESOLUTION m."""
        return round(self.predicted.slack * RESOLUTION)

    @property
    def rank(self) -> tuple[bool, float, int, float]:
        """Sort key: verified, the lowest impact speed, the largest least slack, the earliest standstill."""
        return self.is_verified, -self.impact_speed, self.slack, -float(self.predicted.times[-1])


@dataclass(frozen=True)
class _Candidate:
    """Contingency before it is tracked: least slack in the model (in 1 / RESOLUTION m), end (s), origin, reference."""

    slack: int
    end: float
    origin: ContingencyOrigin
    reference: Callable[[], Reference]


class ContingencyRanking:
    """Ranks contingencies by the least slack of their tracked motion."""

    def __init__(self, dirt: DirtSolver, predict: ClosedLoopPredictor, model: VehicleModel) -> None:
        """`dirt` has the obstacles and the clearance, `predict` the controller, `model` the vehicle."""
        self._dirt, self._predict, self._model = dirt, predict, model

    def best(
        self, state: Floats, time: float, in_hand: Reference | None, plans: Sequence[Reference]
    ) -> TrackedContingency:
        """Best contingency from `state` (nx,) at `time` s; an emergency if none keeps the clearance.

        Candidates are all manoeuvres, the contingency `in_hand`, and those that follow one of the `plans` first.
        """
        bound = self._rounded(np.asarray(state)[None, :])  # all candidates begin here
        found: TrackedContingency | None = None
        for candidates in (self._immediate(state, time, in_hand), self._along(state, time, plans)):
            if found is None or found.slack < bound:
                found = self._better(found, list(candidates), state, time, bound)
        assert found is not None, "a vehicle has manoeuvres"
        return found if found.is_verified else replace(found, origin=ContingencyOrigin.EMERGENCY)

    def _better(
        self, found: TrackedContingency | None, candidates: list[_Candidate], state: Floats, time: float, bound: int
    ) -> TrackedContingency | None:
        """Best of `found` and of the candidates; only those are tracked that can be better."""
        for count, candidate in enumerate(sorted(candidates, key=lambda each: (-each.slack, each.end))):
            if found is not None and found.is_verified:
                beaten = candidate.slack + TRACKING * RESOLUTION < found.slack
                if beaten or found.slack >= bound or count >= PREDICTIONS:
                    break
            elif count >= 2 * PREDICTIONS:
                break
            tracked = self._track(state, time, candidate.reference(), candidate.origin)
            found = tracked if found is None or tracked.rank > found.rank else found
        return found

    def _track(self, state: Floats, time: float, reference: Reference, origin: ContingencyOrigin) -> TrackedContingency:
        predicted = self._predict.until_rest(state, time, reference)
        if predicted.slack >= 0.0:
            return TrackedContingency(reference, origin, predicted)
        coarse = predicted.states[::3]
        poses = poses_of(coarse, self._dirt.vehicle)
        hits = self._dirt.exact.distances(poses) <= 0.0
        speeds = np.abs(coarse[:, self._dirt.vehicle.rest_indices[0]])
        return TrackedContingency(reference, origin, predicted, float(speeds[hits.argmax()]) if hits.any() else 0.0)

    def _rounded(self, states: Matrix) -> int:
        return round(least_slack(self._dirt, states) * RESOLUTION)

    def _immediate(self, state: Floats, time: float, in_hand: Reference | None) -> Iterator[_Candidate]:
        """All manoeuvres, and the contingency in hand."""
        for number, states in enumerate(self._dirt.manoeuvres(state)):
            build = partial(self._manoeuvre, number, time, states)
            yield _Candidate(self._rounded(states), self._end(time, states), ContingencyOrigin.SAFE, build)
        if in_hand is not None:
            left = in_hand.states[in_hand.times >= min(time, in_hand.end)]
            yield _Candidate(self._rounded(left), in_hand.end, ContingencyOrigin.IN_HAND, lambda: in_hand)

    def _along(self, state: Floats, time: float, plans: Sequence[Reference]) -> Iterator[_Candidate]:
        """Contingencies that follow a plan first; they do not move a vehicle that stands."""
        for plan in plans if not is_resting(self._dirt, state) else ():
            for leaves in (time + duration for duration in FOLLOWED if time + duration < plan.end):
                _, followed, _ = _part(plan, time, leaves)
                for number, states in enumerate(self._dirt.manoeuvres(followed[-1])):
                    slack = self._rounded(np.vstack([followed, states]))
                    build = partial(self._after, plan, time, number, leaves, states)
                    yield _Candidate(slack, self._end(leaves, states), ContingencyOrigin.PLAN_THEN_STOP, build)
            creeping = self._creeping(state, time, plan)
            if creeping is not None:
                slack = self._rounded(creeping.states)
                yield _Candidate(slack, creeping.end, ContingencyOrigin.CREEPING, partial(replace, creeping))

    def _end(self, time: float, states: Matrix) -> float:
        return time + self._dirt.safety.step * (len(states) - 1)

    def _manoeuvre(self, number: int, time: float, states: Matrix) -> Reference:
        times: Floats = time + self._dirt.safety.step * np.arange(len(states), dtype=float)
        return manoeuvre_reference(self._dirt.vehicle, number, times, states)

    def _after(self, plan: Reference, begin: float, number: int, leaves: float, states: Matrix) -> Reference:
        return _joined(plan, begin, self._manoeuvre(number, leaves, states))

    def _creeping(self, state: Floats, time: float, plan: Reference) -> Reference | None:
        """Path of a plan from `time` s on, at low speed as soon as the brakes allow, then standstill.

        None if the plan is over, or soon changes its direction of travel.
        """
        model, step = self._model, self._dirt.safety.step
        if time >= plan.end or float(state[model.v]) <= 0.0:
            return None
        planned, path, _ = _part(plan, time, plan.end)
        if float(path[:, model.v].min()) < 0.0:
            return None
        places = np.concatenate([[0.0], np.hypot(*np.diff(path[:, [model.x, model.y]], axis=0).T).cumsum()])
        speeds, arc_lengths = self._creeping_speeds(state, min(CREEPING_LENGTH, float(places[-1])))
        states = np.column_stack([np.interp(arc_lengths, places, column) for column in path.T])
        others = model.velocities[1:]  # they stay in proportion to the speed
        states[:, others] *= (np.array(speeds) / np.maximum(states[:, model.v], speeds))[:, None]
        states[:, model.v] = speeds
        times: Floats = time + step * np.arange(len(states), dtype=float)
        at = np.interp(arc_lengths[:-1], places, planned)
        pairs = zip(at, states[:-1], states[1:], strict=True)
        controls = np.array([model.control_to(x, plan.control_at(float(t)), after, step) for t, x, after in pairs])
        moving = Reference(ReferenceKind.PLAN, times, states, controls, plan.rest)
        return _joined(moving, time, self._manoeuvre(0, float(times[-1]), self._dirt.manoeuvres(states[-1])[0]))

    def _creeping_speeds(self, state: Floats, length: float) -> tuple[list[float], list[float]]:
        """Speeds (m/s) and arc lengths (m) up to `length`, one for each step: braking first, then creeping."""
        step, braking = self._dirt.safety.step, self._dirt.manoeuvres(state)[0][:, self._model.v]
        speeds, arc_lengths = [float(state[self._model.v])], [0.0]
        slow = max(min(CREEPING_SPEED, speeds[0]), 0.1 * CREEPING_SPEED)
        while arc_lengths[-1] < length:
            speeds.append(max(float(braking[min(len(speeds), len(braking) - 1)]), slow))
            arc_lengths.append(arc_lengths[-1] + 0.5 * step * (speeds[-2] + speeds[-1]))
        return speeds, arc_lengths


def _part(plan: Reference, begin: float, end: float) -> tuple[Floats, Matrix, Matrix]:
    """Times, states and controls of a reference between two times (s)."""
    inner = np.flatnonzero((plan.times > begin + 1e-6) & (plan.times < end - 1e-6))
    times: Floats = np.concatenate([[begin], plan.times[inner], [end]])
    states = np.vstack([plan.state_at(begin), plan.states[inner], plan.state_at(end)])
    controls = np.vstack([plan.control_at(begin), plan.controls[inner]])
    return times, states, controls


def _joined(plan: Reference, begin: float, stop: Reference) -> Reference:
    """A plan from `begin` s on until a manoeuvre begins, and that manoeuvre."""
    times, states, controls = _part(plan, begin, stop.start)
    return Reference(
        ReferenceKind.CONTINGENCY,
        np.concatenate([times[:-1], stop.times]),
        np.vstack([states[:-1], stop.states]),
        np.vstack([controls, stop.controls]),
        stop.rest,
        stop.stop,
    )


class OnBoard:
    """Commitment that the car tracks, and the watchdog.

    The watchdog intervenes if the newest observation is too old, or if the car is on a plan and no message has arrived
    for longer than a cycle and the watchdog's time.  The car then brakes from where it believes to be, with
    the wheels as they are, until a message arrives that was decided after that, with a recent observation.
    """

    def __init__(self, settings: PlannerSettings, safety: Safety, model: VehicleModel, commitment: Commitment) -> None:
        """Begin with the `commitment` of the replanner's `begin`; `safety` defines standstill."""
        self._limit = math.inf if settings.watchdog is None else settings.watchdog
        self._silence = settings.cycle + self._limit
        self._safety, self._model = safety, model
        self.commitment, self._arrived, self._stopped = commitment, math.inf, -math.inf
        self.stops = 0
        self.is_stopping = False

    def receive(self, commitment: Commitment, estimate: Estimate) -> None:
        """Take a message; a car that the watchdog stops refuses it if it is older than the stop, or poses are."""
        if self.is_stopping and (commitment.decided < self._stopped or self._is_blind(estimate)):
            return
        self.mirror(commitment, estimate.time)

    def mirror(self, commitment: Commitment, time: float) -> None:
        """Have on board what another computer of the car has on board since `time` (s)."""
        self.commitment, self._arrived, self.is_stopping = commitment, time, False

    def reference(self, estimate: Estimate) -> Reference:
        """Reference to track at the time of the estimate."""
        reference = self.commitment.reference_at(estimate.time)
        if self._must_stop(estimate, reference):
            self.stops += 1
            self.is_stopping, self._stopped = True, estimate.time
            reference = self._stop_from(estimate, reference)
            self.commitment = Commitment(reference, decided=estimate.time)
        return reference

    def stop(self, estimate: Estimate) -> None:
        """Stop the car for a reason of its own, as the watchdog does; later messages let it drive on."""
        reference = self.commitment.reference_at(estimate.time)
        self.is_stopping, self._stopped = True, estimate.time
        if not self._stops_already(estimate, reference):
            self.stops += 1
            self.commitment = Commitment(self._stop_from(estimate, reference), decided=estimate.time)

    def _stops_already(self, estimate: Estimate, reference: Reference) -> bool:
        """Whether the car brakes on a reference at the time of the estimate, or stands."""
        return reference.kind is ReferenceKind.CONTINGENCY and (
            reference.stop is None or estimate.time >= reference.stop.begin - 1e-9
        )

    def _must_stop(self, estimate: Estimate, reference: Reference) -> bool:
        if self._stops_already(estimate, reference):
            return False
        silent = reference.kind is ReferenceKind.PLAN and estimate.time - self._arrived > self._silence + 1e-9
        return silent or self._is_blind(estimate)

    def _is_blind(self, estimate: Estimate) -> bool:
        """Whether the newest observation is too old; at time 0 the car knows where it stands."""
        return min(estimate.age, estimate.time) > self._limit + 1e-9

    def _stop_from(self, estimate: Estimate, reference: Reference) -> Reference:
        """Braking from the estimated state with the wheels as the reference has them now.

        On a robot each moment of a cycle is examined for that, as for a loss of commands, but not for other manoeuvres.
        """
        held, vehicle, safety = reference.control_at(estimate.time), self._model.present_vehicle, self._safety
        rest, states = list(vehicle.rest_indices), [np.asarray(estimate.state, dtype=float)]
        controls = list[Floats]()
        while np.any(np.abs(states[-1][rest]) > safety.rest_speed) and len(states) * safety.step <= safety.horizon:
            controls.append(braking_control(vehicle, states[-1], held))
            states.append(self._model.advance(states[-1], controls[-1], safety.step))
        times: Floats = estimate.time + safety.step * np.arange(len(states), dtype=float)
        straight = manoeuvre_reference(vehicle, 0, times, np.array(states))
        return replace(straight, controls=np.array(controls).reshape(straight.controls.shape))
