"""Windows of logs as the multi-step form takes them: their poses, the controls that act in them, and their parameters.

Poses of all windows are in common arrays; controls act in each step in two parts.  Parameters may vary from drive to
drive and, less, from window to window of a drive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.chains import Chains, Segment, pose_steps, segment_between
from kraft.sysid.initial_values import SmoothedPoses
from kraft.sysid.interface import Settings
from kraft.sysid.smoothing import begins_at_rest, smoothed_each
from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.times import SAME_TIME

if TYPE_CHECKING:
    from kraft.logs.log import Part


Item = TypeVar("Item")

WINDOW_MIN: Final = 0.5
"""Least length of a window, s."""
FOLDS_MIN: Final = 5
"""Least number of folds: fewer logs are cut into blocks of windows."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Poses of windows in common arrays: W windows of at most n poses."""

    segments: tuple[Segment, ...]
    h: Floats
    """(W,) s"""
    poses: Floats
    """(W, n, 3) observed, zeros beyond the last pose of a window"""
    seen: Bools
    """(W, n) whether there is such a pose"""
    since: Matrix
    """(W, n) time since the beginning of the window, s"""
    step: Ints
    """(W, n)"""
    share: Matrix
    """(W, n) of the step"""
    fold: Ints
    """(W,)"""
    known: Floats
    """(W,) time in the window at which the model's error is 0, s: 0 in a fit, in a history its end"""
    first: SmoothedPoses
    """(W, 3) poses and rates at the beginnings, smoothed with those before and after"""
    interval: float
    """between the poses that they were smoothed from, s"""
    halved: bool = False
    """whether every step is integrated in two parts"""

    @property
    def folds(self) -> int:
        """Number of folds."""
        return int(self.fold.max()) + 1

    def some(self, most: int) -> Windows:
        """At most `most` of the windows, evenly spread over the logs, in folds of their own."""
        chosen = np.array(evenly(range(len(self.segments)), most))
        if len(chosen) == len(self.segments):
            return self
        names = ("h", "poses", "seen", "since", "step", "share", "known")
        return replace(
            self,
            segments=tuple(self.segments[k] for k in chosen),
            fold=np.unique(self.fold[chosen], return_inverse=True)[1].astype(np.int64),
            first=SmoothedPoses(self.first.poses[chosen], self.first.rates[chosen]),
            **{name: getattr(self, name)[chosen] for name in names},
        )


def windows_of(segments: Sequence[Segment], parts: Sequence[Part], fold: Ints, known: Floats | None = None) -> Windows:
    """Arrays of some windows; `parts` (W,) are the parts with all poses, `fold` (W,) is the fold of each.

    With `known` (W,) the windows are histories up to that time, whose later poses are not seen.
    """
    first = SmoothedPoses(*smoothed_each(parts, np.array([s.begin for s in segments])))
    apart = [np.median(np.diff(part.pose_times)) for part in parts if len(part.pose_times) > 1]
    interval = float(np.median(apart)) if apart else max(s.h for s in segments)
    most = max(len(s.part.pose_times[s.poses]) for s in segments)
    shape = (len(segments), most)
    poses, seen, since = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool), np.zeros(shape)
    step, share = np.zeros(shape, dtype=np.int64), np.zeros(shape)
    for w, s in enumerate(segments):
        times = s.part.pose_times[s.poses]
        own = slice(0, len(times))
        poses[w, own], since[w, own] = s.part.poses[s.poses], times - s.begin
        seen[w, own] = True if known is None else since[w, own] <= known[w] + SAME_TIME
        step[w, own], share[w, own] = pose_steps(s)
    h = np.array([s.h for s in segments])
    known = np.zeros(len(segments)) if known is None else known
    return Windows(tuple(segments), h, poses, seen, since, step, share, fold, known, first, interval)


def cut(part: Part, log: int, settings: Settings, wanted: float | None) -> list[Segment]:
    """Windows of the horizon, one after the other, or of about the `wanted` length; the whole part if it is shorter."""
    times = part.pose_times
    if part.duration < WINDOW_MIN:
        return []
    count = max(1, round(part.duration / wanted) if wanted else int(part.duration / settings.horizon + 1e-6))
    length = part.duration / count if wanted else min(part.duration, settings.horizon)
    resting = begins_at_rest(part)
    found = []
    for k in range(count):
        first = int(np.searchsorted(times, times[0] + k * length - SAME_TIME))
        last = int(np.searchsorted(times, times[0] + (k + 1) * length + 0.5 * settings.step, side="right"))
        if last - first >= 4 and times[last - 1] - times[first] >= WINDOW_MIN:
            found.append(segment_between(part, log, settings.step, first, last, resting and k == 0))
    return found


