"""Acceptance of an identification: open-loop prediction before and after it, and objections to its parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import InputError
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import (
    CORRELATION_INDISTINGUISHABLE,
    Identification,
    Noise,
    PredictionErrors,
    Settings,
    correlations,
)
from kraft.sysid.parallel import in_parallel
from kraft.sysid.prediction import (
    HORIZONS,
    Window,
    constant_windows,
    predict_windows,
    window_errors,
)
from kraft.text import counted
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.identification_record import SpeedPrediction
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


SIMILAR_ERROR_RATIO: Final = 1.01
"""Ratio of position errors up to which they count as equal, as when the initial values come from the same logs."""
WORSE_ERROR_RATIO: Final = 1.2
"""Ratio of position errors from which a vehicle file that exists is better; less can be chance."""
USELESS_RATIO = 1.2
"""Position error over that of constant motion from which on a model is refused; 1 if a parameter is at its bound."""
USELESS_YAW_RATIO, USELESS_YAW = 1.5, 0.1
"""The same for the yaw, of which errors below `USELESS_YAW` rad are noise."""
EXCESSIVE_ERROR_RATIO: Final = 1.5
"""Ratio of position errors from which the identified values are rejected.  Values from five logs of the bundled car,
beside initial values from forty, are up to 1.2 times worse by chance.  A test of the scatter between windows would also
reject small but steady differences, and needs more windows than a few held-out logs have."""


SPEED_CLASSES, CLASS_WINDOWS_MIN = 3, 10
"""Most classes of speeds for prediction errors, and the least number of windows in one of several."""


@dataclass(frozen=True)
class PredictionPair:
    """Windows of the same logs, predicted with the identified and the initial parameters, and without a model."""

    identified: tuple[Window, ...]
    initial: tuple[Window, ...]
    constant: tuple[Window, ...]
    """with constant speed and turning rate"""

    @cached_property
    def errors(self) -> PredictionErrors:
        """Errors with the identified parameters."""
        return window_errors(self.identified)

    @cached_property
    def initial_errors(self) -> PredictionErrors:
        """Errors with the initial parameters."""
        return window_errors(self.initial)

    @cached_property
    def constant_errors(self) -> PredictionErrors:
        """Errors with constant speed and turning rate."""
        return window_errors(self.constant)


ODD_LOGS_MIN: Final = 4
"""Least number of logs of which one may be told to be odd."""
ODD_TO_NEXT, ODD_TO_MEDIAN, ODD_SHARE = 2.0, 3.0, 0.02
"""Error of an odd log over that of the next one and over the median, and as a share of the way, at least."""
PATH_MIN: Final = 0.1
"""Least path of a window whose error is compared with it, m."""


@dataclass(frozen=True)
class PredictionEvaluation:
    """Predictions of the fitted logs, and of the held-out logs if any of them can be predicted.

    Attributes:
        fitted: predictions of the fitted logs.
        held_out: predictions of the held-out logs; None if there are none or none can be predicted.
        warnings: that the initial values predict better, or that held-out logs cannot be predicted.
    """

    fitted: PredictionPair
    held_out: PredictionPair | None
    warnings: tuple[str, ...] = ()


def errors_by_speed(windows: Sequence[Window]) -> tuple[SpeedPrediction, ...]:
    """Errors of windows of a second or more, in classes of equally many from slow to fast; in one if there are few."""
    long = [w for w in windows if _reached(w, HORIZONS[0]) is not None]
    if not long:
        return ()
    paths = np.array([np.hypot(*np.diff(w.poses[:, :2], axis=0).T).sum() for w in long])
    speeds: Floats = paths / np.array([w.times[-1] - w.times[0] for w in long])
    order = np.argsort(speeds, kind="stable")
    classes = np.array_split(order, min(SPEED_CLASSES, max(1, len(long) // CLASS_WINDOWS_MIN)))
    return tuple(_speed_errors([long[k] for k in own], speeds[own]) for own in classes)


def _reached(window: Window, after: float) -> int | None:
    """Index of the pose `after` s after the beginning of a window; None if there is none."""
    since = np.abs(window.times - window.times[0] - after)
    k = int(np.argmin(since))
    return k if since[k] <= 0.75 * float(np.median(np.diff(window.times))) else None


def _speed_errors(windows: Sequence[Window], speeds: Floats) -> SpeedPrediction:
    """Errors of windows with similar speeds (windows,), as far as they reach."""
    errors = {}
    for after in HORIZONS:
        found = [(w, k) for w in windows if (k := _reached(w, after)) is not None]
        off = np.array([w.predicted[k] - w.poses[k] for w, k in found]).reshape(-1, 3)
        yaw = np.array([w.poses[k, 2] for w, k in found])
        along = off[:, 0] * np.cos(yaw) + off[:, 1] * np.sin(yaw)
        across = off[:, 1] * np.cos(yaw) - off[:, 0] * np.sin(yaw)
        if found:
            errors[after] = np.sqrt(np.mean(np.square([along, across, off[:, 2]]), axis=1))
    along, across, turned = (tuple(map(float, each)) for each in zip(*errors.values(), strict=True))
    extremes = float(speeds.min()), float(speeds.max())
    return SpeedPrediction(
        speeds=extremes, windows=len(windows), after=tuple(errors), along=along, across=across, yaw=turned
    )


def evaluate_predictions(
    vehicle: VehicleConfig | Vehicle, log_split: LogSplit, result: Identification, settings: Settings
) -> PredictionEvaluation:
    """Predict every log with the identified and with the initial parameters.

    Held-out logs that cannot be predicted do not invalidate the fit; a warning reports that it was not tested.

    Raises:
        InputError: if the fitted logs are too short to predict anything.
    """
    settings = result.predicting(settings)

    def pair(logs: tuple[Log, ...]) -> PredictionPair:
        identified, initial = in_parallel(
            lambda values: predict_windows(vehicle, logs, values, settings), (result.values, {})
        )
        return PredictionPair(identified, initial, constant_windows(vehicle, logs, settings))

    fitted = pair(log_split.fitted)
    if not log_split.held_out:
        return PredictionEvaluation(fitted, None, fitted_warnings(fitted, result.noise))
    try:
        unseen = pair(log_split.held_out)
    except InputError as error:
        why = "; ".join(f"{problem.file} {problem.problem}" for problem in error.diagnostics)
        warning = (
            f"the fit is not tested: {counted(len(log_split.held_out), 'held-out log')} cannot be predicted ({why})"
        )
        return PredictionEvaluation(fitted, None, (warning, *fitted_warnings(fitted, result.noise)))
    return PredictionEvaluation(
        fitted, unseen, (*prediction_warnings(unseen, result.noise), *_unpredicted(log_split.held_out, unseen))
    )


def fitted_warnings(pair: PredictionPair, noise: Noise) -> tuple[str, ...]:
    """The warning that the identified values predict not even the logs that they were fitted to, if so."""
    if not _predicts_worse(pair, noise):
        return ()
    return (
        f"the identified values predict even the fitted logs no better than the initial values do ({_errors(pair)}): "
        "these logs do not show the parameters, or the model lacks an effect",
    )


def _unpredicted(logs: tuple[Log, ...], pair: PredictionPair) -> tuple[str, ...]:
    """The warning that some logs are too short for a window, if any are."""
    predicted = {window.log for window in pair.identified}
    missed = [log.name for log in logs if log.name not in predicted]
    return (f"held-out logs too short to be predicted: {', '.join(missed)}",) if missed else ()


def odd_log_warning(evaluation: PredictionEvaluation) -> tuple[str, ...]:
    """The warning that one log is predicted far worse than any other, if so: it may be of another car, or changed."""
    held_out = evaluation.held_out.identified if evaluation.held_out else ()
    shares: dict[str, list[float]] = {}
    for window in (*evaluation.fitted.identified, *held_out):
        k = _reached(window, HORIZONS[0])
        path = 0.0 if k is None else float(np.hypot(*np.diff(window.poses[: k + 1, :2], axis=0).T).sum())
        if path >= PATH_MIN:
            off = (window.predicted - window.poses)[k, :2]
            shares.setdefault(window.log, []).append(float(np.hypot(*off)) / path)
    errors = sorted((float(np.median(found)), name) for name, found in shares.items())
    if len(errors) < ODD_LOGS_MIN:
        return ()
    (worst, name), (next_worst, _), (median, _) = errors[-1], errors[-2], errors[(len(errors) - 1) // 2]
    if worst < max(ODD_TO_NEXT * next_worst, ODD_TO_MEDIAN * median, ODD_SHARE):
        return ()
    return (
        f"{name} is predicted worse than any other log: after 1 s by {100 * worst:.1f} % of the way, the others by at "
        f"most {100 * next_worst:.1f} %; if another car, floor, load or battery drove it, leave it out",
    )


def prediction_warnings(pair: PredictionPair, noise: Noise) -> tuple[str, ...]:
    """The warning that the identified values predict no better than the initial ones, if so."""
    after, constant = pair.errors.overall_position, pair.constant_errors.overall_position
    useless = (
        f"the model is useless for prediction: constant speed and turning rate predict held-out logs as well (position "
        f"{100 * constant:.2f} cm, the model {100 * after:.2f} cm)",
    ) if after >= constant else ()  # fmt: skip
    if not _predicts_worse(pair, noise):
        return useless
    return (
        *useless,
        f"the identified values predict held-out logs no better than the initial values do ({_errors(pair)}): "
        "exclude logs of another floor, slope, load or car, record more logs, or choose a model with the missing "
        "effect",
    )


def useless_objections(identification: Identification, pair: PredictionPair) -> list[str]:
    """The objection that constant speed and turning rate predict better over the longest time, if so."""
    now, constant = pair.errors, pair.constant_errors
    times = now.position.keys() & constant.position.keys()
    if not times:
        return []
    after = max(times)
    allowed = 1.0 if any(p.at_bound for p in identification.parameters.values()) else USELESS_RATIO
    lost = now.position[after] >= allowed * constant.position[after]
    turned = now.yaw[after] >= max(USELESS_YAW_RATIO * constant.yaw[after], USELESS_YAW)
    if not lost and not turned:
        return []
    errors = [f"{100 * e.position[after]:.3g} cm, {math.degrees(e.yaw[after]):.3g} deg" for e in (now, constant)]
    return [
        f"constant speed and turning rate predict better than the model (after {after:g} s {errors[1]}, the model "
        f"{errors[0]}): are the sides, the axes or the marker turned or mirrored?"
    ]


def prediction_objections(evaluation: PredictionEvaluation) -> tuple[str, ...]:
    """The objection that the initial values predict far better, as part of a sentence, if so.

    It is about the held-out logs, or, if there are no predictions of these, about the fitted ones.
    """
    pair = evaluation.held_out or evaluation.fitted
    if _ratio(pair) < EXCESSIVE_ERROR_RATIO:
        return ()
    which = "held-out logs" if evaluation.held_out else "even the fitted logs"
    return (f"{which} are predicted far better with the initial values ({_errors(pair)})",)


def _predicts_worse(pair: PredictionPair, noise: Noise) -> bool:
    """Whether the identified values predict worse than the initial ones, by more than the noise of a pose hides.

    Initial values that are right predict held-out logs best: others differ from them by what the noise of the fitted
    logs does to the values.  An error that is added to those of the initial values adds its square to theirs.
    """
    after, before = pair.errors.overall_position, pair.initial_errors.overall_position
    if not math.isfinite(after):
        return True
    added = math.sqrt(max(after**2 - before**2, 0.0)) if math.isfinite(before) else 0.0
    return _ratio(pair) > SIMILAR_ERROR_RATIO and added > math.sqrt(2.0) * noise.position  # which is that in x and in y


def _ratio(pair: PredictionPair) -> float:
    """Position error of the identified values over that of the initial values."""
    after, before = pair.errors.overall_position, pair.initial_errors.overall_position
    return after / max(before, 1e-12)


def _errors(pair: PredictionPair) -> str:
    after, before = pair.errors.overall_position, pair.initial_errors.overall_position
    return f"position {100 * after:.2f} cm identified, {100 * before:.2f} cm initial"


def replacement_objections(
    before: VehicleConfig, file: str, held_out: tuple[Log, ...], evaluation: PredictionEvaluation, settings: Settings
) -> tuple[str, ...]:
    """The objection that the vehicle file that would be replaced predicts the held-out logs better, if so.

    Args:
        before: the vehicle in the file, with the record of its identification.
        file: name of the file.
        held_out: logs with commands as that vehicle takes them.
        evaluation: predictions of the same logs.
        settings: as for the evaluation.

    Raises:
        InputError: if that vehicle cannot predict the logs.
    """
    if evaluation.held_out is None:
        return ()
    extras = before.identification.extras if before.identification else {}
    values = {name: extra.value for name, extra in extras.items()}
    earlier = window_errors(predict_windows(before, held_out, values, replace(settings, values={}, frozen=())))
    now = evaluation.held_out.errors.overall_position
    if not WORSE_ERROR_RATIO * earlier.overall_position < now:  # nor if it diverges with these commands (nan)
        return ()
    sizes = f"position {100 * now:.2f} cm identified, {100 * earlier.overall_position:.2f} cm with the file"
    return (f"held-out logs are predicted better with {file} as it is ({sizes})",)


def objections(identification: Identification, evaluation: PredictionEvaluation) -> tuple[str, ...]:
    """Reasons why the parameters are not identified, as parts of a sentence; empty if they are identified."""
    found = [] if identification.converged else ["the fit did not converge"]
    if not identification.names:
        found.append("every parameter of the model is frozen, and the data show no auxiliary parameter")
    if identification.trials or identification.models:  # the model, or its terms, were chosen by what they predict
        found += useless_objections(identification, evaluation.held_out or evaluation.fitted)
    if identification.trials:  # then single parameters need not be known
        return (*found, *prediction_objections(evaluation))
    unidentified = [name for name in identification.unidentified if name not in identification.auxiliary]
    if unidentified:
        found.append(f"the logs do not identify {', '.join(unidentified)}")
    found += [f"{a} and {b} are indistinguishable" for a, b in _pairs(identification)]
    return (*found, *prediction_objections(evaluation))


def _pairs(identification: Identification) -> list[tuple[str, str]]:
    """Pairs of parameters that are indistinguishable under the stated noise, however much the logs differ."""
    names, size = identification.names, np.abs(correlations(identification.graph_covariance))
    rows, columns = np.nonzero(np.triu(size > CORRELATION_INDISTINGUISHABLE, 1))
    return [(names[i], names[j]) for i, j in zip(rows, columns, strict=True)]
