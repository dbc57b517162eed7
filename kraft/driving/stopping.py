"""Contingencies as references: from a verified manoeuvre to a trajectory that the controller can track."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass

import numpy as np

from kraft.driving.control import Controller
from kraft.driving.messages import Estimate, PredictedMotion, Reference, ReferenceKind
from kraft.planning.workspace import pose_of
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Contingency, Plan
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle


def plan_reference(plan: Plan, start: float, rest: Floats) -> Reference:
    """A plan that begins at `start` s of the trial; when it is over the control is `rest` (nu,)."""
    edges = np.searchsorted(np.cumsum(plan.durations), plan.times[:-1] + 1e-9, side="right")
    controls = plan.controls[np.minimum(edges, max(0, len(plan.durations) - 1))]
    return Reference(ReferenceKind.PLAN, start + plan.times, plan.trajectory, controls, rest)


def contingency_reference(vehicle: Vehicle, contingency: Contingency) -> Reference:
    """A contingency whose times are those of the trial (s); when it is over the control is zero."""
    number = vehicle.manoeuvres.index(contingency.manoeuvre)
    controls = np.array([stop_control(vehicle, state, number) for state in contingency.states[:-1]])
    controls = controls.reshape(-1, len(vehicle.controls))
    rest = np.zeros(len(vehicle.controls))  # brakes that went on would push a car that stands
    return Reference(ReferenceKind.CONTINGENCY, contingency.times, contingency.states, controls, rest)


def stop_control(vehicle: Vehicle, state: Floats, number: int) -> Floats:
    """Control (nu,) of manoeuvre `number` in a state; without a `stop` function it is zero."""
    if vehicle.stop is None:
        return np.zeros(len(vehicle.controls))
    return np.array(vehicle.stop(tuple(map(float, state)), tuple(vehicle.parameter_array), number), dtype=float)


def emergency_reference(dirt: DirtSolver, state: Floats, start: float) -> Reference:
    """The manoeuvre that keeps the largest distance, or that hits slowest: what is left when an assumption broke.

    It is not verified, because nothing that could be verified exists; the alternative would be to go on.
    """
    manoeuvres = [_PredictedManoeuvre.of(dirt, state, number) for number in range(len(dirt.vehicle.manoeuvres))]
    return max(manoeuvres, key=lambda each: (each.distance, -each.impact_speed)).reference(start, dirt.safety.step)


@dataclass(frozen=True)
class _PredictedManoeuvre:
    """States (m, nx) until standstill and controls (m - 1, nu) between them.

    `distance` is the smallest to an obstacle (m), and `impact_speed` that at the first contact (m/s; 0 without one).
    """

    states: Matrix
    controls: Matrix
    distance: float
    impact_speed: float

    @classmethod
    def of(cls, dirt: DirtSolver, state: Floats, number: int) -> _PredictedManoeuvre:
        """Manoeuvre `number` from a state (nx,), as the model predicts it and FCL measures it."""
        vehicle, safety = dirt.vehicle, dirt.safety
        states, controls, distance, impact_speed = [np.asarray(state, dtype=float)], [], math.inf, 0.0
        for _ in range(round(safety.horizon / safety.step)):
            controls.append(stop_control(vehicle, states[-1], number))
            samples, _slack = dirt.edge(states[-1], controls[-1], safety.step)
            poses = np.array([pose_of(sample, vehicle) for sample in samples])
            nearest = float(dirt.exact.distances(poses).min())
            if distance > 0.0 >= nearest:
                impact_speed = abs(float(states[-1][vehicle.rest_indices[0]]))
            distance = min(distance, nearest)
            states.append(samples[-1])
            if all(abs(states[-1][k]) <= safety.rest_speed for k in vehicle.rest_indices):
                break
        return cls(np.array(states), np.array(controls), distance, impact_speed)

    def reference(self, start: float, step: float) -> Reference:
        """To be tracked from `start` s on, with a state every `step` s."""
        times: Floats = start + step * np.arange(len(self.states), dtype=float)
        return Reference(ReferenceKind.CONTINGENCY, times, self.states, self.controls, np.zeros(self.controls.shape[1]))


@dataclass(frozen=True)
class ClosedLoopPredictor:
    """Rolls the closed loop out: `dirt` has the model and the obstacles, `period` is that of the controller (s)."""

    dirt: DirtSolver
    controller: Controller
    period: float

    def __call__(self, state: Floats, begin: float, end: float, reference: Reference) -> PredictedMotion:
        """Track `reference` from `state` at `begin` s until `end` s; SAFETY's cycle begins at `begin`.

        The controller itself is left as it is.
        """
        controller = copy.deepcopy(self.controller)
        ticks = max(0, math.ceil((end - begin) / self.period - 1e-9))
        times = np.minimum(begin + self.period * np.arange(ticks + 1), end)
        states, slack = [np.asarray(state, dtype=float)], math.inf
        for now, after in itertools.pairwise(times):
            control = controller.command(Estimate(float(now), states[-1], 0.0), reference)
            trajectory, step_slack = self.dirt.edge(states[-1], control, float(after - now), float(now - begin))
            states.append(trajectory[-1])
            slack = min(slack, step_slack)
        return PredictedMotion(times, np.array(states), slack)
