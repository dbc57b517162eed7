"""Candidates for a contingency: every manoeuvre that stops the vehicle, also after a part of a plan.

Each has its motion in the model, which tells quickly how much clearance it may keep; its reference is made only if it
is tracked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from kraft.driving.messages import ContingencyOrigin, Reference, ReferenceKind
from kraft.driving.references import manoeuvre_reference
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.interpolation import interpolated_rows
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


class Begin(NamedTuple):
    """Where contingencies begin: in `state` (nx,) at `time` s; the clearance grows from `cycle_start` s on."""

    state: Floats
    time: float
    cycle_start: float


class ModelMotion(NamedTuple):
    """States (n, nx) in the model at `times` (n,) s."""

    times: Floats
    states: Matrix


@dataclass(frozen=True)
class ContingencyCandidate:
    """Contingency before it is tracked: motion in the model, end (s), origin, reference."""

    motion: ModelMotion
    end: float
    origin: ContingencyOrigin
    reference: Callable[[], Reference]


class ContingencyCandidates:
    """Makes the candidates; `dirt` has the manoeuvres, `model` the vehicle."""

    def __init__(self, dirt: DirtSolver, model: VehicleModel) -> None:
        self._dirt, self._model = dirt, model

    def immediate(self, begin: Begin, in_hand: Reference | None) -> Iterator[ContingencyCandidate]:
        """All manoeuvres, and the contingency in hand."""
        state, time, _ = begin
        for number, states in enumerate(self._dirt.manoeuvres(state)):
            build, times = partial(self._manoeuvre, number, time, states), self._times(time, states)
            yield ContingencyCandidate(ModelMotion(times, states), float(times[-1]), ContingencyOrigin.SAFE, build)
        if in_hand is not None:
            left = in_hand.times >= min(time, in_hand.end)
            motion = ModelMotion(np.maximum(in_hand.times[left], time), in_hand.states[left])
            yield ContingencyCandidate(motion, in_hand.end, ContingencyOrigin.IN_HAND, lambda: in_hand)

    def along(self, begin: Begin, plans: Sequence[Reference]) -> Iterator[ContingencyCandidate]:
        """Contingencies that follow a plan first; they do not move a vehicle that stands."""
        state, time, _ = begin
        if self._dirt.safety.is_resting(self._dirt.vehicle, state):
            return
        for plan in plans:
            for leaves in (time + duration for duration in FOLLOWED if time + duration < plan.end):
                during, followed = _part(plan, time, leaves)
                for number, states in enumerate(self._dirt.manoeuvres(followed[-1])):
                    times = self._times(leaves, states)
                    motion = ModelMotion(np.concatenate([during, times]), np.vstack([followed, states]))
                    build = partial(self._after, plan, time, number, leaves, states)
                    yield ContingencyCandidate(motion, float(times[-1]), ContingencyOrigin.PLAN_THEN_STOP, build)
            creeping = self.creeping(state, time, plan)
            if creeping is not None:
                yield creeping

    def creeping(self, state: Floats, time: float, plan: Reference) -> ContingencyCandidate | None:
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
        motion = ModelMotion(np.concatenate([times[:-1], stopping]), np.vstack([states[:-1], stop]))
        planned_at = np.interp(arc_lengths[:-1], places, planned)
        build = partial(self._creeping_reference, plan, ModelMotion(times, states), planned_at, stop)
        return ContingencyCandidate(motion, float(stopping[-1]), ContingencyOrigin.CREEPING, build)

    def _creeping_reference(
        self, plan: Reference, creeping: ModelMotion, planned_at: Floats, stop: Matrix
    ) -> Reference:
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

    def _manoeuvre(self, number: int, time: float, states: Matrix) -> Reference:
        return manoeuvre_reference(self._dirt.vehicle, number, self._times(time, states), states)

    def _after(self, plan: Reference, begin: float, number: int, leaves: float, states: Matrix) -> Reference:
        return _joined(plan, begin, self._manoeuvre(number, leaves, states))

    def _times(self, begin: float, states: Matrix) -> Floats:
        """Times (n,) of the states (n, nx) of a manoeuvre that begins at `begin` s."""
        times: Floats = begin + self._dirt.safety.step * np.arange(len(states), dtype=float)
        return times


def _part(plan: Reference, begin: float, end: float) -> ModelMotion:
    """Times and states of a reference between two times (s)."""
    inner = _between(plan, begin, end)
    times: Floats = np.concatenate([[begin], plan.times[inner], [end]])
    return ModelMotion(times, np.vstack([plan.state_at(begin), plan.states[inner], plan.state_at(end)]))


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
