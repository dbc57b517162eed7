"""References from plans and contingency manoeuvres, and the prediction of the closed loop that tracks them."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from kraft.driving.control import Controller
from kraft.driving.messages import Commitment, Estimate, PredictedMotion, Reference, ReferenceKind, Stop
from kraft.driving.vehicle_model import stop_control
from kraft.planning.workspace import poses_of
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Contingency, Plan
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
            if all(abs(states[-1][k]) <= safety.rest_speed for k in vehicle.rest_indices):
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
        controller = copy.deepcopy(self.controller)
        ticks = max(0, math.ceil((end - begin) / self.period - 1e-9))
        times = np.minimum(begin + self.period * np.arange(ticks + 1), end)
        states, slack = [np.asarray(state, dtype=float)], math.inf
        for now, after in itertools.pairwise(times):
            estimate = Estimate(float(now), states[-1], 0.0)
            control = controller.command(estimate, commitment.reference_at(estimate.time))
            trajectory, step_slack = self.dirt.edge(states[-1], control, float(after - now), float(now - begin))
            states.append(trajectory[-1])
            slack = min(slack, step_slack)
        return PredictedMotion(times, np.array(states), slack)

    def until_rest(self, state: Floats, begin: float, contingency: Reference) -> PredictedMotion:
        """Track a contingency from `state` at `begin` s until standstill, with SAFETY's clearance all the way.

        A vehicle that still moves when SAFETY's horizon is over after the end of the contingency has negative slack.
        """
        controller, safety = copy.deepcopy(self.controller), self.dirt.safety
        times, states = [begin], [np.asarray(state, dtype=float)]
        worst = self.dirt.edge(states[0], np.zeros(len(self.dirt.vehicle.controls)), 0.0, 0.0)[1]
        latest = max(begin, contingency.end) + safety.horizon
        while times[-1] < contingency.end - 1e-9 or not is_resting(self.dirt, states[-1]):
            if times[-1] > latest:
                worst = -1.0
                break
            control = controller.command(Estimate(times[-1], states[-1], 0.0), contingency)
            trajectory, step_slack = self.dirt.edge(states[-1], control, self.period, 0.0)
            times.append(begin + self.period * len(states))
            states.append(trajectory[-1])
            worst = min(worst, step_slack)
        least = least_slack(self.dirt, np.array(states))
        return PredictedMotion(np.array(times), np.array(states), min(worst, least) if worst < 0.0 else max(least, 0.0))


def is_resting(dirt: DirtSolver, state: Floats) -> bool:
    """Whether a state (nx,) is at standstill."""
    return all(abs(state[k]) <= dirt.safety.rest_speed for k in dirt.vehicle.rest_indices)
