"""Cleaning of a log: from its columns to its parts; what cannot be used is left out and reported as a finding.

A finding says how often something was found, where first, and what was left out because of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.logs.log import Array, Finding, Findings, Part
from kraft.logs.mapping import Limits, Mapping
from kraft.logs.motion import AVERAGING_TIME, OUTLIER, check_units, extent, leading_zeros, stale, top_speed, tracks
from kraft.logs.streams import (
    GAP_MIN,
    GAP_STEPS,
    Choice,
    HeldCommands,
    Samples,
    held_intervals,
    interval_of,
    masked,
    merge_commands,
    read_samples,
    timeout,
)
from kraft.logs.table import Flags, Rows
from kraft.text import counted

TURN_MIN: Final = 0.2
"""Least turn that counts as motion, rad."""
HISTORY: Final = 1.0
"""Time before the first pose of a part from which commands are kept, s: they may take effect with a delay."""
POSES_MIN: Final = 3
MOVED_MIN: Final = 0.2
"""Least distance at which a vehicle moves while commands of 0 are recorded, m."""
MASKED_LOW_MAX: Final = 10.0
"""Lowest number of a control up to which 0 may be its neutral one."""
ALWAYS: Final = np.array([[-np.inf, np.inf]])
"""Interval of a dead-man switch that is always held."""
UPRIGHT_COSINE_MIN: Final = 0.7
"""Cosine of the tilt below which the vehicle is not upright."""


def clean(choice: Choice, controls: Sequence[str], mapping: Mapping) -> tuple[tuple[Part, ...], tuple[Finding, ...]]:
    """Make the parts of a log.

    Raises:
        InputError: if nothing remains, with the reason and the row.
    """
    findings, limits = Findings(), mapping.limits
    add_broken_lines(choice, findings)
    streams, poses, origin = _read(choice, findings)
    poses, xyyaw = planar(poses, findings)
    _check_number(poses, "has an orientation in only")
    check_units(streams, poses, xyyaw, findings)
    poses, xyyaw = _without_zeros(poses, xyyaw, limits, findings)
    streams = tuple(_sent(samples, poses.times, xyyaw, findings) for samples in streams)
    commands = merge_commands(streams, controls, limits)
    _check_overlap(commands, poses, choice)
    add_dropouts(poses, pose_gap(poses.times, limits), findings)
    repeated = stale(poses.times, xyyaw)
    add_left_out("stale", poses, repeated, "repeat the one before while the vehicle moves", findings)
    poses, xyyaw = poses.keep(~repeated), xyyaw[~repeated]
    add_command_gaps(streams, limits, findings)
    add_repeated_commands(streams, findings)
    intervals = _held(choice, mapping, origin, findings)
    if mapping.dead_man is not None and mapping.dead_man.masks is not None:
        columns = [list(controls).index(name) for name in mapping.dead_man.masks]
        _check_masked(commands, columns, controls, mapping)
        before, commands = commands, masked(commands, columns, intervals)
        add_masked(before, commands, poses, mapping.dead_man.masks, findings)
        intervals = ALWAYS
    held = interval_of(poses.times, intervals)
    add_left_out("dead man", poses, held < 0, "while the dead-man switch is released", findings)
    parts = _cut(poses, xyyaw, commands, held, intervals, limits, findings)
    _check_motion(poses, parts, controls, limits)
    return parts, findings.as_tuple()


def _read(choice: Choice, findings: Findings) -> tuple[tuple[Samples, ...], Samples, float]:
    """Commands and poses with times from the first stamp on, and that stamp.

    Raises:
        InputError: with the problems of commands and poses together.
    """
    read: list[Samples] = []
    problems: list[Diagnostic] = []
    clocks = {(id(stream.table), stream.time.column) for stream in (*choice.commands, choice.poses)}
    rows = "rows" if len(clocks) == 1 else ""
    for what, stream in [*(("commands", stream) for stream in choice.commands), ("poses", choice.poses)]:
        try:
            read.append(read_samples(what, stream, findings, rows))
        except InputError as error:
            problems += error.diagnostics
    if problems:
        raise InputError(problems)
    _check_number(read[-1], "has only")
    origin = float(min(samples.times[0] for samples in read))
    *streams, poses = (samples.shifted(origin) for samples in read)
    return tuple(streams), poses, origin


def _without_zeros(poses: Samples, xyyaw: Array, limits: Limits, findings: Findings) -> tuple[Samples, Array]:
    """Poses without the zeros that a recorder writes before the first one is measured."""
    count = leading_zeros(poses.times, xyyaw, limits.top_speed or top_speed(poses.times, xyyaw[:, :2]))
    add_zeros(poses, count, "pose", findings)
    kept = np.arange(len(poses)) >= count
    return (poses.keep(kept), xyyaw[kept]) if count else (poses, xyyaw)


def _sent(samples: Samples, times: Array, xyyaw: Array, findings: Findings) -> Samples:
    """Commands without the zeros that a recorder writes before the first one is sent.

    A vehicle at rest may well be commanded 0; zeros count as not sent if the vehicle moves meanwhile, or if they are
    far from all other commands, as for pulse widths.
    """
    raw = np.column_stack([samples.stream.table.columns[c.column] for c in samples.stream.channels])[samples.index]
    if not raw[0].any():
        count = int(np.argmax(np.any(raw != 0.0, axis=1)))  # 0 if all are
        rest = raw[count:]
        low, high = rest.min(axis=0), rest.max(axis=0)
        far = (np.maximum(low, -high) > high - low).all() and (high > low).any()
        meanwhile = xyyaw[(times >= samples.times[0]) & (times < samples.times[count])]
        moved = len(meanwhile) > 1 and float(np.hypot(*np.ptp(meanwhile[:, :2], axis=0))) > MOVED_MIN
        if count and (far or moved):
            add_zeros(samples, count, "command", findings)
            return samples.keep(np.arange(len(samples)) >= count)
    return samples


def _check_number(poses: Samples, only: str) -> None:
    if len(poses) < POSES_MIN:
        raise poses.refuse(f"{only} {counted(len(poses), 'pose')}", f"expected {POSES_MIN} or more", 0)


def _check_masked(commands: HeldCommands, columns: Sequence[int], controls: Sequence[str], mapping: Mapping) -> None:
    """Refuse to mask numbers of which 0 cannot be the neutral one, such as pulse widths."""
    for k in columns:
        low, high = float(commands.values[:, k].min()), float(commands.values[:, k].max())
        stated = mapping.commands.controls.get(controls[k])
        if low > max(high - low, MASKED_LOW_MAX) and (stated is None or stated.zero == 0.0):
            problem = f"sets {controls[k]} to 0, and its numbers are from {low:g} to {high:g}"
            expected = f"state its neutral number, commands.controls.{controls[k]}: {{column: ..., zero: ...}}"
            raise InputError([mapping.source.diagnostic(("dead_man", "masks"), problem, expected)])


def _check_overlap(commands: HeldCommands, poses: Samples, choice: Choice) -> None:
    expected = "expected both from the same drive, with the same clock and unit of time"
    if not len(commands.times):
        raise poses.refuse(
            "there is no time at which all controls are commanded", "expected commands of all controls at the same time"
        )
    # commands that are logged when they change hold for long, but at most for the duration of the poses
    last = min(commands.until[-1], commands.times[-1] + poses.times[-1] - poses.times[0])
    if commands.times[0] < poses.times[-1] and last > poses.times[0]:
        return
    names = [choice.commands[0].table.name, poses.stream.table.name]
    spans = [f"{times[0]:.3f} to {times[-1]:.3f} s" for times in (commands.times, poses.times)]
    fact = f"commands ({names[0]}: {spans[0]}) and poses ({names[1]}: {spans[1]}) do not overlap in time"
    raise poses.refuse(fact, expected)


def _held(choice: Choice, mapping: Mapping, origin: float, findings: Findings) -> Array:
    """Intervals during which the dead-man switch is held, shape (k, 2), s."""
    if choice.dead_man is None:
        return ALWAYS
    switch = read_samples("switch positions", choice.dead_man, findings).shifted(origin)
    return held_intervals(switch, mapping.dead_man)


def _cut(
    poses: Samples,
    xyyaw: Array,
    commands: HeldCommands,
    held: Rows,
    intervals: Array,
    limits: Limits,
    findings: Findings,
) -> tuple[Part, ...]:
    gap = pose_gap(poses.times, limits)
    speed = limits.top_speed or top_speed(poses.times, xyyaw[:, :2])
    labels = tracks(poses.times, xyyaw, speed)
    add_pose_gaps(poses, gap, findings)
    add_teleports(poses, labels, speed, findings)
    add_uncommanded(poses, commands, findings)
    found = segments(poses, labels, held, commands, gap)
    long = [index for index in found if len(index) >= POSES_MIN]
    short = sum(len(index) for index in found if len(index) < POSES_MIN)
    findings.add("short", short, f"{counted(short, 'pose')} in parts of fewer than {POSES_MIN}; left out")
    add_wraps(poses, xyyaw[:, 2], findings)
    if not long:
        why = "; ".join(finding.text for finding in findings.found)
        raise poses.refuse(f"nothing remains: {why}", "expected a stretch of poses while commands are given")
    return tuple(
        make_part(poses.times[index], xyyaw[index], commands, float(intervals[held[index[0]], 0])) for index in long
    )


def _check_motion(poses: Samples, parts: tuple[Part, ...], controls: Sequence[str], limits: Limits) -> None:
    ways = [extent(part.pose_times, part.poses) for part in parts]
    if all(way < limits.least_motion and turn < TURN_MIN for way, turn in ways):
        way = max(way for way, _ in ways)
        least = f"at least {limits.least_motion:g} m (limits.least_motion in a mapping file)"
        expected = f"expected {least}: drive with larger commands, these may be within the dead zone"
        most = np.max([np.abs(part.commands).max(axis=0) for part in parts], axis=0)
        given = " and ".join(f"{name} up to {value:.3g}" for name, value in zip(controls, most, strict=True))
        fact = f"the vehicle moves {way:.2g} m (between means over up to {AVERAGING_TIME:g} s), with {given}"
        raise poses.refuse(f"there is no motion: {fact}", expected)


def pose_gap(times: Array, limits: Limits) -> float:
    """Longest time without poses within a part, s."""
    return limits.pose_gap or max(GAP_MIN, GAP_STEPS * float(np.median(np.diff(times))))


def segments(poses: Samples, tracks: Rows, held: Rows, commands: HeldCommands, gap: float) -> list[Rows]:
    """Indices of the poses of each part.

    Args:
        poses: all poses.
        tracks: number of the track of each pose, shape (n,).
        held: number of the interval of the dead-man switch of each pose, negative while it is released, shape (n,).
        commands: commands; poses without a command in force are left out.
        gap: longest time without poses within a part, s.
    """
    index = commands.in_force(poses.times)
    run = np.searchsorted(commands.gaps, index, side="left")  # changes at gaps in the commands
    good: Flags = (index >= 0) & (tracks != OUTLIER) & (held >= 0)
    chosen = np.flatnonzero(good)
    if not len(chosen):
        return []
    marks = np.column_stack([tracks, held, run])[chosen]
    breaks = (np.diff(poses.times[chosen]) > gap) | np.any(np.diff(marks, axis=0) != 0, axis=1)
    return np.split(chosen, np.flatnonzero(breaks) + 1)


def make_part(times: Array, poses: Array, commands: HeldCommands, since: float) -> Part:
    """Make a part from its poses, shape (n, 3), and the commands from at most `HISTORY` before them.

    Commands take effect from ``since`` on, s: one that was in force before begins then.
    """
    begin = max(since, times[0] - HISTORY)
    first = max(0, int(np.searchsorted(commands.times, begin, side="right")) - 1)
    started = int(commands.in_force(times[:1])[0])
    gaps = commands.gaps
    before = gaps[(gaps >= first) & (gaps < started)]
    if len(before):
        first = int(before[-1]) + 1
    last = int(np.searchsorted(commands.times, times[-1], side="right"))
    command_times = np.maximum(commands.times[first:last], since)
    whole = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    return Part(command_times, commands.values[first:last].copy(), times.copy(), whole)


def planar(poses: Samples, findings: Findings) -> tuple[Samples, Array]:
    """Poses with an orientation, and their x, y and yaw, shape (n, 3).

    Raises:
        InputError: if none has.
    """
    if poses.stream.roles[2] == "yaw":
        return poses, poses.values
    none = np.linalg.norm(poses.values[:, 2:], axis=1) < 0.5  # trackers write zeros without a detection
    if none.all():
        columns = ", ".join(channel.column for channel in poses.stream.channels[2:])
        raise poses.refuse(f"{columns} are not an orientation", "expected a quaternion of length 1", 0)
    add_left_out("nan", poses, none, "have no orientation", findings)
    poses = poses.keep(~none)
    x, y, z, w = (poses.values[:, 2:] / np.linalg.norm(poses.values[:, 2:], axis=1, keepdims=True)).T
    if np.median(1 - 2 * (x * x + y * y)) < UPRIGHT_COSINE_MIN:
        findings.add("tilted", 1, f"{poses.stream.table.name}: the vehicle is not upright; is z not up?")
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return poses, np.column_stack([poses.values[:, :2], yaw])


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
        _add_gaps("command gap", "commands", samples, steps > timeout(samples.times, limits), steps, findings)


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
        text = f"the first {counted(count, what)} of {len(samples)} are 0, before there was a first one, from "
        findings.add("zeros", count, f"{text}{samples.where(0)} on; left out")


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
