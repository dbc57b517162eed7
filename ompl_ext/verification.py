"""Verification of a finished plan with exact distances, independent of the clearance field of the search."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.exact import SPREAD
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.plan import Plan
from ompl_ext.poses import poses_of
from ompl_ext.retainment import are_beyond
from ompl_ext.solver import DirtSolver
from ompl_ext.times import SAME_TIME

TOLERANCE = 1e-6  # tolerance of FCL's distances (m)
FINE = 16  # subdivisions of a step between samples
PARTS = np.linspace(0.0, 1.0, FINE + 1)  # of the motion from one sample to the next


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
    CONTROL = "control"
    """controls within their bounds"""
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
    """Check a plan with FCL: no collision at any time, delta(v) kept within the cycle and by the contingency.

    Its controls have to be within their bounds, too.  A broad phase, which does not use the clearance field, decides
    where FCL need not be asked; verdict and clearances are those of FCL at every sample.
    """
    problems, clearances = _examined(dirt, plan)
    least = [-math.inf if each is None else each.least()[0] for each in clearances]
    return Verification(least[0], least[1] if len(least) > 1 else None, tuple(problems))


def violations(dirt: DirtSolver, plan: Plan) -> tuple[Violation, ...]:
    """Violated requirements of a plan as `verify` finds them, without the clearances of a plan that is far from all."""
    return tuple(_examined(dirt, plan)[0])


def _examined(dirt: DirtSolver, plan: Plan) -> tuple[list[Violation], list[_Clearance | None]]:
    """Violations, and the clearance along the plan and, if there is one, along its contingency; None if not finite."""
    if not np.isfinite(plan.trajectory).all():
        return [_not_finite("plan")], [None]
    problems: list[Violation] = []
    poses = poses_of(plan.trajectory, dirt.vehicle)
    clearance = _Clearance(dirt, poses)
    problems += _clearance_violations(dirt, "plan", plan.times, plan.trajectory, clearance, _within_cycle(dirt, plan))
    problems += _collisions_at_samples("plan", plan.times, clearance)
    problems += _collisions_between_samples(dirt, plan, clearance)
    problems += _control_violations(dirt, plan)
    if np.any(np.abs(plan.states[-1] - plan.trajectory[-1]) > 1e-6):
        text = "plan: the trajectory does not end in the last state"
        problems.append(Violation(Requirement.CONSISTENCY, text))
    if not dirt.safety.enabled:
        return problems, [clearance]
    if plan.contingency is None:
        return [*problems, Violation(Requirement.CONTINGENCY, "contingency: missing")], [clearance]
    stop = plan.contingency
    if not np.isfinite(stop.states).all():
        return [*problems, _not_finite("contingency")], [clearance, None]
    poses = poses_of(stop.states, dirt.vehicle)
    stopping = _Clearance(dirt, poses)
    every = np.ones(len(stop.times), bool)
    times = stop.times - stop.times[0] + dirt.safety.cycle  # as the planner takes it to begin
    problems += _clearance_violations(dirt, "contingency", times, stop.states, stopping, every)
    problems += _collisions_at_samples("contingency", stop.times, stopping)
    samples: Floats = np.arange(len(stop.times), dtype=float)
    between = interpolated_rows(samples[:-1, None] + PARTS, samples, poses)
    problems += _collisions_between(dirt, "contingency", stop.times, between, stopping)
    if not dirt.safety.is_resting(dirt.vehicle, stop.states[-1]):
        problems.append(Violation(Requirement.STANDSTILL, "contingency: does not end at standstill"))
    return problems, [clearance, stopping]


def _control_violations(dirt: DirtSolver, plan: Plan) -> list[Violation]:
    """Violation of the first edge with a control beyond its bounds, if there is one."""
    edges = np.flatnonzero(are_beyond(plan.controls, dirt.vehicle.control_bounds))
    if not len(edges):
        return []
    held = ", ".join(
        f"{name} {value:g}" for name, value in zip(dirt.vehicle.controls, plan.controls[edges[0]], strict=True)
    )
    text = f"plan: {held} is beyond the bounds at t = {plan.durations[: edges[0]].sum():.3f} s"
    return [Violation(Requirement.CONTROL, text)]


def _not_finite(what: str) -> Violation:
    return Violation(Requirement.CONSISTENCY, f"{what}: a state is not finite")


class _Clearance:
    """Clearance at poses (n, 3): a lower bound (n,) of each, which becomes exact where FCL is asked."""

    def __init__(self, dirt: DirtSolver, poses: Matrix) -> None:
        self._exact, self._poses = dirt.exact, poses
        self.values = dirt.exact.lower_bounds(poses)
        self._known = np.zeros(len(poses), bool)

    def ask(self, which: Ints) -> Floats:
        """Exact clearances at the poses with these numbers, m."""
        for k in which[~self._known[which]]:
            self.values[k], self._known[k] = self._exact.distance(*self._poses[k]), True
        return self.values[which]

    def least(self) -> tuple[float, int]:
        """Smallest clearance, m, and the number of the first pose with it."""
        least = math.inf
        for k in np.argsort(self.values, kind="stable"):
            if self.values[k] >= least + SPREAD:
                break
            least = min(least, float(self.ask(np.array([k]))[0]))
        return least, int(np.argmin(np.where(self._known, self.values, math.inf)))


def _within_cycle(dirt: DirtSolver, plan: Plan) -> Bools:
    return plan.times <= dirt.safety.cycle + SAME_TIME


def _clearance_violations(
    dirt: DirtSolver, what: str, times: Floats, states: Matrix, clearance: _Clearance, required: Bools
) -> list[Violation]:
    """Violation at the sample that violates delta(v) most, if any does."""
    speed = np.abs(states[:, dirt.vehicle.rest_indices[0]]) if dirt.vehicle.rest else np.zeros(len(states))
    before, after = times - SAME_TIME, times + SAME_TIME  # another clearance may begin at a sample
    delta = np.minimum(dirt.safety.clearance(speed, before), dirt.safety.clearance(speed, after))
    asked = np.flatnonzero(required & (clearance.values < delta + SPREAD))
    if not len(asked):
        return []
    slack = clearance.ask(asked) - delta[asked]
    k = int(asked[np.argmin(slack)])
    if slack.min() >= -TOLERANCE:
        return []
    text = (
        f"{what}: {clearance.values[k]:.4f} m from an obstacle at t = {times[k]:.3f} s, delta requires {delta[k]:.4f} m"
    )
    return [Violation(Requirement.CLEARANCE, text)]


def _collisions_at_samples(what: str, times: Floats, clearance: _Clearance) -> list[Violation]:
    """Collision at the sample that is nearest to an obstacle, if it is one."""
    if np.all(clearance.values > SPREAD):  # nothing touches then
        return []
    least, at = clearance.least()
    return [] if least > 0.0 else [Violation(Requirement.COLLISION, f"{what}: collides at t = {times[at]:.3f} s")]


def _collisions_between_samples(dirt: DirtSolver, plan: Plan, clearance: _Clearance) -> list[Violation]:
    """Collisions of a plan between the samples of its trajectory."""
    ends = np.cumsum(plan.durations)
    edge = np.minimum(np.searchsorted(ends, plan.times[:-1] + SAME_TIME, side="right"), len(ends) - 1)
    if not len(ends):  # the start is in the goal
        return []
    fine = dirt.fine(plan.trajectory[:-1], plan.controls[edge], np.diff(plan.times), FINE)
    poses = poses_of(fine.reshape(-1, fine.shape[2]), dirt.vehicle).reshape(*fine.shape[:2], 3)
    return _collisions_between(dirt, "plan", plan.times, poses, clearance)


def _collisions_between(
    dirt: DirtSolver, what: str, times: Floats, poses: Floats, clearance: _Clearance
) -> list[Violation]:
    """Collisions between samples at `times` (n,), given poses (n - 1, k, 3) from each to the next.

    A motion by m between clearances a and b is free if a + b > m; else its poses are looked at.
    """
    travelled = _motion(poses[:, :-1], poses[:, 1:], dirt.vehicle.footprint.reach).sum(axis=1)
    problems = []
    for k in np.flatnonzero(clearance.values[:-1] + clearance.values[1:] <= travelled + SPREAD):
        if clearance.ask(np.array([k, k + 1])).sum() > travelled[k]:
            continue
        if not dirt.exact.least_distance(poses[k, 1:-1]) > 0.0:
            text = f"{what}: collides between t = {times[k]:.3f} and {times[k + 1]:.3f} s"
            problems.append(Violation(Requirement.COLLISION, text))
    return problems


def _motion(before: Floats, after: Floats, reach: float) -> Floats:
    """Upper bound of how far any point of the body moves between poses (..., 3), m."""
    shift = np.hypot(after[..., 0] - before[..., 0], after[..., 1] - before[..., 1])
    bound: Floats = shift + np.abs(after[..., 2] - before[..., 2]) * reach
    return bound