def folds_of(segments: Sequence[Segment], logs: int) -> Ints:
    """(windows,) fold of each window: its log, or a block of a log if there are few logs."""
    log = np.array([s.log for s in segments])
    if logs >= FOLDS_MIN:
        return np.unique(log, return_inverse=True)[1].astype(np.int64)
    blocks = math.ceil(FOLDS_MIN / max(logs, 1))
    fold = np.zeros(len(segments), dtype=np.int64)
    for i in np.unique(log):
        own = np.flatnonzero(log == i)
        fold[own] = i * blocks + np.arange(len(own)) * blocks // max(len(own), 1)
    return np.unique(fold, return_inverse=True)[1].astype(np.int64)


@dataclass(frozen=True, eq=False)
class Acting:
    """Controls that act in W windows, in parts of steps one after the other; at most `parts` of them.

    Lanes are the windows in the order of their number of parts, since neighbours are integrated together.
    """

    controls: Floats
    """(parts, W, nu) by lane, zeros beyond the last part of a window"""
    h: Matrix
    """(parts, W) durations by lane, s; 0 beyond the last part"""
    first: Ints
    """(N,) part with which each step of the chains begins"""
    window: Ints
    """(W,) of each lane"""
    lane: Ints
    """(W,) of each window"""


def controls_in_parts(actuators: ActuatorModel, chains: Chains, rho: Floats, *, halved: bool) -> Acting:
    """Controls in the steps of all chains, those in which a command jumps in two parts, or all if `halved`."""
    share, means = actuators.split(rho, halved=halved)
    steps = chains.steps
    window, split = np.repeat(np.arange(len(steps)), steps), share < 1.0
    ends = np.cumsum(1 + split)
    before = np.concatenate([[0], ends])[chains.first_step[:-1]]  # parts of the windows before
    first = ends - 1 - split - before[window]
    parts = np.bincount(window, 1 + split).astype(np.int64)
    order = np.argsort(parts, kind="stable")
    lane = np.argsort(order, kind="stable")
    shape = (int(parts.max()), len(steps))
    controls, h = np.zeros((*shape, means.shape[2])), np.zeros(shape)
    for part, own, length in ((0, slice(None), share), (1, split, 1.0 - share)):
        at = first[own] + part, lane[window[own]]
        controls[at], h[at] = means[own, part], (length * chains.h)[own]
    return Acting(controls, h, first, order, lane)


def places(acting: Acting, chains: Chains, windows: Windows) -> tuple[Ints, Matrix]:
    """Part of a step (W, n) in which each pose was observed, and share (W, n) of that part."""
    lane = acting.lane[:, None]
    begin = acting.first[windows.step + chains.first_step[:-1, None]]
    since = windows.share * windows.h[:, None]
    late = since > acting.h[begin, lane] + 1e-12
    part = begin + late
    since -= np.where(late, acting.h[begin, lane], 0.0)
    return part, np.minimum(since / acting.h[part, lane], 1.0)


def evenly(items: Sequence[Item], most: int) -> list[Item]:
    """At most `most` of the items, evenly spread."""
    if len(items) <= most:
        return list(items)
    return [items[k] for k in np.round(np.linspace(0, len(items) - 1, most)).astype(int).tolist()]


WITHIN_SHARE: Final = 0.05
"""Variation within a drive over the one between drives."""


@dataclass(frozen=True, eq=False)
class Variation:
    """How far nv parameters vary: standard deviations in their units."""

    names: tuple[str, ...]
    between: Floats
    """(nv,) of a drive's mean from rho"""
    within: Floats
    """(nv,) of a window from the mean of its drive"""

    @classmethod
    def of(cls, names: Sequence[str], between: Floats) -> Variation:
        """Variation of which a fixed share is within a drive.

        That share is chosen, not estimated: the windows of a drive whose commands change slowly are explained as well
        by a parameter that varies with them as by the effect of the commands.
        """
        return cls(tuple(names), between, WITHIN_SHARE * between)

    @classmethod
    def independent(cls, stated: Mapping[str, float]) -> Variation:
        """Variation of windows of which no two are of the same drive."""
        return cls(tuple(stated), np.zeros(len(stated)), np.array(list(stated.values())))

    @property
    def total(self) -> dict[str, float]:
        """Standard deviation of a window from rho, by parameter."""
        return dict(zip(self.names, map(float, np.hypot(self.within, self.between)), strict=True))
