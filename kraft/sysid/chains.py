"""Segments of logs on equal time steps: chains of states with the poses observed between them, in common arrays.

Chain c has states first[c] ... first[c + 1] - 1, one more than it has steps.  Step i leads from state `state[i]` to the
next one; pose j was observed in step `step[j]`, the share `share[j]` of the step after its beginning (epsilon in the
paper).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.smoothing import begins_at_rest
from ompl_ext.arrays import Floats, Ints, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Part


STEP_EXCESS: Final = 0.05
"""Share of a step by which a segment may be longer than its steps: poses jitter, and would not be at ends of steps."""


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a log, or a piece of it, on its time grid."""

    log: int
    """index of its log"""
    part: Part
    begin: float
    """time of the first state, s"""
    steps: int
    h: float
    """s"""
    poses: slice
    """the observed poses among those of the part"""
    resting: bool
    """whether the part begins at rest, so that no control acted before its first command"""

    @cached_property
    def times(self) -> Floats:
        """(steps + 1,) of the states, s."""
        times: Floats = self.begin + self.h * np.arange(self.steps + 1, dtype=np.float64)
        return times


@dataclass(frozen=True, eq=False)
class Chains:
    """All segments in common arrays: S states, N steps, n poses."""

    segments: tuple[Segment, ...]
    first: Ints
    """(chains + 1,) where each chain's states begin"""
    log: Ints
    """(chains,) log of each chain"""
    logs: int
    state: Ints
    """(N,) state at which each step begins"""
    h: Floats
    """(N,) its duration, s"""
    seen: Ints
    """(N + 1,) where each step's poses begin"""
    step: Ints
    """(n,)"""
    share: Floats
    """(n,) in [0, 1]"""
    poses: Matrix
    """(n, 3) x, y, yaw"""

    @property
    def states(self) -> int:
        """Number of states."""
        return int(self.first[-1])

    @property
    def steps(self) -> Ints:
        """(chains,) number of steps of each chain."""
        return np.diff(self.first) - 1

    @property
    def first_step(self) -> Ints:
        """(chains + 1,) where each chain's steps begin: a chain has one state more than steps."""
        return self.first - np.arange(len(self.first))


def whole_segment(part: Part, log: int, step: float) -> Segment:
    """Segment of a whole part, in steps of at most `step` s."""
    return segment_between(part, log, step, 0, len(part.pose_times), begins_at_rest(part))


def segment_between(part: Part, log: int, step: float, first: int, last: int, resting: bool) -> Segment:
    """Segment of a part from pose `first` to the pose before `last`, in steps of at most about `step` s."""
    begin, end = float(part.pose_times[first]), float(part.pose_times[last - 1])
    steps = max(1, math.ceil((end - begin) / step - STEP_EXCESS))
    return Segment(log, part, begin, steps, max(end - begin, 1e-6) / steps, slice(first, last), resting)


def chains_of(segments: Sequence[Segment], logs: int) -> Chains:
    """Stack segments of `logs` logs."""
    steps = np.array([s.steps for s in segments])
    first = np.concatenate([[0], np.cumsum(steps + 1)])
    offset = np.concatenate([[0], np.cumsum(steps)])
    placed = [pose_steps(s) for s in segments]
    step = np.concatenate([at + offset[c] for c, (at, _) in enumerate(placed)])
    return Chains(
        segments=tuple(segments),
        first=first.astype(np.int64),
        log=np.array([s.log for s in segments], dtype=np.int64),
        logs=logs,
        state=np.concatenate([first[c] + np.arange(s.steps) for c, s in enumerate(segments)]).astype(np.int64),
        h=np.concatenate([np.full(s.steps, s.h) for s in segments]),
        seen=np.searchsorted(step, np.arange(offset[-1] + 1)).astype(np.int64),
        step=step.astype(np.int64),
        share=np.concatenate([share for _, share in placed]),
        poses=np.ascontiguousarray(np.concatenate([s.part.poses[s.poses] for s in segments]), dtype=np.float64),
    )


def pose_steps(segment: Segment) -> tuple[Ints, Floats]:
    """Step and share of the step of each pose of a segment."""
    since = (segment.part.pose_times[segment.poses] - segment.begin) / segment.h
    step = np.minimum(np.maximum(np.floor(since + 1e-9), 0.0), segment.steps - 1.0).astype(np.int64)
    return step, np.minimum(np.maximum(since - step, 0.0), 1.0)
