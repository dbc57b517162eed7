"""Why a trial failed, from what was recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Final, Self

import numpy as np

from kraft.driving.messages import ContingencyOrigin, Cycle, ReferenceKind, as_driven
from kraft.scenario import Goal
from kraft.text import counted, finite
from kraft.trial.measures import Record, Step, farthest_point
from kraft.trial.planning_vehicle import UNCOVERED
from ompl_ext.arrays import Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Footprint

WINDOW: Final = 10.0
"""Time before a timeout over which its cause is looked for, s; a third of the trial if that is longer."""
RECENT: Final = 1.0
"""Time before a collision in which the errors of the estimates count that the controller steered by, s."""
STANDS: Final = 0.25
"""Extent of the motion within that time up to which a car counts as stuck, m."""


class CauseKind(StrEnum):
    """Kind of a cause and its meaning; the first one that applies is the cause."""

    meaning: str

    def __new__(cls, value: str, meaning: str) -> Self:
        """Make a kind that equals the string `value`."""
        kind = str.__new__(cls, value)
        kind._value_, kind.meaning = value, meaning
        return kind

    UNCOVERED = (
        "footprint too small",
        "a part of the robot that the footprint does not cover touched the obstacle: the footprint itself was farther "
        f"from every obstacle than {UNCOVERED:.0%} of its width",
    )
    MESSAGE_LOST = "message lost", "the car did not get the message of the cycle, or its watchdog had stopped it"
    DEADLINE_MISSED = "deadline missed", "planning took longer than the cycle minus its lead, in a trial by the clock"
    CONTINGENCY_TOO_LATE = (
        "contingency too late",
        "nothing verified the contingency when it was committed, or it was predicted to come too close",
    )
    UNSAFE_PLAN = (
        "unsafe plan",
        "the car was as near to the prediction as the bound of its deviation says, and the plan kept less clearance",
    )
    ESTIMATE_WRONG = (
        "estimate wrong",
        "the car was farther from the prediction than the clearance δ(v) or the obstacle allowed, and at least half of "
        "that was an error of the estimated pose that it was planned or steered by",
    )
    DEVIATION = (
        "deviation",
        "the car was farther from the prediction than the clearance δ(v) or the obstacle allowed, or was off a "
        "single plan at the plan's end, though it knew where it was",
    )
    NO_PLAN = "no plan found", "the planner had no plan in most cycles before the timeout"
    PLANS_REFUSED = "plans refused", "the plan was not safe from the latest estimate in most cycles before the timeout"
    STUCK = "stuck", f"the car got no farther than {STANDS:g} m before the timeout, though it had plans"
    TOO_SLOW = "too slow", "the car drove on until the timeout"


class Cause(Record):
    """Cause in a word, and with its numbers."""

    kind: CauseKind
    text: str


def collision_cause(
    cycles: Sequence[Cycle], steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], *,
    distance: float, feedback: bool, realtime: bool,
) -> Cause:  # fmt: skip
    """Cause of a collision right after the last of the `steps`.

    Args:
        cycles: cycles of the trial, at least one.
        steps: its ticks of the controller, at least one.
        footprint: footprint of the planner's vehicle.
        pose: indices of x, y and theta in its state.
        distance: true distance of this footprint to the nearest obstacle at the collision, m.
        feedback: whether the controller uses estimates, instead of sending the planned controls as they are.
        realtime: whether planning was limited by the clock.
    """
    if distance > UNCOVERED * footprint.width:
        text = "a part of the robot that its footprint does not cover touched the obstacle; the footprint was"
        return Cause(kind=CauseKind.UNCOVERED, text=f"{text} {distance:.3f} m from every obstacle")
    last = steps[-1]
    k = max((k for k, cycle in enumerate(cycles) if cycle.time <= last.time + SAME_TIME), default=0)
    sent, cycle = cycles[k], as_driven(cycles)[k]
    if last.watchdog:
        return Cause(kind=CauseKind.MESSAGE_LOST, text="the watchdog had stopped the car")
    if not sent.delivered:
        return Cause(kind=CauseKind.MESSAGE_LOST, text=f"the message of cycle {sent.number} was lost")
    if realtime and sent.missed:
        text = f"planning for cycle {sent.number} took {sent.planning_ms:.0f} ms, which was too long"
        return Cause(kind=CauseKind.DEADLINE_MISSED, text=text)
    contingency = cycle.kind is ReferenceKind.CONTINGENCY
    if contingency and cycle.contingency_origin is ContingencyOrigin.EMERGENCY:
        text = f"cycle {cycle.number} committed a contingency that nothing verified: {cycle.reason}"
        return Cause(kind=CauseKind.CONTINGENCY_TOO_LATE, text=text)
    deviation = _deviation(cycle, last, footprint, pose)
    allowed = _allowed(cycle, last.time)
    if (allowed is not None and deviation <= allowed) or cycle.clearance <= 0.0:
        kind = CauseKind.CONTINGENCY_TOO_LATE if contingency else CauseKind.UNSAFE_PLAN
        near = f"the prediction of cycle {cycle.number} comes within {max(cycle.clearance, 0.0):.3f} m of an obstacle"
        bound = f", which the bound of the deviation, {allowed:.3f} m, allows" if allowed is not None else ""
        return Cause(kind=kind, text=f"{near}; the car was {deviation:.3f} m from where it was predicted to be{bound}")
    error = _error_of_guidance(cycle, steps, footprint, pose, feedback=feedback)
    text = f"the car was {deviation:.3f} m from the prediction"
    if allowed is not None:
        text += f", where {allowed:.3f} m were allowed"
    if error is None:
        return Cause(kind=CauseKind.DEVIATION, text=f"{text}, and its commands depended on no estimated pose")
    kind = CauseKind.ESTIMATE_WRONG if error >= deviation / 2.0 else CauseKind.DEVIATION
    return Cause(kind=kind, text=f"{text}, and its estimated pose was wrong by {error:.3f} m")


def timeout_cause(
    cycles: Sequence[Cycle], steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], goal: Goal, *,
    realtime: bool,
) -> Cause:  # fmt: skip
    """Cause of a timeout right after the last of the `steps`, in which the `goal` was missed; see `collision_cause`."""
    end = steps[-1].time
    since = end - max(WINDOW, end / 3.0)
    late = [cycle for cycle in cycles if cycle.time >= since]
    if not late:  # one shot
        return _unfinished_plan(cycles[-1], steps, footprint, pose)
    of = f"of the last {len(late)} cycles"
    lost = sum(not cycle.delivered for cycle in late)
    if 2 * lost > len(late):
        return Cause(kind=CauseKind.MESSAGE_LOST, text=f"the messages of {lost} {of} were lost")
    watched = [step.watchdog for step in steps if step.time >= since]
    if 2 * sum(watched) > len(watched):
        reason = next((cycle.reason for cycle in reversed(late) if cycle.reason), "poses or messages came too late")
        text = f"the watchdog had stopped the car for {sum(watched) / len(watched):.0%} of the last"
        text += f" {end - max(since, 0.0):.3g} s: {reason}"
        return Cause(kind=CauseKind.MESSAGE_LOST, text=text)
    missed = sum(cycle.missed for cycle in late) if realtime else 0
    if 2 * missed > len(late):
        return Cause(kind=CauseKind.DEADLINE_MISSED, text=f"planning for {missed} {of} took too long")
    stopped = [cycle for cycle in late if cycle.kind is ReferenceKind.CONTINGENCY]
    if 2 * len(stopped) > len(late):
        refused = sum(cycle.proposed for cycle in stopped)
        if 2 * refused > len(stopped):
            text = f"{refused} {of} had a plan that was not safe: {stopped[-1].reason}"
            return Cause(kind=CauseKind.PLANS_REFUSED, text=text)
        text = f"{len(stopped) - refused} {of} had no plan: {stopped[-1].reason}"
        return Cause(kind=CauseKind.NO_PLAN, text=text)
    track = np.array([step.pose[:2] for step in steps if step.time >= since])
    extent = float(np.hypot(*np.ptp(track, axis=0)))
    if extent < STANDS:
        planned = counted(len(late), "cycle")
        text = f"the car moved {extent:.2f} m in the last {end - max(since, 0.0):.3g} s, with plans in {planned}"
        return Cause(kind=CauseKind.STUCK, text=text + _missing_in_goal(goal, steps[-1].pose))
    left = late[-1].cost_to_goal
    text = f"the last plan needed {left:.1f} s more" if np.isfinite(left) else "the car was still driving at the end"
    return Cause(kind=CauseKind.TOO_SLOW, text=text + _missing_in_goal(goal, steps[-1].pose))


def _missing_in_goal(goal: Goal, pose: tuple[float, float, float]) -> str:
    """What a car at a pose (m, m, rad) in the goal's disc lacks of the rest of the goal; empty outside of the disc."""
    if math.dist(pose[:2], goal.center) > goal.radius:
        return ""
    if goal.heading is None or goal.heading_tolerance is None or goal.contains(*pose, {}):
        return ", and was in the goal's disc, but not within goal.limits" if goal.limits else ""
    off = math.degrees(abs(math.remainder(pose[2] - goal.heading, math.tau)))
    allowed = math.degrees(goal.heading_tolerance)
    return f", and was in the goal's disc with a heading {off:.3g} degrees off, of which {allowed:.3g} are allowed"


