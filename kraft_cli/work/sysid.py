"""`kraft sysid` without a terminal: from what was asked, by names and paths, to parameters, a file and a page."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

from kraft.errors import Diagnostic, InputError, NegativeResult
from kraft.files import check_all, check_writable
from kraft.logs.discover import discover
from kraft.logs.log import Log, LogSet
from kraft.logs.mapping import Mapping, load_mapping
from kraft.logs.reader import UnfitError, read_logs
from kraft.plot.style import picture_format
from kraft.sysid.compilation import ensure_compiled
from kraft.sysid.data import Split, screened, split
from kraft.sysid.identify import identify
from kraft.sysid.parameters import moves
from kraft.sysid.prediction import Predicted, objections, predicted
from kraft.sysid.result import Identification
from kraft.sysid.selection import check_free, check_settings, not_sought
from kraft.sysid.settings import Extras, Noise, Settings
from kraft.sysid.vehicle_file import Subject, check_target, load_subject, record_of, write_vehicle
from kraft.text import suggestion
from kraft_cli.work.parameters import parse_parameters
from kraft_cli.work.verbose import discard_message

MODEL: Final = "mushr-lag"


@dataclass(frozen=True)
class Options:
    """Options as they were written; names may stand in one text with commas, `values` are ``name=value``."""

    freeze: tuple[str, ...] = ()
    extras: str = "auto"
    graph: str = "fast"
    pose_noise: str | None = None
    values: tuple[str, ...] = ()


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


def carry_out(request: Request, say: Say, warn: Say, detail: Say = discard_message) -> Identified:
    """Load, check, read, identify, predict, write, draw.

    A vehicle file is written only if there are no objections.  The page is drawn in any case; where nothing could be
    identified it shows the logs.

    Args:
        request: what to do.
        say: is told what was read and decided.
        warn: is told what is wrong with logs that are left out.
        detail: is told where in which log that was found of which `say` gets a sum.

    Raises:
        InputError: with what is wrong with the request or the files it names, before anything is identified.
        NegativeResult: if there are logs, and none of them can be used.
    """
    subject = load_subject(request.model)
    settings = _checked(request, subject)
    logs = read(request.logs, request.mapping, tuple(subject.vehicle.controls), say, warn, detail)
    parted = split(logs.logs, request.holdout)
    say(parted.note)
    ensure_compiled(subject.vehicle, subject.reference, say)
    began = time.perf_counter()
    try:
        result = identify(subject.given, parted.fitted, settings, Pace(say))
        seconds = time.perf_counter() - began
        found = predicted(subject.given, parted, result, settings)
        result = replace(
            result,
            warnings=(*result.warnings, *found.warnings, *_unknown_to_planning(request, result)),
            notes=(*result.notes, *_for_planning(subject, settings)),
        )
    except InputError as error:  # of the logs: everything else was checked
        _draw_logs(request, subject, parted, error)
        explain(error, warn)
        raise NegativeResult("the parameters cannot be identified from these logs") from None
    done = Identified(request, subject, logs, parted, result, found, objections(result, found), seconds)
    _draw(done)
    _write(done)
    return done


def _checked(request: Request, subject: Subject) -> Settings:
    """The settings, after everything that can be wrong before the logs are read."""
    check_all(
        lambda: _check_settings(request, subject),
        lambda: None if request.out is None else check_target(request.out),
        lambda: None if request.plot is None else _check_picture(request.plot),
    )
    return _settings(request)


def _settings(request: Request) -> Settings:
    """What the options mean; a file is for planning."""
    settings = settings_of(request.options)
    if request.out is not None and settings.extras == "auto":
        return replace(settings, extras="plan")
    return settings


def _check_settings(request: Request, subject: Subject) -> None:
    """Refuse options that cannot be read, do not fit the vehicle, or leave nothing to identify."""
    settings = _settings(request)
    check_settings(subject.given, settings)
    check_free(subject.given, settings)


def _check_picture(path: Path) -> None:
    """Refuse a name and a place that no picture can have."""
    picture_format(path)
    check_writable(path)


def _for_planning(subject: Subject, settings: Settings) -> tuple[str, ...]:
    """That extras of the motion were not looked for; those that were asked for are none of these."""
    names = not_sought(subject.vehicle, settings)
    return (f"not sought, for planning does not know them: {', '.join(names)}",) if names else ()


def _unknown_to_planning(request: Request, result: Identification) -> tuple[str, ...]:
    """That a file to plan with lacks what the vehicle was asked to be identified with, unless that is nothing."""
    extras = [name for name in result.extras if moves(name) and not result.parameters[name].nothing]
    if request.out is None or not extras:
        return ()
    return (
        f"planning does not know {', '.join(extras)}, and {request.out} is off by as much: for a file to plan with, "
        "leave them out of --extras, --param and --freeze",
    )


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


GRAPHS: Final[tuple[Literal["fast", "paper"], ...]] = ("fast", "paper")


def settings_of(options: Options) -> Settings:
    """Make settings of what was written; whether the names exist depends on the vehicle and is checked there.

    Raises:
        InputError: with every option that cannot be read.
    """
    problems: list[Diagnostic] = []
    noise, values = None, {}
    try:
        values = parse_parameters(options.values)
    except InputError as error:
        problems += error.diagnostics
    if options.pose_noise is not None:
        noise = _noise(options.pose_noise, problems)
    graph = next((known for known in GRAPHS if known == options.graph), None)
    if graph is None:
        problems.append(Diagnostic("--graph", f"is {options.graph!r}", suggestion(options.graph, GRAPHS)))
    if problems or graph is None:
        raise InputError(problems)
    frozen, extras = _names(options.freeze), _extras(options.extras)
    return Settings(noise=noise, frozen=frozen, values=values, extras=extras, graph=graph)


def _extras(text: str) -> Extras:
    match _names((text,)):
        case ("auto",):
            return "auto"
        case ("plan",):
            return "plan"
        case ("none",):
            return "none"
        case names:
            return names


def _names(texts: Sequence[str]) -> tuple[str, ...]:
    parts = (part.strip() for text in texts for part in text.split(","))
    return tuple(dict.fromkeys(part for part in parts if part))


def _noise(text: str, problems: list[Diagnostic]) -> Noise | None:
    try:
        position, yaw = map(float, text.split(","))
    except ValueError:
        position = yaw = math.nan
    if 0.0 < position < math.inf and 0.0 < yaw < math.inf:
        return Noise(position, yaw)
    expected = "expected standard deviations of position (m) and yaw (rad), as in 0.01,0.02"
    problems.append(Diagnostic("--pose-noise", f"is {text!r}", expected))
    return None


EVERY: Final = 2.0
"""Least time between two remarks, and before the first one, s."""


class Pace:
    """Tells iterations to `say`, now and then."""

    def __init__(self, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin to wait."""
        self._say, self._clock, self._last = say, clock, clock()

    def __call__(self, iterations: int, cost: float) -> None:
        """Hear how many iterations were made, and what the point costs."""
        now = self._clock()
        if now - self._last >= EVERY:
            self._last = now
            self._say(f"iteration {iterations}, cost {cost:.6g}")


