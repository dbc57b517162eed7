"""Cut a log into uninterrupted parts: where poses and commands are both known, and the dead-man switch is held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.logs.findings import Findings, count
from kraft.logs.log import Array, Part
from kraft.logs.mapping import Limits
from kraft.logs.samples import Samples
from kraft.logs.table import Flags, Rows
from kraft.logs.teleports import OUTLIER

HISTORY: Final = 1.0
"""How long before a part's first pose its commands begin, if they do, s: the vehicle may obey them late."""
POSES_MIN: Final = 3
GAP_LEAST, GAP_STEPS = 0.5, 10.0
"""A gap is longer than this many s and this many times the usual step."""
DROPOUT_STEPS: Final = 1.6
REGULAR: Final = 3.0
"""Commands whose steps are rarely longer than this many times the usual one are sent at a rate; others on change."""


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of all controls on one clock.

    Attributes:
        times: strictly ascending, shape (m,), s.
        values: shape (m, nu).
        timeout: how long a command is held at most, s; infinite if they are only logged when they change.
    """

    times: Array
    values: Array
    timeout: float


def command_timeout(times: Array, limits: Limits) -> float:
    """How long a command is known to be in force, s."""
    if limits.command_gap is not None:
        return limits.command_gap
    if len(times) < 10:
        return float("inf")
    steps = np.diff(times)
    usual = float(np.median(steps))
    if np.mean(steps > REGULAR * usual) > 0.1:
        return float("inf")
    return max(GAP_LEAST, GAP_STEPS * usual)


def pose_gap(times: Array, limits: Limits) -> float:
    """How long poses may be missing within a part, s."""
    return limits.pose_gap or max(GAP_LEAST, GAP_STEPS * float(np.median(np.diff(times))))


def report_dropouts(poses: Samples, gap: float, findings: Findings) -> None:
    """Note missing poses that end no part."""
    steps = np.diff(poses.times)
    usual = float(np.median(steps))
    missing = (steps > DROPOUT_STEPS * usual) & (steps <= gap)
    if missing.any():
        first, lost = int(np.argmax(missing)), int(np.sum(np.round(steps[missing] / usual) - 1))
        at = poses.where(first)
        findings.add("dropout", lost, f"about {count(lost, 'pose')} missing, first after {at}; nothing is left out")


def report_gaps(poses: Samples, gap: float, findings: Findings) -> None:
    """Note gaps in the poses that end a part."""
    steps = np.diff(poses.times)
    long = steps > gap
    if long.any():
        first, worst = int(np.argmax(long)), float(steps.max())
        text = f"{count(int(long.sum()), 'gap')} without poses of up to {worst:.3g} s, first after {poses.where(first)}"
        findings.add("gap", int(long.sum()), f"{text}; the log is cut there")


def command_gaps(commands: Commands, samples: tuple[Samples, ...], findings: Findings) -> None:
    """Note gaps in the commands."""
    steps = np.diff(commands.times)
    long = steps > commands.timeout
    if not long.any():
        return
    one = len(samples) == 1
    at = samples[0].where(int(np.argmax(long))) if one else f"{commands.times[int(np.argmax(long))]:.3f} s"
    fact = f"{count(int(long.sum()), 'gap')} without commands of up to {steps.max():.3g} s, first after {at}"
    findings.add("command gap", int(long.sum()), f"{fact}; the log is cut there")


def in_force(commands: Commands, times: Array) -> Rows:
    """Index of the command in force at each time, -1 where none is known. Shape as ``times``."""
    index = np.searchsorted(commands.times, times, side="right") - 1
    known = (index >= 0) & (times - commands.times[index] <= commands.timeout)
    return np.where(known, index, -1)


def stretches(poses: Samples, tracks: Rows, held: Rows, commands: Commands, gap: float) -> list[Rows]:
    """Indices of the poses of each part.

    Args:
        poses: all of them.
        tracks: number of each one's track, shape (n,).
        held: number of each one's interval of the dead-man switch, negative while it is released, shape (n,).
        commands: to leave out what is driven without.
        gap: longest time without poses within a part, s.
    """
    index = in_force(commands, poses.times)
    gaps = np.flatnonzero(np.diff(commands.times) > commands.timeout)
    run = np.searchsorted(gaps, index, side="left")  # changes where the commands had a gap
    good: Flags = (index >= 0) & (tracks != OUTLIER) & (held >= 0)
    chosen = np.flatnonzero(good)
    if not len(chosen):
        return []
    marks = np.column_stack([tracks, held, run])[chosen]
    breaks = (np.diff(poses.times[chosen]) > gap) | np.any(np.diff(marks, axis=0) != 0, axis=1)
    return np.split(chosen, np.flatnonzero(breaks) + 1)


def make_part(times: Array, poses: Array, commands: Commands, since: float) -> Part:
    """Make a part of its poses, shape (n, 3), and of the commands from at most `HISTORY` before them.

    ``since`` is when commands began to be obeyed, s: one that was in force before then counts from then.
    """
    begin = max(since, times[0] - HISTORY)
    first = max(0, int(np.searchsorted(commands.times, begin, side="right")) - 1)
    steps = np.diff(commands.times[first : int(np.searchsorted(commands.times, times[0], side="right"))])
    if (steps > commands.timeout).any():
        first += int(np.flatnonzero(steps > commands.timeout)[-1]) + 1
    last = int(np.searchsorted(commands.times, times[-1], side="right"))
    command_times = np.maximum(commands.times[first:last], since)
    yaw = np.unwrap(poses[:, 2])
    whole = np.column_stack([poses[:, :2], yaw])
    return Part(command_times, commands.values[first:last].copy(), times.copy(), whole)
