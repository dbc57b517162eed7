"""Logs prepared for identification: requirements, and the split into fitted and held-out logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.text import alternatives, counted
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


POSES_MIN = 5
"""Least number of poses of a part that is used."""
MOTION_MIN = 0.05
"""Least distance from the first poses that counts as motion, m."""
HOLDOUT_FRACTION: Final = 0.25
"""Share of the logs that is held out by default."""
HOLDOUT_LOGS_MIN: Final = 4
"""Number of logs below which none is held out by default: the fit needs them all."""


@dataclass(frozen=True)
class ScreenedLogs:
    """Logs without parts that are too short.

    Attributes:
        logs: logs with at least one part that is long enough.
        shortened: for each of them that lost parts, a message.
        problems: for each log that was left out, the reason.
    """

    logs: tuple[Log, ...]
    shortened: tuple[str, ...]
    problems: tuple[Diagnostic, ...]


def screen_logs(logs: Sequence[Log]) -> ScreenedLogs:
    """Leave out parts with fewer than `POSES_MIN` poses, logs that have no longer part, and copies of logs.

    A drive that counts twice could be held out to judge a model that is fitted to it.
    """
    kept, shortened, problems = [], [], []
    first: dict[tuple[str, ...], str] = {}
    for log in logs:
        content = tuple(source.sha256 for source in log.sources)
        if content and (original := first.setdefault(content, log.name)) != log.name:
            problem = f"has the same files as {original}"
            problems.append(Diagnostic(log.name, problem, "expected each drive once", code=Code.CONFLICT))
            continue
        parts = tuple(part for part in log.parts if len(part.pose_times) >= POSES_MIN and len(part.command_times) > 0)
        if not parts:
            longest = max((len(part.pose_times) for part in log.parts), default=0)
            problem = f"has no part with {POSES_MIN} poses, the longest has {longest}"
            problems.append(Diagnostic(log.name, problem, "expected a longer drive", code=Code.DATA))
            continue
        if len(parts) < len(log.parts):
            short = len(log.parts) - len(parts)
            shortened.append(f"{log.name}: {short} of {len(log.parts)} parts left out: fewer than {POSES_MIN} poses")
        kept.append(replace(log, parts=parts))
    return ScreenedLogs(tuple(kept), tuple(shortened), tuple(problems))


def check_any(logs: Sequence[Log]) -> None:
    """Refuse to identify from no logs.

    Raises:
        InputError: if there are none.
    """
    if not logs:
        raise InputError.of("logs", "there are none", "expected at least one log with commands and poses", Code.MISSING)


def usable_logs(vehicle: Vehicle, logs: Sequence[Log]) -> list[Log]:
    """The logs with their commands in the vehicle's order, without parts that are too short (see `screen_logs`).

    Raises:
        InputError: with every log whose commands are not the vehicle's, or whose numbers are not finite; if there are
            no logs, or nothing in them moves.
    """
    check_any(logs)
    problems = [problem for log in logs for problem in _problems(vehicle, log)]
    if problems:
        raise InputError(problems)
    usable = [_ordered(vehicle, log) for log in screen_logs(logs).logs]
    if not usable:
        raise InputError.of("logs", f"have no part with {POSES_MIN} poses", "expected longer drives", Code.DATA)
    if not any(_moves(part) for log in usable for part in log.parts):
        raise InputError.of(
            "logs", "show no motion", "expected drives: a vehicle at rest identifies nothing", Code.DATA
        )
    return usable


def _problems(vehicle: Vehicle, log: Log) -> list[Diagnostic]:
    problems = [
        Diagnostic(
            log.name,
            f"has no control {name}, only {', '.join(log.controls)}",
            f"{vehicle.name} takes {alternatives(vehicle.controls)}",
            code=Code.MISMATCH,
        )
        for name in vehicle.controls
        if name not in log.controls
    ]
    for part in log.parts:
        arrays = (part.command_times, part.commands, part.pose_times, part.poses)
        if not all(np.isfinite(array).all() for array in arrays):
            problems.append(
                Diagnostic(log.name, "has numbers that are not finite", "expected finite numbers", code=Code.DATA)
            )
        elif any((np.diff(times) <= 0).any() for times in (part.command_times, part.pose_times)):
            problems.append(
                Diagnostic(log.name, "has times that do not ascend", "expected ascending times", code=Code.DATA)
            )
    return problems


def _ordered(vehicle: Vehicle, log: Log) -> Log:
    order = [log.controls.index(name) for name in vehicle.controls]
    parts = tuple(
        replace(part, commands=np.ascontiguousarray(part.commands[:, order], dtype=float)) for part in log.parts
    )
    return replace(log, controls=tuple(vehicle.controls), parts=parts)


def _moves(part: Part) -> bool:
    away = part.poses[:, :2] - np.median(part.poses[:POSES_MIN, :2], axis=0)
    return bool(np.quantile(np.hypot(away[:, 0], away[:, 1]), 0.95) > MOTION_MIN)


@dataclass(frozen=True)
class LogSplit:
    """Logs to fit and logs to test with, each in their order, and the decision as a message."""

    fitted: tuple[Log, ...]
    held_out: tuple[Log, ...]
    note: str


def check_holdout(holdout: float | None) -> None:
    """Check a fraction of logs to hold out.

    Raises:
        InputError: if it is not in [0, 1).
    """
    if holdout is not None and not 0.0 <= holdout < 1.0:
        raise InputError.of_argument("holdout", f"is {holdout:g}", "expected a fraction of at least 0 and below 1")


def split_logs(logs: Sequence[Log], holdout: float | None = None) -> LogSplit:
    """Hold out a fraction of the logs, by default a quarter if there are at least `HOLDOUT_LOGS_MIN`.

    The choice depends on the number of logs alone.  At least one log is fitted; a fraction above 0 holds out at least
    one.

    Raises:
        InputError: if the fraction is not in [0, 1), or would hold out the only log.
    """
    check_holdout(holdout)
    count = len(logs)
    if holdout is None and count < HOLDOUT_LOGS_MIN:
        note = f"{counted(count, 'log')}: none is held out (a quarter of {HOLDOUT_LOGS_MIN} logs or more, by default)"
        return LogSplit(tuple(logs), (), note)
    fraction = HOLDOUT_FRACTION if holdout is None else holdout
    if fraction == 0.0:
        return LogSplit(tuple(logs), (), "no log is held out")
    if count == 1:
        raise InputError.of_argument(
            "holdout", f"is {holdout:g}, and there is one log", "expected at least two logs, or 0"
        )
    held = min(max(round(fraction * count), 1), count - 1)
    # at random: every fourth or fifth log may be of the same manoeuvre
    chosen = set(np.random.default_rng(0).permutation(count)[:held].tolist())
    out = tuple(log for k, log in enumerate(logs) if k in chosen)
    fitted = tuple(log for k, log in enumerate(logs) if k not in chosen)
    return LogSplit(fitted, out, f"{held} of {counted(count, 'log')} held out: {', '.join(log.name for log in out)}")


def used_text(logs: Sequence[Log]) -> str:
    """Number of logs, their duration, and how much of it is used, as text: ``6 logs, 512 of 600 s``."""
    used, whole = sum(log.duration for log in logs), sum(log.parts[-1].pose_times[-1] for log in logs if log.parts)
    of = f" of {whole:.0f}" if f"{used:.0f}" != f"{whole:.0f}" else ""
    return f"{counted(len(logs), 'log')}, {used:.0f}{of} s"
