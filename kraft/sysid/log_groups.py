"""Logs that fall into two groups: two regressions of a motion on commands, one for each group, leave less than one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from kraft.errors import Code, Diagnostic
from kraft.sysid.log_motion import STEP, LogMotion
from ompl_ext.arrays import Bools, Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


GROUP_LOGS_MIN: Final = 4
"""Least number of logs among which groups are sought."""
GROUP_TIME_MIN: Final = 20.0
"""Least duration of the logs of a group, s: a few seconds may differ by chance."""
GROUP_ROUNDS: Final = 20
"""Most rounds in which logs change from one group to the other, from each beginning."""
OTHERS: Final = 1e-3
"""Weight of the logs of the other group, which decide where those of a group do not."""
RIDGE: Final = 1e-6
"""Share of the information that is added, so that a command that never changes has no effect."""

Samples = Sequence[tuple[Matrix, Floats]]
"""Terms (n, k) of a motion and the motion (n,), for each part of the logs."""


class Response(NamedTuple):
    """A motion and what may explain it."""

    verb: str
    """what the vehicle does: turn, accelerate"""
    candidates: Sequence[Samples]
    """several terms, of which those count with which two groups leave least"""
    least: float
    """share of the motion that two groups explain in addition, at least"""
    ratio: float
    """share of what is left by one group that is left by two, at most"""


def groups_problem(found: Sequence[LogMotion], logs: Sequence[Log], responses: Sequence[Response]) -> Diagnostic | None:
    """The two groups that the logs fall into, by the first response that tells them apart; None if they do not."""
    if len(logs) < GROUP_LOGS_MIN:
        return None
    for response in responses:
        tried = [_normal(found, len(logs), samples) for samples in response.candidates]
        normal = min(tried, key=lambda each: _two_groups(each)[1])
        one = normal.cost(np.ones(len(logs), bool)).sum()
        first, two = _two_groups(normal)
        times = np.bincount([m.log for m in found], [len(m.times) * STEP for m in found], len(logs))
        long = min(times[first].sum(), times[~first].sum()) >= GROUP_TIME_MIN
        fair = long and 2 <= first.sum() <= len(logs) - 2
        if fair and one - two >= response.least * normal.square.sum() and two <= response.ratio * one:
            sides = [
                ", ".join(log.name for log, own in zip(logs, first == k, strict=True) if own) for k in (True, False)
            ]
            problem = (
                f"the logs fall into two groups that {response.verb} differently: one is {sides[0]}; "
                f"the other {sides[1]}"
            )
            expected = "expected logs of one car in one state; identify each group by itself"
            return Diagnostic("logs", problem, expected, code=Code.MISMATCH)
    return None


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of one regression for each log."""

    information: Floats
    """(logs, k, k)"""
    gradient: Matrix
    """(logs, k)"""
    square: Floats
    """(logs,) of the values"""

    def cost(self, chosen: Bools) -> Floats:
        """(logs,) sum of squares that the regression over the chosen logs leaves of each log."""
        weight = np.where(chosen, 1.0, OTHERS)
        whole = np.tensordot(weight, self.information, 1)
        ridge = RIDGE * np.trace(self.information.sum(axis=0)) * np.eye(len(whole))
        b = np.linalg.solve(whole + ridge, weight @ self.gradient)
        cost: Floats = self.square - 2.0 * self.gradient @ b + np.einsum("i,nij,j->n", b, self.information, b)
        return cost


def _normal(found: Sequence[LogMotion], logs: int, samples: Sequence[tuple[Matrix, Floats]]) -> _Normal:
    scale = np.sqrt(np.mean(np.concatenate([x for x, _ in samples]) ** 2, axis=0)) + 1e-12
    k = len(scale)
    normal = _Normal(np.zeros((logs, k, k)), np.zeros((logs, k)), np.zeros(logs))
    for m, (x, y) in zip(found, samples, strict=True):
        normal.information[m.log] += (x / scale).T @ (x / scale)
        normal.gradient[m.log] += (x / scale).T @ y
        normal.square[m.log] += y @ y
    return normal


def _two_groups(normal: _Normal) -> tuple[Bools, float]:
    """Division of the logs into two groups with a regression each that leaves least, and what it leaves."""
    logs = len(normal.square)
    whole = np.maximum(normal.square, 1e-12)
    best: tuple[Bools, float] = (np.ones(logs, bool), np.inf)
    for k in range(logs):  # begin with the logs that are most like one of them
        share = normal.cost(np.arange(logs) == k) / whole
        first = share < np.median(share)
        for _ in range(GROUP_ROUNDS):
            if not 0 < first.sum() < logs:
                break
            own, other = normal.cost(first), normal.cost(~first)
            left = float(np.minimum(own, other).sum())
            if left < best[1]:
                best = (own < other, left)
            if np.array_equal(own < other, first):
                break
            first = own < other
    return best
