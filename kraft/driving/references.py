"""References for the controller: of plans, manoeuvres and standing, with the control that holds a vehicle then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kraft.driving.messages import Reference, ReferenceKind, Stop
from kraft.driving.vehicle_model import stop_control, stop_controls
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Contingency, Plan
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle


def plan_reference(vehicle: Vehicle, plan: Plan, start: float, cycle: float = 0.0) -> Reference:
    """Reference of a plan that starts at `start` s of the trial; after its end the vehicle is held.

    A plan that ends within its `cycle` (s), in the goal, is followed by its contingency: the vehicle may be fast there.
    """
    edges = np.searchsorted(np.cumsum(plan.durations), plan.times[:-1] + SAME_TIME, side="right")
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
    controls = stop_controls(vehicle, states[:-1], number)
    rest = holding_control(vehicle, states[-1])
    return Reference(ReferenceKind.CONTINGENCY, times, states, controls, rest, Stop(number, float(times[0])))


def standing_reference(vehicle: Vehicle, state: Floats, time: float) -> Reference:
    """Reference that holds a vehicle in a state (nx,) from `time` s on."""
    return manoeuvre_reference(vehicle, 0, np.array([time]), state[np.newaxis])


def holding_control(vehicle: Vehicle, state: Floats) -> Floats:
    """Control (nu,) that holds a vehicle that stands: on level ground zero, against a force the throttle against it.

    It is the first manoeuvre's at a speed of 0: brakes that stay on would push a standing car backwards.
    """
    return stop_control(vehicle, at_rest(vehicle, state), 0) + 0.0  # without negative zeros


def at_rest(vehicle: Vehicle, state: Floats) -> Floats:
    """State (nx,) of a vehicle at rest where it is in `state`."""
    resting = np.array(state, dtype=float)
    resting[list(vehicle.rest_indices)] = 0.0
    return resting