def estimate_errors(
    steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], since: float = -np.inf
) -> list[float]:
    """Largest distance of a point of the car between its estimated and its true pose, from time `since` on, m.

    An estimate that is ahead of its tick is compared with the true pose at its own time.
    """
    times = np.array([step.time for step in steps])
    true = _unwrapped(np.array([step.pose for step in steps]))
    own = times + np.array([step.ahead for step in steps])
    kept = (own >= since) & (own <= times[-1] + SAME_TIME)
    if not kept.any():
        kept = own == own[0]
    there = interpolated_rows(own[kept], times, true)
    estimated = np.array([step.estimate[list(pose)] for step in steps])[kept]
    errors: list[float] = farthest_point(there, estimated, footprint).tolist()
    return errors


def _error_of_guidance(
    cycle: Cycle, steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], *, feedback: bool
) -> float | None:
    """Error of the estimated poses that the car was planned and steered by until the last step, m; None without any.

    A plan begins at one estimate, however long ago.  A controller steers by all of them, and soon makes up for an error
    that has passed: of these the median since the decision of the cycle counts, of the last `RECENT` s at most.
    """
    decided, end = min(cycle.decided, steps[-1].time), steps[-1].time
    errors = []
    if cycle.number > 0:  # the first plan begins at the start that was given
        errors.append(estimate_errors(steps, footprint, pose, since=decided)[0])
    if feedback:
        recent = estimate_errors(steps, footprint, pose, since=max(decided, end - RECENT))
        errors.append(float(np.median(recent)))
    return max(errors, default=None)


