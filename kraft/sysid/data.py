"""What logs must have before anything is estimated from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.text import alternatives, counted
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


LEAST_POSES = 5
LEAST_MOTION = 0.05
"""Distance from its first pose that a part must get to, m, for a log to show motion."""
FRACTION: Final = 0.25
FEW: Final = 4
"""With fewer logs than this none is held out, unless it is asked for: the fit needs them all."""


@dataclass(frozen=True)
class Screened:
    """Logs of which only parts long enough to say something are left.

    Attributes:
        logs: those that have such a part.
        shortened: for those of them that lost other parts, what was left out.
        problems: for each log that has no such part, that it is left out.
    """

    logs: tuple[Log, ...]
    shortened: tuple[str, ...]
    problems: tuple[Diagnostic, ...]


def screened(logs: Sequence[Log]) -> Screened:
    """Leave out parts with fewer than `LEAST_POSES` poses, and logs that have no other."""
    kept, shortened, problems = [], [], []
    for log in logs:
        parts = tuple(part for part in log.parts if len(part.pose_times) >= LEAST_POSES and len(part.command_times) > 0)
        if not parts:
            longest = max((len(part.pose_times) for part in log.parts), default=0)
            problem = f"has no part with {LEAST_POSES} poses, the longest has {longest}"
            problems.append(Diagnostic(log.name, problem, "expected a longer drive"))
            continue
        if len(parts) < len(log.parts):
            short = len(log.parts) - len(parts)
            shortened.append(
                f"{log.name}: {short} of {len(log.parts)} parts left out, with less than {LEAST_POSES} poses"
            )
        kept.append(replace(log, parts=parts))
    return Screened(tuple(kept), tuple(shortened), tuple(problems))


def usable_logs(vehicle: Vehicle, logs: Sequence[Log]) -> list[Log]:
    """The logs with their commands in the vehicle's order, less parts too short to say anything (see `screened`).

    Raises:
        InputError: with every log whose commands are not the vehicle's, or whose numbers are not finite; if there are
            no logs, or nothing in them moves.
    """
    if not logs:
        raise InputError.of("logs", "there are none", "expected at least one log with commands and poses")
    problems = [problem for log in logs for problem in _problems(vehicle, log)]
    if problems:
        raise InputError(problems)
    usable = [_shaped(vehicle, log) for log in screened(logs).logs]
    if not usable:
        raise InputError.of("logs", f"have no part with {LEAST_POSES} poses", "expected longer drives")
    if not any(_moves(part) for log in usable for part in log.parts):
        raise InputError.of("logs", "show no motion", "expected drives: nothing can be learnt from a vehicle at rest")
    return usable


def _problems(vehicle: Vehicle, log: Log) -> list[Diagnostic]:
    problems = [
        Diagnostic(
            log.name,
            f"has no control {name}, only {', '.join(log.controls)}",
            f"{vehicle.name} takes {alternatives(vehicle.controls)}",
        )
        for name in vehicle.controls
        if name not in log.controls
    ]
    for part in log.parts:
        arrays = (part.command_times, part.commands, part.pose_times, part.poses)
        if not all(np.isfinite(array).all() for array in arrays):
            problems.append(Diagnostic(log.name, "has numbers that are not finite", "expected finite numbers"))
        elif any((np.diff(times) <= 0).any() for times in (part.command_times, part.pose_times)):
            problems.append(Diagnostic(log.name, "has times that do not ascend", "expected ascending times"))
    return problems


def _shaped(vehicle: Vehicle, log: Log) -> Log:
    order = [log.controls.index(name) for name in vehicle.controls]
    parts = tuple(
        replace(part, commands=np.ascontiguousarray(part.commands[:, order], dtype=float)) for part in log.parts
    )
    return replace(log, controls=tuple(vehicle.controls), parts=parts)


def _moves(part: Part) -> bool:
    away = part.poses[:, :2] - np.median(part.poses[:LEAST_POSES, :2], axis=0)
    return bool(np.quantile(np.hypot(away[:, 0], away[:, 1]), 0.95) > LEAST_MOTION)


@dataclass(frozen=True)
class Split:
    """Logs to fit and logs to test with, each in their order, and what was decided, as a sentence."""

    fitted: tuple[Log, ...]
    held_out: tuple[Log, ...]
    note: str


def split(logs: Sequence[Log], fraction: float | None = None) -> Split:
    """Hold out a fraction of the logs, by default a quarter if there are at least `FEW`.

    Which ones depends on how many there are and on nothing else.  One log at least is fitted; a fraction above 0 holds
    out one at least.

    Raises:
        InputError: if the fraction is not in [0, 1), or the only log is asked to be held out.
    """
    if fraction is not None and not 0.0 <= fraction < 1.0:
        raise InputError.of("--holdout", f"is {fraction:g}", "expected a fraction of at least 0 and below 1")
    count = len(logs)
    if fraction is None and count < FEW:
        note = f"{counted(count, 'log')}: none is held out (from {FEW} on a quarter is, or --holdout)"
        return Split(tuple(logs), (), note)
    wanted = FRACTION if fraction is None else fraction
    if wanted == 0.0:
        return Split(tuple(logs), (), "no log is held out")
    if count == 1:
        raise InputError.of("--holdout", "is given, and there is one log", "expected two logs at least, or --holdout 0")
    held = min(max(round(wanted * count), 1), count - 1)
    # drawn, since every fourth or fifth log may well be of the same manoeuvre
    chosen = set(np.random.default_rng(0).permutation(count)[:held].tolist())
    out = tuple(log for k, log in enumerate(logs) if k in chosen)
    fitted = tuple(log for k, log in enumerate(logs) if k not in chosen)
    return Split(fitted, out, f"{held} of {counted(count, 'log')} held out: {', '.join(log.name for log in out)}")
