"""Measures of what a method promises, against the true motion: clearance, decisions and the estimator's covariance."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from kraft.driving.messages import (
    ContingencyOrigin,
    Cycle,
    PredictedMotion,
    ReferenceKind,
    as_driven,
    begun_cycles,
    cycles_on_board,
)
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Footprint

BIN: Final = 0.1
"""Width of the intervals of time since the commit for which deviations are kept, s."""
REGRESSION: Final = 0.5
"""Cost by which a plan must exceed what was left of the last one to count as a regression, s."""
BAND: Final = (0.2158, 9.3484)
"""2.5 % and 97.5 % quantile of the chi-square distribution with three degrees of freedom: the 95 % band of a pose's
normalised squared error."""


@dataclass(frozen=True)
class Step:
    """Tick of the controller: true state, estimated state and command.

    The estimate is of a time that is `ahead` s later than the tick.  `watchdog` is whether the watchdog stops the car,
    `boxes` are the true poses of the movable boxes (m, rad).
    """

    time: float
    pose: tuple[float, float, float]
    speed: float
    estimate: Floats
    command: Floats
    cycle: int
    watchdog: bool = False
    ahead: float = 0.0
    boxes: tuple[tuple[float, float, float], ...] = ()


Count: TypeAlias = Annotated[int, Field(ge=0)]
"""Number of something in a line of `trials.jsonl`."""
Amount: TypeAlias = Annotated[float, Field(ge=0)]
"""Duration or sum of squares there: unlike a setting, it has no largest value."""


class Record(BaseModel):
    """Part of a line of `trials.jsonl`."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Kept(Record):
    """Ticks of the controller with a clearance delta(v) that the method asked for.

    At `held` of the `ticks` no point of the true car was farther from the committed prediction than delta(v);
    `delta_sum_m` is the sum of delta(v).
    """

    ticks: Count = 0
    held: Count = 0
    delta_sum_m: Amount = 0.0

    @property
    def coverage(self) -> float | None:
        """Share of the ticks at which delta(v) held; None without ticks."""
        return self.held / self.ticks if self.ticks else None

    @property
    def delta_mean(self) -> float | None:
        """Mean delta(v), m; None without ticks."""
        return self.delta_sum_m / self.ticks if self.ticks else None


class Consistency(Record):
    """Normalised squared errors of an estimator's poses: their number and sum, and how many were in the 95 % band."""

    poses: Count = 0
    sum: Amount = 0.0
    in_band: Count = 0

    @property
    def mean(self) -> float | None:
        """Mean; 3 if the stated covariance is right, more if it is too small.  None without poses."""
        return self.sum / self.poses if self.poses else None

    @property
    def share(self) -> float | None:
        """Share in the band; 0.95 if the stated covariance is right.  None without poses."""
        return self.in_band / self.poses if self.poses else None


class Measures(Record):
    """Measures of one trial, or of several together.

    Attributes:
        plans, contingencies: clearance kept while a plan or a contingency was driven.
        deviation_mm: for each interval of 0.1 s since the commit, the largest deviation of a point of the true car from
            the committed prediction, at each tick of the controller.
        emergencies: number of contingencies that nothing verified.
        in_hand: number of contingencies that an earlier cycle verified; the others were verified when committed.
        compared: number of cycles whose plan can be compared with what was left of the last one.
        regressions: number of plans that cost over 0.5 s more than what was left of the last one, by reason.
        messages_lost: number of messages from replanner to car that were lost.
        watchdog_stops: number of times that the car's watchdog stopped it.
        consistency: of the estimator's covariance; None if it states none.
    """

    plans: Kept = Kept()
    contingencies: Kept = Kept()
    deviation_mm: tuple[tuple[Count, ...], ...] = ()
    emergencies: Count = 0
    in_hand: Count = 0
    compared: Count = 0
    regressions: Mapping[str, Count] = {}
    messages_lost: Count = 0
    watchdog_stops: Count = 0
    consistency: Consistency | None = None

    @property
    def clearance(self) -> Kept:
        """Clearance kept by plans and contingencies together."""
        return pooled_clearance((self.plans, self.contingencies))

    def deviation_quantiles(self, shares: Sequence[float]) -> list[list[float]]:
        """For each interval of time with deviations its end (s), then the quantiles of the deviation (m)."""
        return [
            [round(BIN * (k + 1), 6), *(np.quantile(values, shares, method="inverted_cdf") / 1000.0).tolist()]
            for k, values in enumerate(self.deviation_mm)
            if values
        ]


