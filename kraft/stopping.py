"""Contingencies as references: from a verified manoeuvre to a trajectory that the controller can track."""

from __future__ import annotations

import math

import numpy as np

from kraft.driving import Kind, Reference
from ompl_ext.arrays import Floats
from ompl_ext.plan import Contingency, Plan
from ompl_ext.solver import Dirt
from ompl_ext.vehicle import Vehicle


def plan_reference(plan: Plan, start: float, rest: Floats) -> Reference:
    """A plan that begins at `start` s of the trial; when it is over the control is `rest` (nu,)."""
    edges = np.searchsorted(np.cumsum(plan.durations), plan.times[:-1] + 1e-9, side="right")
    controls = plan.controls[np.minimum(edges, max(0, len(plan.durations) - 1))]
    return Reference(Kind.PLAN, start + plan.times, plan.trajectory, controls, rest)


def stop_reference(vehicle: Vehicle, contingency: Contingency, start: float = 0.0) -> Reference:
    """A contingency whose own times count from `start` s of the trial."""
    number = vehicle.manoeuvres.index(contingency.manoeuvre)
    controls = np.array([stop_control(vehicle, state, number) for state in contingency.states])
    return Reference(Kind.CONTINGENCY, start + contingency.times, contingency.states, controls[:-1], controls[-1])


def stop_control(vehicle: Vehicle, state: Floats, number: int) -> Floats:
    """Control (nu,) of manoeuvre `number` in a state; without a `stop` function it is zero."""
    if vehicle.stop is None:
        return np.zeros(len(vehicle.controls))
    return np.array(vehicle.stop(tuple(map(float, state)), tuple(vehicle.parameter_array), number), dtype=float)


def emergency(dirt: Dirt, state: Floats, start: float) -> Reference:
    """The manoeuvre that keeps the largest clearance where none is safe: what is left when an assumption broke.

    It is not verified, because nothing that could be verified exists; the alternative would be to go on.
    """
    vehicle, step = dirt.vehicle, dirt.safety.step
    best: tuple[float, Reference] | None = None
    for number in range(len(vehicle.manoeuvres)):
        states, controls, slack = [np.asarray(state, dtype=float)], [], math.inf
        for _ in range(round(dirt.safety.horizon / step)):
            controls.append(stop_control(vehicle, states[-1], number))
            trajectory, spare = dirt.edge(states[-1], controls[-1], step)
            states.append(trajectory[-1])
            slack = min(slack, spare)
            if all(abs(states[-1][k]) <= dirt.safety.rest_speed for k in vehicle.rest_indices):
                break
        if best is None or slack > best[0]:
            times: Floats = start + step * np.arange(len(states), dtype=float)
            rest = stop_control(vehicle, states[-1], number)
            best = slack, Reference(Kind.CONTINGENCY, times, np.array(states), np.array(controls), rest)
    assert best is not None, "a vehicle has a manoeuvre"
    return best[1]
