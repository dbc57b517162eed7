"""What logs must have before anything is estimated from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.suggest import alternatives
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part

LEAST_POSES = 5
LEAST_MOTION = 0.05
"""Distance from its first pose that a part must get to, m, for a log to show motion."""


def usable_logs(vehicle: Vehicle, logs: Sequence[Log]) -> list[Log]:
    """The logs with their commands in the vehicle's order, less parts too short to say anything.

    Raises:
        InputError: with every log whose commands are not the vehicle's, or whose numbers are not finite; if there are
            no logs, or nothing in them moves.
    """
    if not logs:
        raise InputError.of("logs", "there are none", "expected at least one log with commands and poses")
    problems = [problem for log in logs for problem in _problems(vehicle, log)]
    if problems:
        raise InputError(problems)
    usable = [shaped for log in logs if (shaped := _shaped(vehicle, log)).parts]
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
        replace(part, commands=np.ascontiguousarray(part.commands[:, order], dtype=float))
        for part in log.parts
        if len(part.pose_times) >= LEAST_POSES and len(part.command_times) > 0
    )
    return replace(log, controls=tuple(vehicle.controls), parts=parts)


def _moves(part: Part) -> bool:
    away = part.poses[:, :2] - np.median(part.poses[:LEAST_POSES, :2], axis=0)
    return bool(np.quantile(np.hypot(away[:, 0], away[:, 1]), 0.95) > LEAST_MOTION)
