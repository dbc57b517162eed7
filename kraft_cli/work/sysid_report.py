"""Report of an identification: the JSON object of `kraft sysid --json`, and the tables on the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from kraft.sysid.data import used_text
from kraft.sysid.interface import ModelTrial, ParameterEstimate, PredictionErrors
from kraft.sysid.prediction import HORIZONS
from kraft.text import counted
from kraft_cli.work.next_drives import next_json
from kraft_cli.work.sysid import SysidResult

SCHEMA: Final = "kraft.sysid/1"
Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Heading and rows."""
INTERVALS: Final = {
    "graph": "from the noise of the poses",
    "sandwich": "from the differences between logs",
}


def sysid_json(result: SysidResult) -> dict[str, Any]:
    """Content of the ``kraft.sysid/1`` object, with null for what does not exist."""
    identification, held_out = result.identification, result.evaluation.held_out
    written = result.request.out if not result.objections else None
    return {
        "model": result.base.name,
        "params": {
            name: _parameter(estimate, name in identification.auxiliary)
            for name, estimate in identification.parameters.items()
        },
        "interval": identification.interval,
        "rmse_train_m": result.evaluation.fitted.errors.overall_position,
        "rmse_holdout_m": held_out.errors.overall_position if held_out else None,
        "rmse_train_initial_m": result.evaluation.fitted.initial_errors.overall_position,
        "rmse_holdout_initial_m": held_out.initial_errors.overall_position if held_out else None,
        "prediction": {
            "train": _errors(result.evaluation.fitted.errors),
            "train_initial": _errors(result.evaluation.fitted.initial_errors),
            "holdout": _errors(held_out.errors) if held_out else None,
            "holdout_initial": _errors(held_out.initial_errors) if held_out else None,
            "train_constant": _errors(result.evaluation.fitted.constant_errors),
            "holdout_constant": _errors(held_out.constant_errors) if held_out else None,
        },
        "models": [_trial(trial) for trial in identification.models],
        "terms": [_trial(trial) for trial in identification.trials],
        "logs": len(result.logs.logs),
        "held_out": [log.name for log in result.split.held_out],
        "left_out": [str(problem) for problem in result.logs.problems],
        "correlation": {"names": list(identification.names), "matrix": identification.correlation.tolist()},
        "pose_noise": {
            "position_m": identification.noise.position,
            "yaw_rad": identification.noise.yaw,
            "measured": identification.noise_measured,
        },
        "rear_axle_m": identification.rear_axle,
        "converged": bool(identification.converged),
        "identifiable": not result.objections,
        "objections": list(result.objections),
        "iterations": int(identification.iterations),
        "commands": {
            name: {"neutral": unit.neutral, "scale": unit.scale, "as_is": unit.as_is}
            for name, unit in result.units.items()
        },
        "unexplained": [{"log": s.log, "begin_s": s.begin, "end_s": s.end, "what": s.what} for s in result.left_out],
        "wall_s": result.seconds,
        "warnings": list(identification.warnings),
        "notes": list(identification.notes),
        "vehicle_file": None if written is None else str(written),
        "next": None if result.next_drives is None else next_json(result.next_drives),
    }


def parameter_table(result: SysidResult) -> Table:
    """Table of the parameters with value, interval, initial value and unit."""
    heading = ("PARAMETER", "VALUE", f"95 % INTERVAL ({result.identification.interval})", "INITIAL", "UNIT", "MEANING")
    shown = result.identification.parameters.items()
    return heading, [_row(name, estimate) for name, estimate in shown if name not in result.identification.off]


def prediction_table(result: SysidResult) -> Table:
    """Table of open-loop errors after 1, 2 and 3 s, of held-out logs if there are any."""
    held_out = result.evaluation.held_out
    pair = held_out or result.evaluation.fitted
    whose = "held-out logs" if held_out else "fitted logs"
    heading = (f"OPEN LOOP, {whose}", *(f"{after:g} s" for after in HORIZONS), "all")
    after, before = pair.errors, pair.initial_errors
    return heading, [
        ("position, identified", *_metres(after)),
        ("position, initial", *_metres(before)),
        ("position, constant motion", *_metres(pair.constant_errors)),
        ("yaw, identified", *_degrees(after)),
        ("yaw, initial", *_degrees(before)),
        ("yaw, constant motion", *_degrees(pair.constant_errors)),
    ]


def model_table(trials: Sequence[ModelTrial]) -> Table:
    """Table of models that were compared, by the errors that `model_caption` describes."""
    if not trials:
        return (), []
    times = sorted({after for trial in trials for after in trial.errors})
    heading = ("MODEL", "TERMS", *(f"{after:g} s" for after in times), "")
    return heading, [
        (
            f"{trial.model}{_changed(trial)}",
            str(len(trial.terms)),
            *(_cell(trial.errors.get(after), 100, " cm") for after in times),
            "chosen" if trial.chosen else "",
        )
        for trial in trials
    ]


