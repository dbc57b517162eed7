"""Exact verification of a finished plan at every time, independent of the clearance field of the search."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

TOLERANCE = 1e-6  # tolerance of FCL's distances (m)
FINE = 16  # subdivisions of a step between samples


class Requirement(StrEnum):
    """Requirement that a plan can violate."""

    COLLISION = "collision"
    """no collision at any time"""
    CLEARANCE = "clearance"
    """clearance delta(v) within the cycle and along the contingency"""
    CONTINGENCY = "contingency"
    """a contingency, if SAFETY is enabled"""
    STANDSTILL = "standstill"
    """the contingency ends at standstill"""
    CONSISTENCY = "consistency"
    """the trajectory ends in the last state"""


@dataclass(frozen=True)
class Violation:
    """Violated requirement, and a sentence for people with the time and the distance."""

    requirement: Requirement
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Verification:
    """Smallest exact clearance (m) along the plan and along its contingency, and every violated requirement.

    Clearances are infinite without obstacles; `contingency_clearance` is None without a contingency.
    """

    min_clearance: float
    contingency_clearance: float | None
    problems: tuple[Violation, ...]


def verify(dirt: DirtSolver, plan: Plan) -> Verification:
    """Check a plan with FCL: no collision at any time, delta(v) kept within the cycle and by the contingency."""
    problems: list[Violation] = []
    clearance = dirt.exact.distances(_poses(dirt, plan.trajectory))
    problems += _clearance_violations(dirt, "plan", plan.times, plan.trajectory, clearance, _within_cycle(dirt, plan))
    if not np.all(clearance > 0.0):
        text = f"plan: collides at t = {plan.times[np.argmin(clearance)]:.3f} s"
        problems.append(Violation(Requirement.COLLISION, text))
    problems += _collisions_between_samples(dirt, plan, clearance)
    if np.any(np.abs(plan.states[-1] - plan.trajectory[-1]) > 1e-6):
        text = "plan: the trajectory does not end in the last state"
        problems.append(Violation(Requirement.CONSISTENCY, text))
    if not dirt.safety.enabled:
        return Verification(float(clearance.min()), None, tuple(problems))
    if plan.contingency is None:
        missing = Violation(Requirement.CONTINGENCY, "contingency: missing")
        return Verification(float(clearance.min()), None, (*problems, missing))
    stop = plan.contingency
    distances = dirt.exact.distances(_poses(dirt, stop.states))
    problems += _clearance_violations(
        dirt, "contingency", stop.times, stop.states, distances, np.ones(len(distances), bool)
    )
    final_speeds = np.abs(stop.states[-1][list(dirt.vehicle.rest_indices)])
    if np.any(final_speeds > dirt.safety.rest_speed):
        problems.append(Violation(Requirement.STANDSTILL, "contingency: does not end at standstill"))
    return Verification(float(clearance.min()), float(distances.min()), tuple(problems))


def _poses(dirt: DirtSolver, states: Matrix) -> Matrix:
    """Columns x, y, theta of states (n, nx)."""
    x, y, theta = (dirt.vehicle.index(name) for name in ("x", "y", "theta"))
    heading = states[:, theta] if theta >= 0 else np.zeros(len(states))
    return np.column_stack([states[:, x], states[:, y], heading])


def _within_cycle(dirt: DirtSolver, plan: Plan) -> Bools:
    return plan.times <= dirt.safety.cycle + 1e-9


def _clearance_violations(
    dirt: DirtSolver, what: str, times: Floats, states: Matrix, clearance: Floats, required: Bools
) -> list[Violation]:
    """Violation at the sample that violates delta(v) most, if any does."""
    speed = np.abs(states[:, dirt.vehicle.rest_indices[0]]) if dirt.vehicle.rest else np.zeros(len(states))
    delta = dirt.safety.clearance(speed, times)
    worst = np.where(required, clearance - delta, math.inf)
    k = int(np.argmin(worst))
    if worst[k] >= -TOLERANCE:
        return []
    text = f"{what}: {clearance[k]:.4f} m from an obstacle at t = {times[k]:.3f} s, delta requires {delta[k]:.4f} m"
    return [Violation(Requirement.CLEARANCE, text)]


def _collisions_between_samples(dirt: DirtSolver, plan: Plan, clearance: Floats) -> list[Violation]:
    """Collisions between samples.  A motion by m between clearances a and b is free if a + b > m, else sampled."""
    problems = []
    ends = np.cumsum(plan.durations)
    for k in range(len(plan.times) - 1):
        edge = min(int(np.searchsorted(ends, plan.times[k] + 1e-9, side="right")), len(ends) - 1)
        fine = dirt.fine(plan.trajectory[k], plan.controls[edge], float(plan.times[k + 1] - plan.times[k]), FINE)
        poses = _poses(dirt, fine)
        travelled = _motion(poses[:-1], poses[1:], dirt.vehicle.footprint.reach).sum()
        if clearance[k] + clearance[k + 1] > travelled:
            continue
        if not dirt.exact.distances(poses[1:-1]).min() > 0.0:
            text = f"plan: collides between t = {plan.times[k]:.3f} and {plan.times[k + 1]:.3f} s"
            problems.append(Violation(Requirement.COLLISION, text))
    return problems


def _motion(before: Matrix, after: Matrix, reach: float) -> Floats:
    """Upper bound of how far any point of the body moves between poses (m)."""
    shift = np.hypot(after[:, 0] - before[:, 0], after[:, 1] - before[:, 1])
    bound: Floats = shift + np.abs(after[:, 2] - before[:, 2]) * reach
    return bound