Say = Callable[[str], None]
HARMLESS: Final = {
    "wrap": "yaw wraps; made continuous, nothing is left out",
    "dropout": "poses are missing here and there; nothing is left out",
}
"""Findings of logs that cost nothing, by kind, and what is said of several logs with one."""


def read(
    paths: Sequence[Path], mapping_file: Path | None, controls: Sequence[str], say: Say, warn: Say, detail: Say
) -> LogSet:
    """Read every log, and say what it was taken for and what was found in it.

    Args:
        paths: files and folders with logs.
        mapping_file: which column is what, if that is said.
        controls: of the vehicle.
        say: is told what was taken for what and what was found.
        warn: is told what is wrong with logs that are left out.
        detail: is told where that was found of which `say` gets a sum.

    Raises:
        InputError: if there are no logs, or mapping file or controls fit none of them.
        NegativeResult: if there are logs, and none of them can be used.
    """
    mapping = Mapping() if mapping_file is None else load_mapping(mapping_file)
    try:
        found = read_logs(paths, controls, mapping)
    except UnfitError:
        raise
    except InputError as error:
        candidates, _ = discover(paths, controls, mapping)
        if not candidates:
            raise
        explain(error, warn)
        raise _none_usable(len(candidates)) from None
    long = screened(found.logs)
    _tell(long.logs, say, detail)
    for shortened in long.shortened:
        say(shortened)
    for problem in (*found.problems, *long.problems):
        warn(f"left out: {problem}")
    if not long.logs:
        raise _none_usable(len(discover(paths, controls, mapping)[0]))
    return LogSet(long.logs, (*found.problems, *long.problems))


def _none_usable(count: int) -> NegativeResult:
    return NegativeResult("the only log cannot be used" if count == 1 else f"none of the {count} logs can be used")


def explain(error: InputError, warn: Say) -> None:
    """Tell every problem."""
    for diagnostic in error.diagnostics:
        warn(str(diagnostic))


def _tell(logs: Sequence[Log], say: Say, detail: Say) -> None:
    """Say what was taken for what, once for logs of one kind, and what was found; what is harmless is summed up."""
    kinds: dict[str, list[str]] = {}
    for log in logs:
        kinds.setdefault(log.guess, []).append(log.name)
    for guess, names in kinds.items():
        whose = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        say(f"{whose}: {guess}")
    found = [(log.name, finding) for log in logs for finding in log.findings]
    often = Counter(finding.kind for _, finding in found)
    for kind, what in HARMLESS.items():
        if often[kind] > 1:
            say(f"{often[kind]} logs: {what} (-v tells where)")
    for name, finding in found:
        tell = detail if finding.kind in HARMLESS and often[finding.kind] > 1 else say
        tell(f"{name}: {finding}")