BY_MODEL: Final = (
    "chosen: the smallest mean of three numbers, the error after 1 s, half of that after 2 s and a third "
    "of that after 3 s, averaged over the logs"
)
BY_TERMS: Final = (
    "chosen: of the structures within one standard error of the best, or at most 4 % worse, the simplest; then with "
    "the terms that the likelihood of the poses shows"
)
"""What decides between the rows of a table of models, and of one of structures."""
TERMS_LEGEND: Final = (
    "TERMS: number of effects, such as friction or a lever, that the logs show and the model has beside those that it "
    "cannot do without; docs/sysid.md#terms explains each"
)
"""What a number in the column of terms counts."""
STEPS_CAPTION: Final = (
    "choice of terms: from the model with all of its terms on, one or several are switched off after another; each row "
    "has the terms that are still on, and errors on logs, or parts of them, that it was not fitted to"
)
"""What the rows of a table of structures are."""


def model_caption(result: SysidResult) -> str:
    """What the errors in the table of models are, and on which logs; the held-out logs test the chosen one alone."""
    logs, models = result.split.fitted, result.identification.models
    fitted = [trial.model for trial in models if trial.on_fitted]
    judged = "the fitted logs"
    if len(fitted) < len(models):
        judged = f"the {len(logs)} fitted logs, each predicted by a fit to the others"
        judged += f" (by {' and '.join(fitted)} by the fit to all of them)" if fitted else ""
    aside = "; the held-out logs have no part in the choice" if result.split.held_out else ""
    return f"models by the position error of open-loop predictions, mean of {judged}{aside}"


def choice_lines(trials: Sequence[ModelTrial], rule: str) -> list[str]:
    """The rule of a choice, where another row than the chosen one has a smaller error at some time; else nothing."""
    of_chosen = next((trial.errors for trial in trials if trial.chosen), {})
    better = any(trial.errors.get(after, math.inf) < error for trial in trials for after, error in of_chosen.items())
    return [rule] if better else []


def _changed(trial: ModelTrial) -> str:
    """Terms that were switched off or on again, as words after the name of a model."""
    if trial.added:
        return f" with {trial.added} again"
    return f" without {trial.without}" if trial.without else ""


def summary_lines(result: SysidResult) -> list[str]:
    """Lines below the tables."""
    identification = result.identification
    noise, origin = identification.noise, "measured from the logs" if identification.noise_measured else "as stated"
    state = "converged" if identification.converged else "NOT converged"
    why = INTERVALS[identification.interval]
    lines = [
        f"{state} after {counted(identification.iterations, 'iteration')}, {result.seconds:.2f} s; "
        f"intervals follow {why}",
        f"fitted to {used_text(result.split.fitted)}"
        + (f"; tested on {used_text(result.split.held_out)}" if result.split.held_out else ""),
        f"noise of the poses {1000 * noise.position:.3g} mm, {math.degrees(noise.yaw):.2g} deg, {origin}",
        *identification.notes,
    ]
    if identification.rear_axle is not None:
        lines.append(f"the tracked point is {identification.rear_axle:.3f} m ahead of the rear axle")
    return lines


def _parameter(estimate: ParameterEstimate, extra: bool) -> dict[str, Any]:
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


def _trial(trial: ModelTrial) -> dict[str, Any]:
    return {
        "model": trial.model,
        "terms": list(trial.terms),
        "without": trial.without or None,
        "added": trial.added or None,
        "position_m": {f"{after:g}": error for after, error in trial.errors.items()},
        "chosen": trial.chosen,
        "on_fitted": trial.on_fitted,
    }


def _errors(errors: PredictionErrors) -> dict[str, Any]:
    return {
        "position_m": {f"{after:g}": value for after, value in errors.position.items()},
        "yaw_rad": {f"{after:g}": value for after, value in errors.yaw.items()},
        "overall_position_m": errors.overall_position,
        "overall_yaw_rad": errors.overall_yaw,
        "windows": errors.windows,
    }


def _row(name: str, estimate: ParameterEstimate) -> tuple[str, ...]:
    digits = estimate.decimals
    low, high = (f"{value:.{digits}f}" for value in estimate.ci95)
    interval = "frozen" if estimate.frozen else f"{low} to {high}{estimate.interval_note}"
    value = f"{estimate.value:.{digits}f}"
    return name, value, interval, f"{estimate.initial:.{digits}f}", estimate.unit, estimate.description


def _metres(errors: PredictionErrors) -> list[str]:
    values = [errors.position.get(after) for after in HORIZONS]
    return [_cell(value, 100, " cm") for value in (*values, errors.overall_position)]


def _degrees(errors: PredictionErrors) -> list[str]:
    values = [errors.yaw.get(after) for after in HORIZONS]
    return [_cell(value, 180 / math.pi, " deg") for value in (*values, errors.overall_yaw)]


def _cell(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None else f"{factor * value:.2f}{unit}"
