"""From chosen columns to a log's parts: what cannot be used is left out and said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.logs.choice import Choice
from kraft.logs.dead_man import held_intervals, interval_of
from kraft.logs.findings import Findings, count
from kraft.logs.log import Array, Finding, Part
from kraft.logs.mapping import Limits, Mapping
from kraft.logs.motion import extent
from kraft.logs.parts import (
    POSES_MIN,
    Commands,
    command_gaps,
    command_timeout,
    make_part,
    pose_gap,
    report_dropouts,
    report_gaps,
    stretches,
)
from kraft.logs.samples import Samples, read_samples
from kraft.logs.table import Rows
from kraft.logs.teleports import OUTLIER, stale, top_speed, tracks
from kraft.logs.unit_checks import check_units

TURN_LEAST = 0.2
"""A log in which the vehicle turns at least this much has motion, rad."""


def clean(choice: Choice, controls: Sequence[str], mapping: Mapping) -> tuple[tuple[Part, ...], tuple[Finding, ...]]:
    """Make the parts of a log.

    Raises:
        InputError: if nothing remains, with the reason and the row.
    """
    findings = Findings()
    _broken_rows(choice, findings)
    commands, poses = _read(choice, findings)
    if len(poses) < POSES_MIN:
        raise poses.refuse(f"has only {count(len(poses), 'pose')}", f"expected at least {POSES_MIN}", 0)
    origin = min(poses.times[0], *(samples.times[0] for samples in commands))
    commands = tuple(_shifted(samples, origin) for samples in commands)
    poses = _shifted(poses, origin)
    xyyaw = _planar(poses, findings)
    check_units(commands, poses, xyyaw, findings)
    merged = _merge(commands, controls, mapping.limits)
    _check_overlap(merged, poses, choice)
    report_dropouts(poses, pose_gap(poses.times, mapping.limits), findings)
    repeated = stale(poses.times, xyyaw)
    _report_stale(poses, repeated, findings)
    poses, xyyaw = poses.keep(~repeated), xyyaw[~repeated]
    command_gaps(merged, commands, findings)
    parts = _cut(choice, poses, xyyaw, merged, mapping, origin, findings)
    _check_motion(poses, parts, mapping.limits)
    return parts, findings.as_tuple()


def _read(choice: Choice, findings: Findings) -> tuple[tuple[Samples, ...], Samples]:
    """Read commands and poses; what is wrong with either is said together."""
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
    return tuple(read[:-1]), read[-1]


def _broken_rows(choice: Choice, findings: Findings) -> None:
    for table in {id(stream.table): stream.table for _, stream in choice.streams()}.values():
        if table.broken:
            text = f"{count(table.broken, 'line')} of {table.name} with too few or too many fields"
            findings.add("broken", len(table.broken), f"{text}, first line {table.broken[0]}; left out")


def _shifted(samples: Samples, origin: float) -> Samples:
    return Samples(samples.what, samples.stream, samples.times - origin, samples.values, samples.index)


def _planar(poses: Samples, findings: Findings) -> Array:
    """Poses as x, y and yaw, shape (n, 3)."""
    if poses.stream.roles[2] == "yaw":
        return poses.values
    x, y, z, w = poses.values[:, 2:].T
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if (norm < 0.5).any():
        first = int(np.argmax(norm < 0.5))
        columns = ", ".join(channel.column for channel in poses.stream.channels[2:])
        raise poses.refuse(f"{columns} are no orientation", "expected a quaternion of length 1", first)
    upright = float(np.median(1 - 2 * (x * x + y * y) / norm**2))
    if upright < 0.7:
        findings.add("tilted", 1, f"{poses.stream.table.name}: the vehicle does not stand upright; is z not up?")
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.column_stack([poses.values[:, :2], yaw])


def _merge(commands: tuple[Samples, ...], controls: Sequence[str], limits: Limits) -> Commands:
    """Put the controls of all streams on one clock, in their order; each is held until its next value."""
    timeout = min(command_timeout(samples.times, limits) for samples in commands)
    times = np.unique(np.concatenate([samples.times for samples in commands]))
    times = times[times >= max(samples.times[0] for samples in commands)]
    columns = {}
    for samples in commands:
        index = np.searchsorted(samples.times, times, side="right") - 1
        for role, values in zip(samples.stream.roles, samples.values.T, strict=True):
            columns[role] = values[index]
    return Commands(times, np.column_stack([columns[name] for name in controls]), timeout)


def _check_overlap(commands: Commands, poses: Samples, choice: Choice) -> None:
    if not len(commands.times):
        raise poses.refuse("the controls are never all commanded", "expected commands of all controls at the same time")
    first, last = commands.times[0], commands.times[-1] + min(commands.timeout, poses.times[-1] - poses.times[0])
    if first < poses.times[-1] and last > poses.times[0]:
        return
    tables = [choice.commands[0].table.name, poses.stream.table.name]
    fact = (
        f"commands ({tables[0]}: {commands.times[0]:.3f} to {commands.times[-1]:.3f} s) and poses "
        f"({tables[1]}: {poses.times[0]:.3f} to {poses.times[-1]:.3f} s) do not overlap in time"
    )
    raise poses.refuse(fact, "expected both to be of the same drive, by the same clock, in the same unit")


def _report_stale(poses: Samples, repeated: np.ndarray, findings: Findings) -> None:
    if repeated.any():
        fact = f"{int(repeated.sum())} of {len(poses)} poses repeat the one before while the vehicle moves"
        findings.add(
            "stale", int(repeated.sum()), f"{fact}, first in {poses.where(int(np.argmax(repeated)))}; left out"
        )


def _cut(
    choice: Choice,
    poses: Samples,
    xyyaw: Array,
    commands: Commands,
    mapping: Mapping,
    origin: float,
    findings: Findings,
) -> tuple[Part, ...]:
    gap = pose_gap(poses.times, mapping.limits)
    report_gaps(poses, gap, findings)
    speed = mapping.limits.top_speed or top_speed(poses.times, xyyaw[:, :2])
    labels = tracks(poses.times, xyyaw, speed)
    _report_teleports(poses, labels, speed, findings)
    held, intervals = _held(choice, poses, mapping, origin, findings)
    _report_outside(poses, commands, findings)
    parts = []
    short = 0
    for index in stretches(poses, labels, held, commands, gap):
        if len(index) < POSES_MIN:
            short += len(index)
            continue
        since = float(intervals[held[index[0]], 0])
        parts.append(make_part(poses.times[index], xyyaw[index], commands, since))
    findings.add("short", short, f"{count(short, 'pose')} in parts of fewer than {POSES_MIN}; left out")
    _report_wraps(poses, xyyaw[:, 2], findings)
    if not parts:
        raise poses.refuse(
            "nothing remains", "; ".join(map(str, findings.found)) or "expected poses while commands are given"
        )
    return tuple(parts)


def _held(choice: Choice, poses: Samples, mapping: Mapping, origin: float, findings: Findings) -> tuple[Rows, Array]:
    """Interval of the dead-man switch that each pose is in, and the intervals."""
    if choice.dead_man is None:
        return np.zeros(len(poses), np.int64), np.array([[-np.inf, np.inf]])
    switch = _shifted(read_samples("switch positions", choice.dead_man, findings), origin)
    intervals = held_intervals(switch, mapping.dead_man)
    held = interval_of(poses.times, intervals)
    released = held < 0
    if released.any():
        fact = f"{int(released.sum())} of {len(poses)} poses while the dead-man switch is released"
        at = poses.where(int(np.argmax(released)))
        findings.add("dead man", int(released.sum()), f"{fact}, first in {at}; left out")
    return held, intervals


def _report_teleports(poses: Samples, labels: Rows, speed: float, findings: Findings) -> None:
    outliers = labels == OUTLIER
    if outliers.any():
        fact = (
            f"{int(outliers.sum())} of {len(poses)} poses are where the vehicle cannot be (more than {speed:.3g} m/s)"
        )
        first = poses.where(int(np.argmax(outliers)))
        findings.add("outlier", int(outliers.sum()), f"{fact}, first in {first}; left out")
    settled = np.flatnonzero(~outliers)
    jumps = np.flatnonzero(np.diff(labels[settled]) > 0)
    if len(jumps):
        first = poses.where(int(settled[jumps[0] + 1]))
        findings.add("teleport", len(jumps), f"{count(len(jumps), 'teleport')}, first at {first}; the log is cut there")


def _report_outside(poses: Samples, commands: Commands, findings: Findings) -> None:
    early, late = poses.times < commands.times[0], poses.times > commands.times[-1] + commands.timeout
    if early.any():
        findings.add("uncommanded", int(early.sum()), f"{int(early.sum())} poses before the first command; left out")
    if late.any():
        first = poses.where(int(np.argmax(late)))
        fact = f"{int(late.sum())} poses more than {commands.timeout:.3g} s after the last command, first in {first}"
        findings.add("uncommanded", int(late.sum()), f"{fact}; left out")


def _report_wraps(poses: Samples, yaw: Array, findings: Findings) -> None:
    wraps = np.abs(np.diff(yaw)) > np.pi
    if wraps.any():
        first = poses.where(int(np.argmax(wraps)) + 1)
        text = f"yaw wraps {count(int(wraps.sum()), 'time')}, first at {first}; made continuous, nothing is left out"
        findings.add("wrap", int(wraps.sum()), text)


def _check_motion(poses: Samples, parts: tuple[Part, ...], limits: Limits) -> None:
    ways = [extent(part.pose_times, part.poses) for part in parts]
    if all(way < limits.least_motion and turn < TURN_LEAST for way, turn in ways):
        way = max(way for way, _ in ways)
        expected = f"expected at least {limits.least_motion:g} m (limits.least_motion in a mapping file)"
        raise poses.refuse(f"there is no motion: the vehicle gets {way:.2g} m far", expected)