def pooled(measures: Iterable[Measures]) -> Measures:
    """Measures of several trials together."""
    each = list(measures)
    regressions: Counter[str] = Counter()
    for one in each:
        regressions.update(one.regressions)
    bins = max((len(one.deviation_mm) for one in each), default=0)
    consistencies = [one.consistency for one in each if one.consistency is not None]
    return Measures(
        plans=pooled_clearance(one.plans for one in each),
        contingencies=pooled_clearance(one.contingencies for one in each),
        deviation_mm=tuple(
            tuple(value for one in each if k < len(one.deviation_mm) for value in one.deviation_mm[k])
            for k in range(bins)
        ),
        emergencies=sum(one.emergencies for one in each),
        in_hand=sum(one.in_hand for one in each),
        compared=sum(one.compared for one in each),
        regressions=dict(sorted(regressions.items())),
        messages_lost=sum(one.messages_lost for one in each),
        watchdog_stops=sum(one.watchdog_stops for one in each),
        consistency=pooled_consistency(consistencies) if consistencies else None,
    )


def pooled_clearance(kept: Iterable[Kept]) -> Kept:
    """Clearance kept in several trials together."""
    each = list(kept)
    return Kept(
        ticks=sum(k.ticks for k in each), held=sum(k.held for k in each), delta_sum_m=sum(k.delta_sum_m for k in each)
    )


def pooled_consistency(consistencies: Sequence[Consistency]) -> Consistency:
    """Consistency over several trials."""
    return Consistency(
        poses=sum(c.poses for c in consistencies),
        sum=sum(c.sum for c in consistencies),
        in_band=sum(c.in_band for c in consistencies),
    )


def measure(
    cycles: Sequence[Cycle],
    steps: Sequence[Step],
    footprint: Footprint,
    pose: Sequence[int],
    messages_lost: int = 0,
    errors_squared: Sequence[float] = (),
    watchdog_stops: int = 0,
    end: float = math.inf,
) -> Measures:
    """Measures of a trial.

    The motion is compared with the prediction of the reference that the car tracks.  After a lost message that is the
    prediction of the contingency on board; without one on board, the prediction of the lost message.  While the
    watchdog stops the car, nothing is compared.

    Args:
        cycles: its cycles.
        steps: its ticks of the controller, with the true poses.
        footprint: footprint of the planner's vehicle.
        pose: indices of x, y and theta in its state.
        messages_lost: number of lost messages.
        errors_squared: normalised squared error of each pose for which the estimator stated a covariance.
        watchdog_stops: number of times that the car's watchdog stopped it.
        end: time of the end of the trial, s; contingencies of cycles that begin later are not counted.
    """
    plans, contingencies = Kept(), Kept()
    deviations: list[list[int]] = []
    ticks = np.array([step.time for step in steps])
    truth = np.array([step.pose for step in steps]).reshape(-1, 3)
    driven = np.array([not step.watchdog for step in steps], dtype=bool)
    for span in _spans(cycles, ticks):
        predicted, kept_on = span.predicted, np.flatnonzero(driven[span.first : span.last]) + span.first
        times = ticks[kept_on]
        expected = interpolated_rows(times, predicted.times, predicted.states[:, list(pose)])
        deviation = farthest_point(truth[kept_on], expected, footprint)
        _sort_in(deviations, times - span.committed, deviation)
        if predicted.delta is not None:
            delta = np.interp(times, predicted.times, predicted.delta)
            kept = Kept(ticks=len(times), held=int((deviation <= delta).sum()), delta_sum_m=float(delta.sum()))
            if span.kind is ReferenceKind.PLAN:
                plans = pooled_clearance((plans, kept))
            else:
                contingencies = pooled_clearance((contingencies, kept))
    origins = Counter(cycle.contingency_origin for cycle in begun_cycles(cycles, end))
    compared, regressions = _regressions(cycles)
    return Measures(
        plans=plans,
        contingencies=contingencies,
        deviation_mm=tuple(map(tuple, deviations)),
        emergencies=origins[ContingencyOrigin.EMERGENCY],
        in_hand=origins[ContingencyOrigin.IN_HAND],
        compared=compared,
        regressions=dict(sorted(regressions.items())),
        messages_lost=messages_lost,
        watchdog_stops=watchdog_stops,
        consistency=_consistency(errors_squared) if errors_squared else None,
    )


