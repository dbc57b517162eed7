"""Cleaning of a log: from its columns to its parts; what cannot be used is left out and reported as a finding.

A finding says how often something was found, where first, and what was left out because of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.logs.findings import (
    add_broken_lines,
    add_command_gaps,
    add_dropouts,
    add_left_out,
    add_masked,
    add_pose_gaps,
    add_repeated_commands,
    add_teleports,
    add_uncommanded,
    add_wraps,
    add_zeros,
)
from kraft.logs.held_commands import (
    HeldCommands,
    held_intervals,
    interval_of,
    masked,
    merge_commands,
)
from kraft.logs.log import Array, Finding, Findings, Part
from kraft.logs.mapping import Limits, Mapping
from kraft.logs.motion import AVERAGING_TIME, OUTLIER, extent, isolated, leading_zeros, stale, top_speed, tracks
from kraft.logs.parts import make_part, pose_gap, segments
from kraft.logs.samples import Samples, read_samples
from kraft.logs.streams import Choice
from kraft.logs.table import Rows
from kraft.logs.units import check_units
from kraft.text import counted

TURN_MIN: Final = 0.2
"""Least turn that counts as motion, rad."""
POSES_MIN: Final = 3
"""Least number of poses of a part: fewer have no change of the speed."""
MOVED_MIN: Final = 0.2
"""Least distance at which a vehicle moves while commands of 0 are recorded, m."""
MASKED_LOW_MAX: Final = 10.0
"""Lowest number of a control up to which 0 may be its neutral one."""
ALWAYS: Final = np.array([[-np.inf, np.inf]])
"""Interval of a dead-man switch that is always held."""
UPRIGHT_COSINE_MIN: Final = 0.7
"""Cosine of the tilt below which the vehicle is not upright."""
TILTED_SHARE: Final = 0.1
"""Share of tilted poses from which on it counts as not upright."""


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
    _check_number(poses, "without the zeros before the first pose, there are only")
    reached = tracks(poses.times, xyyaw, _limit(poses, xyyaw, limits)) != OUTLIER
    reached &= ~isolated(xyyaw[:, :2])  # the first pose, from which all others are reached, may be one
    streams = tuple(_sent(samples, poses.times[reached], xyyaw[reached], findings) for samples in streams)
    commands = merge_commands(streams, controls, limits)
    _check_overlap(commands, poses, choice)
    add_dropouts(poses, pose_gap(poses.times, limits), findings)
    repeated = stale(poses.times, xyyaw, _limit(poses, xyyaw, limits))
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


def _limit(poses: Samples, xyyaw: Array, limits: Limits) -> float:
    """Speed above which poses (n, 3) are teleports: the stated one, or by the usual speed of the log, m/s."""
    return limits.top_speed or top_speed(poses.times, xyyaw[:, :2])


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
    count = leading_zeros(poses.times, xyyaw, _limit(poses, xyyaw, limits))
    add_zeros(poses, count, "pose", findings)
    kept = np.arange(len(poses)) >= count
    return (poses.keep(kept), xyyaw[kept]) if count else (poses, xyyaw)


def _sent(samples: Samples, times: Array, xyyaw: Array, findings: Findings) -> Samples:
    """Commands without the zeros that a recorder writes before the first one is sent.

    A vehicle at rest may well be commanded 0; zeros count as not sent if the vehicle moves meanwhile, or if they are
    far from all other commands, as for pulse widths.  `times` (n,) and `xyyaw` (n, 3) are the poses without outliers.
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
    speed = _limit(poses, xyyaw, limits)
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
    if np.quantile(1 - 2 * (x * x + y * y), TILTED_SHARE) < UPRIGHT_COSINE_MIN:  # about another axis it comes and goes
        findings.add("tilted", 1, f"{poses.stream.table.name}: the vehicle is not upright; is z not up?")
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return poses, np.column_stack([poses.values[:, :2], yaw])
