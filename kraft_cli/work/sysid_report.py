"""What is said about an identification: the JSON object of `kraft sysid --json`, and the tables that a person reads."""

from __future__ import annotations

import math
from typing import Any, Final

from kraft.sysid.result import Estimated, PredictionErrors
from kraft.text import counted
from kraft_cli.work.sysid import Identified

SCHEMA: Final = "kraft.sysid/1"
Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Heading and rows."""
INTERVALS: Final = {
    "graph": "from the noise of the poses",
    "sandwich": "from how much the logs differ from each other",
}
AFTER: Final = (1.0, 2.0, 3.0)


def json_content(done: Identified) -> dict[str, Any]:
    """Content of the ``kraft.sysid/1`` object; what does not exist is null."""
    result, unseen = done.result, done.predicted.held_out
    written = done.request.out if not done.objections else None
    return {
        "model": done.subject.name,
        "params": {name: _parameter(estimate, name in result.extras) for name, estimate in result.parameters.items()},
        "interval": result.interval,
        "rmse_train_m": done.predicted.fitted.errors.overall_position,
        "rmse_holdout_m": unseen.errors.overall_position if unseen else None,
        "rmse_train_initial_m": done.predicted.fitted.errors_before.overall_position,
        "rmse_holdout_initial_m": unseen.errors_before.overall_position if unseen else None,
        "prediction": {
            "train": _errors(done.predicted.fitted.errors),
            "train_initial": _errors(done.predicted.fitted.errors_before),
            "holdout": _errors(unseen.errors) if unseen else None,
            "holdout_initial": _errors(unseen.errors_before) if unseen else None,
        },
        "logs": len(done.logs.logs),
        "held_out": [log.name for log in done.split.held_out],
        "left_out": [str(problem) for problem in done.logs.problems],
        "correlation": {"names": list(result.names), "matrix": result.correlation.tolist()},
        "pose_noise": {
            "position_m": result.noise.position,
            "yaw_rad": result.noise.yaw,
            "measured": result.noise_measured,
        },
        "rear_axle_m": result.rear_axle,
        "converged": bool(result.converged),
        "identifiable": not done.objections,
        "objections": list(done.objections),
        "iterations": int(result.iterations),
        "wall_s": done.seconds,
        "warnings": list(result.warnings),
        "notes": list(result.notes),
        "vehicle_file": None if written is None else str(written),
    }


def parameter_table(done: Identified) -> Table:
    """Every parameter with its unit, value, interval and initial value."""
    heading = ("PARAMETER", "VALUE", f"95 % INTERVAL ({done.result.interval})", "INITIAL", "UNIT", "MEANING")
    return heading, [_row(name, estimate) for name, estimate in done.result.parameters.items()]


def prediction_table(done: Identified) -> Table:
    """Open-loop errors after 1, 2 and 3 s, identified beside initial; on held-out logs if there are any."""
    unseen = done.predicted.held_out
    forecast = unseen or done.predicted.fitted
    whose = "held-out logs" if unseen else "fitted logs"
    heading = (f"OPEN LOOP, {whose}", *(f"{after:g} s" for after in AFTER), "all")
    after, before = forecast.errors, forecast.errors_before
    return heading, [
        ("position, identified", *_metres(after)),
        ("position, initial", *_metres(before)),
        ("yaw, identified", *_degrees(after)),
        ("yaw, initial", *_degrees(before)),
    ]


def remarks(done: Identified) -> list[str]:
    """What has to be said under the tables."""
    result = done.result
    noise, origin = result.noise, "measured from the logs" if result.noise_measured else "as stated"
    state = "converged" if result.converged else "NOT converged"
    why = INTERVALS[result.interval]
    said = [
        f"{state} after {counted(result.iterations, 'iteration')}, {done.seconds:.2f} s; intervals follow {why}",
        f"noise of the poses {1000 * noise.position:.3g} mm, {math.degrees(noise.yaw):.2g} deg, {origin}",
        *result.notes,
    ]
    if result.rear_axle is not None:
        said.append(f"the tracked point is {result.rear_axle:.3f} m ahead of the rear axle")
    return said


def _parameter(estimate: Estimated, extra: bool) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "std": estimate.std,
        "ci95": list(estimate.ci95),
        "unit": estimate.unit,
        "description": estimate.description,
        "initial": estimate.initial,
        "min": estimate.min,
        "max": estimate.max,
        "frozen": bool(estimate.frozen),
        "at_bound": bool(estimate.at_bound),
        "extra": extra,
    }


def _errors(errors: PredictionErrors) -> dict[str, Any]:
    return {
        "position_m": {f"{after:g}": value for after, value in errors.position.items()},
        "yaw_rad": {f"{after:g}": value for after, value in errors.yaw.items()},
        "overall_position_m": errors.overall_position,
        "overall_yaw_rad": errors.overall_yaw,
        "windows": errors.windows,
    }


def _row(name: str, estimate: Estimated) -> tuple[str, ...]:
    digits = _digits(estimate)
    low, high = (f"{value:.{digits}f}" for value in estimate.ci95)
    interval = "frozen" if estimate.frozen else f"{low} to {high}{estimate.remark}"
    value = f"{estimate.value:.{digits}f}"
    return name, value, interval, f"{estimate.initial:.{digits}f}", estimate.unit, estimate.description


def _digits(estimate: Estimated) -> int:
    """Decimals that show two digits of the standard deviation."""
    size = estimate.std if estimate.std > 0 else abs(estimate.value) / 1000
    return min(max(1 - math.floor(math.log10(size)), 0), 6) if size > 0 else 4


def _metres(errors: PredictionErrors) -> list[str]:
    values = [errors.position.get(after) for after in AFTER]
    return [_said(value, 100, " cm") for value in (*values, errors.overall_position)]


def _degrees(errors: PredictionErrors) -> list[str]:
    values = [errors.yaw.get(after) for after in AFTER]
    return [_said(value, 180 / math.pi, " deg") for value in (*values, errors.overall_yaw)]


def _said(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{factor * value:.2f}{unit}"