def normalised_squares(errors: Sequence[tuple[Floats, Matrix]]) -> list[float]:
    """Squares of errors (n,), each normalised by its covariance (n, n)."""
    if not errors:
        return []
    each = np.array([error for error, _ in errors])
    solved = np.linalg.solve(np.array([covariance for _, covariance in errors]), each[:, :, None])[:, :, 0]
    return [float(error @ weighted) for error, weighted in zip(each, solved, strict=True)]


def farthest_point(true: Matrix, expected: Matrix, footprint: Footprint) -> Floats:
    """Largest distance (n,) between a point of the footprint at the pose `true` and the same point at `expected`.

    Poses (n, 3) are in m and rad.  The displacement is an affine function of the point, so a corner has the largest.
    """
    far: Floats = np.zeros(len(true))
    x, y, x0, y0 = true[:, 0], true[:, 1], expected[:, 0], expected[:, 1]
    (c, s), (c0, s0) = ((np.cos(poses[:, 2]), np.sin(poses[:, 2])) for poses in (true, expected))
    for along in footprint.ends:
        for left in (-footprint.width / 2, footprint.width / 2):
            dx = (x + c * along - s * left) - (x0 + c0 * along - s0 * left)
            dy = (y + s * along + c * left) - (y0 + s0 * along + c0 * left)
            far = np.maximum(far, np.hypot(dx, dy))
    return far


class _Span(NamedTuple):
    """Ticks `first` to before `last` in which a commitment of the time `committed` (s) was tracked."""

    kind: ReferenceKind
    committed: float
    predicted: PredictedMotion
    first: int
    last: int


def _spans(cycles: Sequence[Cycle], ticks: Floats) -> Iterator[_Span]:
    """Each cycle with the range of the ticks between its start and the end of its prediction or the next cycle.

    If its message was lost, the motion is that of the contingency on board, see `as_driven`.
    """
    pairs = zip(cycles_on_board(cycles), as_driven(cycles), strict=True)
    for k, (cycle, (on_board, driven)) in enumerate(zip(cycles, pairs, strict=True)):
        end = float(cycle.predicted.times[-1])
        if k + 1 < len(cycles):
            end = min(end, cycles[k + 1].time)
        first, last = np.searchsorted(ticks, [cycle.time - SAME_TIME, end - SAME_TIME])
        if last > first:
            yield _Span(driven.kind, on_board.time, driven.predicted, int(first), int(last))


def _sort_in(deviations: list[list[int]], since: Floats, deviation: Floats) -> None:
    """Add deviations (m) to the intervals of the time since the commit (s)."""
    for elapsed, value in zip(since.tolist(), deviation.tolist(), strict=True):
        k = int((elapsed + SAME_TIME) / BIN)
        while len(deviations) <= k:
            deviations.append([])
        deviations[k].append(round(1000 * value))


def _regressions(cycles: Sequence[Cycle]) -> tuple[int, Counter[str]]:
    """Number of cycles whose plan can be compared with the last one's, and the regressions by reason."""
    compared, found = 0, Counter[str]()
    for last, cycle in itertools.pairwise(cycles):
        left = last.cost_to_goal - (cycle.time - last.time)
        if math.isfinite(left) and math.isfinite(cycle.cost_to_goal):
            compared += 1
            if cycle.cost_to_goal > left + REGRESSION:
                found[str(cycle.lost)] += 1
    return compared, found


def _consistency(errors_squared: Sequence[float]) -> Consistency:
    low, high = BAND
    inside = sum(low <= value <= high for value in errors_squared)
    return Consistency(poses=len(errors_squared), sum=float(sum(errors_squared)), in_band=inside)
