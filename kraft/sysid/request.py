"""`kraft sysid` without a terminal: from what was asked, by names and paths, to parameters, a file and a page."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from kraft.atomic_file import check_writable
from kraft.errors import InputError, NegativeResult
from kraft.logs.discover import discover
from kraft.logs.log import Log, LogSet
from kraft.logs.mapping import Mapping, load_mapping
from kraft.logs.reader import read_logs
from kraft.plot.output import picture_format
from kraft.sysid.compilation import ensure_compiled
from kraft.sysid.extras import moves
from kraft.sysid.forecast import Predicted, predicted
from kraft.sysid.holdout import Split, split
from kraft.sysid.identify import identify
from kraft.sysid.input import screened
from kraft.sysid.options import Options, settings_of
from kraft.sysid.record import record_of
from kraft.sysid.result import Identification
from kraft.sysid.setting_checks import check_settings
from kraft.sysid.settings import Settings
from kraft.sysid.subject import Subject, load_subject
from kraft.sysid.vehicle_file import check_target, write_vehicle
from kraft.sysid.verdict import objections

MODEL: Final = "mushr-lag"
Say = Callable[[str], None]


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
class Identified:
    """A request and what came of it.

    Attributes:
        request: what was asked for.
        subject: the vehicle before.
        logs: everything that was read.
        split: which of it was fitted and which held out.
        result: the parameters.
        predicted: what they predict, and what those before predicted.
        objections: why the parameters must not be used; empty if they may.
        seconds: that identifying took, without reading and predicting.
    """

    request: Request
    subject: Subject
    logs: LogSet
    split: Split
    result: Identification
    predicted: Predicted
    objections: tuple[str, ...]
    seconds: float


def carry_out(request: Request, say: Say, warn: Say) -> Identified:
    """Load, check, read, identify, predict, write, draw.

    A vehicle file is written only if there are no objections.  The page is drawn in any case; where nothing could be
    identified it shows the logs.

    Args:
        request: what to do.
        say: is told what was read and decided.
        warn: is told what is wrong with logs that are left out.

    Raises:
        InputError: with what is wrong with the request or the files it names, before anything is identified.
        NegativeResult: if there are logs, and none of them can be used.
    """
    subject = load_subject(request.model)
    settings = _checked(request, subject)
    logs = _read(request, subject, say, warn)
    parted = split(logs.logs, request.holdout)
    say(parted.note)
    ensure_compiled(subject.vehicle, say)
    began = time.perf_counter()
    try:
        result = identify(subject.given, parted.fitted, settings)
        seconds = time.perf_counter() - began
        found = predicted(subject.given, parted, result, settings)
        result = replace(
            result,
            warnings=(*result.warnings, *found.warnings, *_unknown_to_planning(request, result)),
            notes=(*result.notes, *_for_planning(settings)),
        )
    except InputError as error:  # of the logs: everything else was checked
        _draw_logs(request, subject, parted, error)
        _warn(error, warn)
        raise NegativeResult("the parameters cannot be identified from these logs") from None
    done = Identified(request, subject, logs, parted, result, found, objections(result, found), seconds)
    _draw(done)
    _write(done)
    return done


def _checked(request: Request, subject: Subject) -> Settings:
    """The settings, after everything that can be wrong before the logs are read."""
    settings = settings_of(request.options)
    check_settings(subject.given, settings)
    if request.out is not None:
        check_target(request.out)
        if settings.extras == "auto":
            settings = replace(settings, extras="plan")
    if request.plot is not None:
        picture_format(request.plot)
        check_writable(request.plot)
    return settings


def _for_planning(settings: Settings) -> tuple[str, ...]:
    """That delays and dead bands were not looked for."""
    if settings.extras != "plan":
        return ()
    return ("for a file to plan with, no delay or dead band is identified: planning does not know them",)


def _unknown_to_planning(request: Request, result: Identification) -> tuple[str, ...]:
    """That a file to plan with lacks what the vehicle was asked to be identified with."""
    extras = [name for name in result.extras if moves(name)]
    if request.out is None or not extras:
        return ()
    return (
        f"planning does not know {', '.join(extras)}, and {request.out} is off by as much: for a file to plan with, "
        "leave them out of --extras, --param and --freeze",
    )


def _read(request: Request, subject: Subject, say: Say, warn: Say) -> LogSet:
    """Read every log, and say what it was taken for and what was found in it."""
    mapping = Mapping() if request.mapping is None else load_mapping(request.mapping)
    controls = tuple(subject.vehicle.controls)
    candidates, _ = discover(request.logs, controls, mapping)
    try:
        found = read_logs(request.logs, controls, mapping)
    except InputError as error:
        if not candidates:
            raise
        _warn(error, warn)
        raise _none_usable(len(candidates)) from None
    long = screened(found.logs)
    _tell(long.logs, say)
    for shortened in long.shortened:
        say(shortened)
    for problem in (*found.problems, *long.problems):
        warn(f"left out: {problem}")
    if not long.logs:
        raise _none_usable(len(candidates))
    return LogSet(long.logs, (*found.problems, *long.problems))


def _none_usable(count: int) -> NegativeResult:
    return NegativeResult("the only log cannot be used" if count == 1 else f"none of the {count} logs can be used")


def _warn(error: InputError, warn: Say) -> None:
    for diagnostic in error.diagnostics:
        warn(str(diagnostic))


def _tell(logs: Sequence[Log], say: Say) -> None:
    """Say what was taken for what, once for logs of one kind, and what was found."""
    kinds: dict[str, list[str]] = {}
    for log in logs:
        kinds.setdefault(log.guess, []).append(log.name)
    for guess, names in kinds.items():
        whose = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        say(f"{whose}: {guess}")
    for log in logs:
        for finding in log.findings:
            say(f"{log.name}: {finding}")


def _draw(done: Identified) -> None:
    if done.request.plot is not None:
        from kraft.plot.sysid import plot_identification

        plot_identification(
            done.request.plot, done.subject.vehicle, done.split, done.result, done.predicted, done.objections
        )


def _draw_logs(request: Request, subject: Subject, parted: Split, error: InputError) -> None:
    if request.plot is not None:
        from kraft.plot.sysid_logs import plot_logs

        why = f"{error.diagnostics[0].file} {error.diagnostics[0].problem}"
        plot_logs(request.plot, subject.vehicle, (*parted.fitted, *parted.held_out), why)


def _write(done: Identified) -> None:
    request = done.request
    if request.out is not None and not done.objections:
        record = record_of(request.model, done.result, done.split, done.predicted)
        write_vehicle(request.out, done.subject, done.result.parameters, record)
