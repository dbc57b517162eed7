"""Findings of the cleaning: how often something was found, where first, and what was left out because of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from kraft.logs.held_commands import (
    HeldCommands,
    timeout,
)
from kraft.logs.log import Array, Findings
from kraft.logs.mapping import Limits
from kraft.logs.motion import OUTLIER
from kraft.logs.samples import Samples
from kraft.logs.streams import Choice
from kraft.logs.table import Flags, Rows
from kraft.text import counted

REPEATED_ROWS: Final = 3
"""Rows between two changes of the commands from which they are recorded more often than sent."""
REGULAR_RATIO: Final = 1.5
"""Ratio of the usual time between two changes of the commands to the shortest, up to which they are sent at a rate."""
REFRESH_MAX: Final = 0.5
"""Longest time between two commands that are sent at a rate, s."""
CHANGES_MIN: Final = 10
"""Number of changes that shows how often commands are sent."""
DROPOUT_STEPS: Final = 1.6
"""Poses are missing where the next one comes later than this many usual steps."""


def add_broken_lines(choice: Choice, findings: Findings) -> None:
    """Add lines with a wrong number of fields."""
    for table in {id(stream.table): stream.table for _, stream in choice.streams()}.values():
        if table.broken:
            text = f"{counted(len(table.broken), 'line')} of {table.name} with too few or too many fields"
            findings.add("broken", len(table.broken), f"{text}, first line {table.broken[0]}; left out")


def add_left_out(kind: str, poses: Samples, flags: Flags, what: str, findings: Findings) -> None:
    """Add poses that are left out for the reason `what`."""
    if flags.any():
        bad = int(flags.sum())
        text = f"{bad} of {len(poses)} poses {what}, first in {poses.where(int(np.argmax(flags)))}; left out"
        findings.add(kind, bad, text)


def add_dropouts(poses: Samples, gap: float, findings: Findings) -> None:
    """Add missing poses that do not end a part."""
    steps = np.diff(poses.times)
    usual = float(np.median(steps))
    missing = (steps > DROPOUT_STEPS * usual) & (steps <= gap)
    if missing.any():
        first, lost = int(np.argmax(missing)), int(np.sum(np.round(steps[missing] / usual) - 1))
        text = f"about {counted(lost, 'pose')} missing, first after {poses.where(first)}; nothing is left out"
        findings.add("dropout", lost, text)


def add_pose_gaps(poses: Samples, gap: float, findings: Findings) -> None:
    """Add gaps in the poses, which end a part."""
    steps = np.diff(poses.times)
    _add_gaps("gap", "poses", poses, steps > gap, steps, findings)


def add_command_gaps(streams: Sequence[Samples], limits: Limits, findings: Findings) -> None:
    """Add gaps in the commands, which end a part."""
    for samples in streams:
        steps = np.diff(samples.times)
        _add_gaps("command gap", "commands", samples, steps > timeout(samples, limits), steps, findings)


def add_repeated_commands(streams: Sequence[Samples], findings: Findings) -> None:
    """Add commands that are recorded more often than they are sent, so that a change is older than its record."""
    for samples in streams:
        changed = np.flatnonzero(np.any(np.diff(samples.values, axis=0) != 0.0, axis=1)) + 1
        if len(changed) <= CHANGES_MIN:
            continue
        apart, usual = np.quantile(np.diff(changed), (0.05, 0.5))
        step = float(np.median(np.diff(samples.times)))
        regular = usual <= REGULAR_RATIO * apart and apart * step <= REFRESH_MAX  # no manoeuvre of few changes
        if apart >= REPEATED_ROWS and regular:
            text = (
                f"commands are recorded every {step:.2g} s and change every {apart * step:.2g} s at most: a change may "
                "be older than its record by as much; nothing is left out"
            )
            findings.add("repeated", len(samples) - len(changed), text)


def add_zeros(samples: Samples, count: int, what: str, findings: Findings) -> None:
    """Add zeros at the beginning that were recorded before the first message."""
    if count:
        text = (
            f"the first {counted(count, what)} of {len(samples)} are 0 and stand for none, from {samples.where(0)} on"
        )
        findings.add("zeros", count, f"{text}; left out")


def add_masked(
    before: HeldCommands, after: HeldCommands, poses: Samples, names: Sequence[str], findings: Findings
) -> None:
    """Add controls that are 0 because the dead-man switch is released."""
    index = before.in_force(poses.times), after.in_force(poses.times)
    known = (index[0] >= 0) & (index[1] >= 0)
    bad = np.zeros(len(poses), bool)
    bad[known] = np.any(before.values[index[0][known]] != after.values[index[1][known]], axis=1)
    if bad.any():
        first = poses.where(int(np.argmax(bad)))
        text = (
            f"{', '.join(names)} is 0 at {int(bad.sum())} of {len(poses)} poses, while the dead-man switch is released"
        )
        findings.add("dead man", int(bad.sum()), f"{text}, first in {first}; nothing is left out")


def _add_gaps(kind: str, what: str, samples: Samples, long: Flags, steps: Array, findings: Findings) -> None:
    if long.any():
        number, first = int(long.sum()), samples.where(int(np.argmax(long)))
        fact = f"{counted(number, 'gap')} without {what} of up to {steps.max():.3g} s, first after {first}"
        findings.add(kind, number, f"{fact}; the log is cut there")


def add_teleports(poses: Samples, labels: Rows, speed: float, findings: Findings) -> None:
    """Add poses that the vehicle cannot have reached, and teleports."""
    what = f"are unreachable (more than {speed:.3g} m/s)"
    add_left_out("outlier", poses, labels == OUTLIER, what, findings)
    settled = np.flatnonzero(labels != OUTLIER)
    jumps = np.flatnonzero(np.diff(labels[settled]) > 0)
    if len(jumps):
        first = poses.where(int(settled[jumps[0] + 1]))
        text = f"{counted(len(jumps), 'teleport')}, first at {first}; the log is cut there"
        findings.add("teleport", len(jumps), text)


def add_uncommanded(poses: Samples, commands: HeldCommands, findings: Findings) -> None:
    """Add poses without a command in force."""
    early = poses.times < commands.times[0]
    late = (commands.in_force(poses.times) < 0) & ~early
    add_left_out("uncommanded", poses, early, "before the first command", findings)
    add_left_out("uncommanded", poses, late, "too long after the last command", findings)


def add_wraps(poses: Samples, yaw: Array, findings: Findings) -> None:
    """Add jumps of the yaw by a full turn; ``yaw`` has shape (n,)."""
    jumps = np.abs(np.diff(yaw)) > np.pi
    if jumps.any():
        first = poses.where(int(np.argmax(jumps)) + 1)
        text = f"yaw wraps {counted(int(jumps.sum()), 'time')}, first at {first}; made continuous, nothing is left out"
        findings.add("wrap", int(jumps.sum()), text)
