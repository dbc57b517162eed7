"""From chosen columns to a log's parts: what cannot be used is left out and said."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.logs import reports
from kraft.logs.choice import Choice
from kraft.logs.commands import Commands, merge
from kraft.logs.dead_man import held_intervals, interval_of
from kraft.logs.findings import Findings
from kraft.logs.log import Array, Finding, Part
from kraft.logs.mapping import Limits, Mapping
from kraft.logs.motion import AVERAGED, extent
from kraft.logs.parts import POSES_MIN, make_part, pose_gap, stretches
from kraft.logs.planar import planar
from kraft.logs.samples import Samples, read_samples
from kraft.logs.table import Rows
from kraft.logs.teleports import stale, top_speed, tracks
from kraft.logs.unit_checks import check_units
from kraft.text import counted

TURN_LEAST: Final = 0.2
"""A log in which the vehicle turns at least this much has motion, rad."""


def clean(choice: Choice, controls: Sequence[str], mapping: Mapping) -> tuple[tuple[Part, ...], tuple[Finding, ...]]:
    """Make the parts of a log.

    Raises:
        InputError: if nothing remains, with the reason and the row.
    """
    findings, limits = Findings(), mapping.limits
    reports.broken_lines(choice, findings)
    streams, poses, origin = _read(choice, findings)
    poses, xyyaw = planar(poses, findings)
    _check_number(poses, "has an orientation in only")
    check_units(streams, poses, xyyaw, findings)
    commands = merge(streams, controls, limits)
    _check_overlap(commands, poses, choice)
    reports.dropouts(poses, pose_gap(poses.times, limits), findings)
    repeated = stale(poses.times, xyyaw)
    reports.left_out("stale", poses, repeated, "repeat the one before while the vehicle moves", findings)
    poses, xyyaw = poses.keep(~repeated), xyyaw[~repeated]
    reports.command_gaps(streams, limits, findings)
    held, intervals = _held(choice, poses, mapping, origin, findings)
    parts = _cut(poses, xyyaw, commands, held, intervals, limits, findings)
    _check_motion(poses, parts, limits)
    return parts, findings.as_tuple()


def _read(choice: Choice, findings: Findings) -> tuple[tuple[Samples, ...], Samples, float]:
    """Commands and poses, from the first stamp on, and that stamp; what is wrong with either is said together."""
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


def _check_number(poses: Samples, only: str) -> None:
    if len(poses) < POSES_MIN:
        raise poses.refuse(f"{only} {counted(len(poses), 'pose')}", f"expected {POSES_MIN} or more", 0)


def _check_overlap(commands: Commands, poses: Samples, choice: Choice) -> None:
    expected = "expected both to be of the same drive, by the same clock, in the same unit"
    if not len(commands.times):
        raise poses.refuse("the controls are never all commanded", "expected commands of all controls at the same time")
    # commands that are logged when they change hold for long, but not from another day
    last = min(commands.until[-1], commands.times[-1] + poses.times[-1] - poses.times[0])
    if commands.times[0] < poses.times[-1] and last > poses.times[0]:
        return
    names = [choice.commands[0].table.name, poses.stream.table.name]
    spans = [f"{times[0]:.3f} to {times[-1]:.3f} s" for times in (commands.times, poses.times)]
    fact = f"commands ({names[0]}: {spans[0]}) and poses ({names[1]}: {spans[1]}) do not overlap in time"
    raise poses.refuse(fact, expected)


def _held(choice: Choice, poses: Samples, mapping: Mapping, origin: float, findings: Findings) -> tuple[Rows, Array]:
    """Interval of the dead-man switch that each pose is in, shape (n,), and the intervals, shape (k, 2), s."""
    if choice.dead_man is None:
        return np.zeros(len(poses), np.int64), np.array([[-np.inf, np.inf]])
    switch = read_samples("switch positions", choice.dead_man, findings).shifted(origin)
    intervals = held_intervals(switch, mapping.dead_man)
    held = interval_of(poses.times, intervals)
    reports.left_out("dead man", poses, held < 0, "while the dead-man switch is released", findings)
    return held, intervals


def _cut(
    poses: Samples,
    xyyaw: Array,
    commands: Commands,
    held: Rows,
    intervals: Array,
    limits: Limits,
    findings: Findings,
) -> tuple[Part, ...]:
    gap = pose_gap(poses.times, limits)
    speed = limits.top_speed or top_speed(poses.times, xyyaw[:, :2])
    labels = tracks(poses.times, xyyaw, speed)
    reports.pose_gaps(poses, gap, findings)
    reports.teleports(poses, labels, speed, findings)
    reports.uncommanded(poses, commands, findings)
    found = stretches(poses, labels, held, commands, gap)
    long = [index for index in found if len(index) >= POSES_MIN]
    short = sum(len(index) for index in found if len(index) < POSES_MIN)
    findings.add("short", short, f"{counted(short, 'pose')} in parts of fewer than {POSES_MIN}; left out")
    reports.wraps(poses, xyyaw[:, 2], findings)
    if not long:
        why = "; ".join(finding.text for finding in findings.found)
        raise poses.refuse(f"nothing remains: {why}", "expected a stretch of poses while commands are given")
    return tuple(
        make_part(poses.times[index], xyyaw[index], commands, float(intervals[held[index[0]], 0])) for index in long
    )


def _check_motion(poses: Samples, parts: tuple[Part, ...], limits: Limits) -> None:
    ways = [extent(part.pose_times, part.poses) for part in parts]
    if all(way < limits.least_motion and turn < TURN_LEAST for way, turn in ways):
        way = max(way for way, _ in ways)
        expected = f"expected at least {limits.least_motion:g} m (limits.least_motion in a mapping file)"
        fact = f"the vehicle gets {way:.2g} m far (between means over up to {AVERAGED:g} s)"
        raise poses.refuse(f"there is no motion: {fact}", expected)