def _unfinished_plan(cycle: Cycle, steps: Sequence[Step], footprint: Footprint, pose: Sequence[int]) -> Cause:
    """Cause of the timeout of a plan that is followed to its end, without others after it."""
    if cycle.kind is ReferenceKind.CONTINGENCY:
        return Cause(kind=CauseKind.NO_PLAN, text=cycle.reason)
    after = next((step for step in steps if step.time >= cycle.reference.end), steps[-1])
    expected = cycle.reference.state_at(after.time)[list(pose)]
    off = float(farthest_point(np.array([after.pose]), expected[None, :], footprint)[0])
    return Cause(kind=CauseKind.DEVIATION, text=f"the car was {off:.3f} m from the plan at its end, {after.time:.1f} s")


def _deviation(cycle: Cycle, step: Step, footprint: Footprint, pose: Sequence[int]) -> float:
    """Largest distance of a point of the car from where a cycle predicts it, m; from its reference after that."""
    predicted = cycle.predicted
    if step.time <= predicted.times[-1] + SAME_TIME:
        expected = interpolated_rows(step.time, predicted.times, predicted.states[:, list(pose)])
    else:
        expected = cycle.reference.state_at(step.time)[list(pose)]
    return float(farthest_point(np.array([step.pose]), expected[None, :], footprint)[0])


def _allowed(cycle: Cycle, time: float) -> float | None:
    """Clearance delta(v) of a cycle at a time, m; without one the distance of its prediction to the obstacles.

    None after the prediction and in a scene without obstacles.
    """
    predicted = cycle.predicted
    if time > predicted.times[-1] + SAME_TIME:
        return None
    if predicted.delta is not None:
        return float(np.interp(time, predicted.times, predicted.delta))
    return finite(cycle.clearance)


def _unwrapped(poses: Matrix) -> Matrix:
    """Poses (n, 3) whose headings have no jumps by a whole turn."""
    poses = poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses
