"""`kraft sysid` without a terminal: from what was asked, by names and paths, to parameters, a file and a page."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from kraft.errors import InputError, KraftError, NegativeResult
from kraft.logs import Log, LogSet, load_mapping, read_logs
from kraft.plot.output import picture_format
from kraft.sysid import Identification, PredictionErrors, Settings, identify, prediction_errors
from kraft.sysid.holdout import Split, split
from kraft.sysid.options import Options, settings_of
from kraft.sysid.record import record_of
from kraft.sysid.subject import Subject, load_subject
from kraft.sysid.vehicle_file import check_target, write_vehicle
from kraft.sysid.verdict import objections

MODEL: Final = "mushr"


@dataclass(frozen=True)
class Request:
    """What was asked for, as it was written."""

    logs: tuple[Path, ...]
    model: str = MODEL
    holdout: float | None = None
    out: Path | None = None
    plot: Path | None = None
    mapping: Path | None = None
    options: Options = field(default_factory=Options)


@dataclass(frozen=True)
class Errors:
    """Prediction errors of the identified parameters and of those before: on the fitted logs, on those held out."""

    fitted: PredictionErrors
    fitted_before: PredictionErrors
    held_out: PredictionErrors | None
    held_out_before: PredictionErrors | None


@dataclass(frozen=True)
class Identified:
    """A request and what came of it; `objections` say why the parameters must not be used, if so."""

    request: Request
    subject: Subject
    logs: LogSet
    split: Split
    settings: Settings
    result: Identification
    errors: Errors
    objections: tuple[str, ...]
    seconds: float


def carry_out(request: Request, say: Callable[[str], None]) -> Identified:
    """Load, check, read, identify, predict, write, draw; `say` is told what was read and what takes long.

    A vehicle file is written only if there are no objections; the page is drawn in any case.

    Raises:
        InputError: with what is wrong with the request or the files it names.
        NegativeResult: if there are logs and none of them can be used.
    """
    subject = load_subject(request.model)
    settings = settings_of(request.options, subject.vehicle)
    if request.out is not None:
        check_target(request.out)
    if request.plot is not None:
        picture_format(request.plot)
    logs = _read(request, subject)
    _tell(logs, say)
    parted = split(logs.logs, request.holdout)
    say(parted.note)
    began = time.perf_counter()
    try:
        result = identify(subject.given, parted.fitted, settings)
        errors = _errors(subject, parted, result, settings)
    except KraftError as error:
        _draw_data(request, subject, parted, str(error))
        raise
    seconds = time.perf_counter() - began
    done = Identified(request, subject, logs, parted, settings, result, errors, objections(result), seconds)
    if request.plot is not None:
        from kraft.plot.sysid import plot_identification

        plot_identification(request.plot, subject.vehicle, parted, result, predicted(done))
    if request.out is not None and not done.objections:
        record = record_of(
            request.model, result, parted, errors.fitted, errors.held_out, errors.held_out_before
        )
        write_vehicle(request.out, subject, result.parameters, record)
    return done
