"""`kraft sysid` without a terminal: from the request to identified parameters, a vehicle file and a page."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from kraft.errors import Code, Diagnostic, InputError, NegativeResult, Problems
from kraft.files import check_all
from kraft.logs.discover import check_paths
from kraft.logs.log import Log, LogSet
from kraft.logs.mapping import load_mapping
from kraft.sysid.acceptance import (
    PredictionEvaluation,
    evaluate_predictions,
    objections,
    replacement_objections,
)
from kraft.sysid.base_vehicle import (
    BaseVehicle,
    for_sides,
    load_base_vehicle,
    with_recorded,
    with_recorded_commands,
    with_speed,
)
from kraft.sysid.checks import SteeringInMotion
from kraft.sysid.command_units import SIDES, CommandUnit, command_units, sign_warnings, unit_notes, with_units
from kraft.sysid.data import LogSplit, check_holdout, split_logs
from kraft.sysid.factor_graph import ensure_compiled
from kraft.sysid.identify import identify
from kraft.sysid.interface import GRAPHS, AuxiliarySelection, Identification, Noise, Settings
from kraft.sysid.model_choice import identify_car, models_of_cars
from kraft.sysid.parameters import is_unknown_to_planning
from kraft.sysid.screening import check_consistency, two_cars
from kraft.sysid.selection import check_free_parameters, check_settings, excluded_for_planning
from kraft.sysid.terms import check_controls, has_terms
from kraft.sysid.unexplained import Stretch, unexplained_stretches, without
from kraft.sysid.vehicle_file import check_vehicle_target, identification_record, write_vehicle
from kraft.text import counted, suggestion
from kraft.vehicles import is_car
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.work.next_drives import NextDrives, NextRequest, check_next, next_drives
from kraft_cli.work.parameters import parse_parameters
from kraft_cli.work.sysid_logs import MessageSink, has_two_sides, read_sysid_logs, report_problems
from kraft_cli.work.verbose import discard_message

AUTO: Final = "auto"
"""Model whose terms are chosen by what they predict."""
TWO_SIDES: Final = "differential"
"""Model with terms of a robot with two driven sides."""
HORIZON_MIN, HORIZON_MAX = 0.5, 10.0
PROGRESS_INTERVAL: Final = 2.0
"""Least time between two progress messages, and before the first one, s."""
OPTIONS: Final = {"auxiliary": "extras", "frozen": "freeze", "values": "param"}
"""Options of the command for fields of `Settings` that have another name."""


@dataclass(frozen=True)
class SysidRequest:
    """Arguments and options of the command, as written.

    Attributes:
        logs: files and folders with logs.
        model: `auto`, a bundled vehicle, a vehicle file or code.
        holdout: fraction of the logs to hold out; None for the default.
        out: vehicle file to write.
        plot: page to draw.
        mapping: mapping file.
        freeze: names of parameters, separated by commas.
        extras: which auxiliary parameters: `auto`, `plan`, `none`, or names separated by commas.
        graph: form of the factor graph, one of `GRAPHS`.
        pose_noise: standard deviations of position (m) and yaw (rad), as in ``0.01,0.02``.
        param: initial values, each as ``name=value``.
        horizon: time over which a model with terms to choose is to predict well, s.
        next: number of drives to recommend; None for none.
        area: free area for them, as in ``6,4``; None for that of the logs.
        commands: new folder for their commands.
    """

    logs: tuple[Path, ...]
    model: str = AUTO
    holdout: float | None = None
    out: Path | None = None
    plot: Path | None = None
    mapping: Path | None = None
    freeze: tuple[str, ...] = ()
    extras: str = "auto"
    graph: str = "fast"
    pose_noise: str | None = None
    param: tuple[str, ...] = ()
    horizon: float = 3.0
    next: int | None = None
    area: str | None = None
    commands: Path | None = None


@dataclass(frozen=True)
class SysidResult:
    """A request and its result.

    Attributes:
        request: the request.
        base: the vehicle before the identification.
        logs: all logs that were read.
        split: the fitted and the held-out logs.
        identification: the identified parameters.
        evaluation: prediction errors with the identified and with the initial values.
        objections: reasons why the parameters must not be used; empty if they may be used.
        seconds: duration of the identification, without reading and predicting.
        units: found meaning of the numbers of each command; empty for a model whose commands have units.
        left_out: stretches of logs that no model explains.
        next_drives: recommended drives, if they were requested.
        next_error: why no drives can be recommended, though they were requested.
    """

    request: SysidRequest
    base: BaseVehicle
    logs: LogSet
    split: LogSplit
    identification: Identification
    evaluation: PredictionEvaluation
    objections: tuple[str, ...]
    seconds: float
    units: Mapping[str, CommandUnit]
    left_out: tuple[Stretch, ...]
    next_drives: NextDrives | None = None
    next_error: InputError | NegativeResult | None = None


def run_sysid(
    request: SysidRequest, info: MessageSink, warn: MessageSink, detail: MessageSink = discard_message
) -> SysidResult:
    """Load, check, read, identify, predict, write, draw.

    A vehicle file is written only if there are no objections.  The page is drawn in any case; where nothing could be
    identified it shows the logs.

    Args:
        request: arguments and options.
        info: receives what was read and decided.
        warn: receives problems of logs that are left out.
        detail: receives the place of each finding that `info` receives as a sum.

    Raises:
        InputError: with every problem of the request or of the files it names, before anything is identified.
        NegativeResult: if there are logs, and none of them can be used.
    """
    base, settings = _checked(request)
    any_unit = request.model == AUTO
    auto = any_unit and is_car(base.vehicle)
    controls = tuple(base.vehicle.controls)
    logs = read_sysid_logs(request.logs, request.mapping, controls, info, warn, detail, any_command_unit=any_unit)
    split = split_logs(logs.logs, request.holdout)
    info(split.note)
    units = command_units(split.fitted) if any_unit else {}
    recorded = split.held_out
    split = replace(split, fitted=with_units(split.fitted, units), held_out=with_units(split.held_out, units))
    try:
        if auto or has_terms(base.definition):  # before drives that a constant does not explain are taken for two cars
            check_controls(split.fitted, SteeringInMotion.of(split.fitted))
        check_consistency(split.fitted)
        split, left_out = _without_unexplained(split, info)
        ensure_compiled(base.vehicle, base.reference, info)
        began = time.perf_counter()
        if auto:
            base, identification, split, units = _identify_car(split, units, settings, info)
        else:
            identification = identify(base.definition, split.fitted, settings, ProgressReporter(info, base.name))
            if has_terms(base.definition) and set(controls) == set(SIDES):
                used = (*split.fitted, *split.held_out)
                base = with_speed(for_sides(base, used), identification, used)
        seconds = time.perf_counter() - began
        evaluation = evaluate_predictions(base.definition, split, identification, settings)
    except InputError as error:  # a problem of the logs: everything else was checked
        _draw_logs(request, base, split, error)
        report_problems(error, warn)
        raise NegativeResult("the parameters cannot be identified from these logs", error.diagnostics) from None
    unknown = (
        *_untested(split, left_out),
        *_of_two_cars(split),
        *_unknown_to_planning(request, identification),
    )
    excluded = () if has_terms(base.definition) else _excluded_note(base, settings)
    base, taken_over = with_recorded(base, logs.logs) if request.out is not None else (base, "")
    identification = replace(
        identification,
        warnings=(*identification.warnings, *sign_warnings(units), *evaluation.warnings, *unknown),
        notes=(
            *identification.notes,
            *unit_notes(units),
            *excluded,
            *_preview_note(request, identification),
            *((taken_over,) if taken_over else ()),
        ),
    )
    found = objections(identification, evaluation)
    if request.out is not None and request.out.exists() and not found:
        found = _earlier_objections(request.out, without(recorded, left_out), controls, evaluation, settings)
    result = SysidResult(request, base, logs, split, identification, evaluation, found, seconds, units, left_out)
    _draw(result)
    _write(result)
    return result if request.next is None else _with_next_drives(result, request.next, settings, info)


def _without_unexplained(split: LogSplit, info: MessageSink) -> tuple[LogSplit, tuple[Stretch, ...]]:
    """The logs without the stretches that no model explains, and these, which `info` receives."""
    left_out = unexplained_stretches((*split.fitted, *split.held_out))
    for stretch in left_out:
        info(f"left out, because no model explains it: {stretch}")
    fitted, held_out = without(split.fitted, left_out), without(split.held_out, left_out)
    return replace(split, fitted=fitted, held_out=held_out), left_out


def _with_next_drives(result: SysidResult, count: int, settings: Settings, info: MessageSink) -> SysidResult:
    """The result with `count` recommended drives, or with the reason why there are none."""
    wanted = NextRequest(count, result.request.area, result.request.commands)
    try:
        planned = next_drives(
            wanted, result.base, result.identification, settings, result.logs.logs, result.units, info
        )
    except (InputError, NegativeResult) as error:  # the identification is there
        return replace(result, next_error=error)
    return replace(result, next_drives=planned)


def _identify_car(
    split: LogSplit, units: dict[str, CommandUnit], settings: Settings, info: MessageSink
) -> tuple[BaseVehicle, Identification, LogSplit, dict[str, CommandUnit]]:
    """Identify a car of any make.

    Returns:
        The car, its identification, the logs, and the units of the commands that both are for: those of the logs as
        they were recorded, if the parameters of the car can hold the factors between the units.

    Raises:
        InputError: if the logs do not identify a car.
    """
    for name in models_of_cars():
        base = load_base_vehicle(name)
        ensure_compiled(base.vehicle, base.reference, info)
    progress = ProgressReporter(info)
    model = identify_car(split.fitted, settings, progress, progress.begin)
    if not has_terms(model.base.definition) or not all(u.neutral == 0.0 < u.scale for u in units.values()):
        return model.base, model.identification, split, units
    factors = {name: unit.scale for name, unit in units.items()}
    car, identification = with_recorded_commands(model.base, model.identification, factors)
    return car, identification, _restored(split, units), {name: CommandUnit() for name in units}


def _earlier_objections(
    out: Path,
    held_out: tuple[Log, ...],
    controls: Sequence[str],
    evaluation: PredictionEvaluation,
    settings: Settings,
) -> tuple[str, ...]:
    """Objections to replacing a vehicle file, whose commands may be in other units; the logs are as recorded."""
    before = load_vehicle_config(str(out))
    scales = (before.identification.commands or {}) if before.identification else {}
    known = {name: CommandUnit(c.neutral, c.scale) for name, c in scales.items()}
    logs = with_units(held_out, {name: known.get(name, CommandUnit()) for name in controls})
    return replacement_objections(before, str(out), logs, evaluation, settings)


def _restored(split: LogSplit, units: Mapping[str, CommandUnit]) -> LogSplit:
    """The split with commands as they were recorded, for units without a neutral value."""
    back = {name: CommandUnit(0.0, 1.0 / unit.scale) for name, unit in units.items()}
    return replace(split, fitted=with_units(split.fitted, back), held_out=with_units(split.held_out, back))


def _checked(request: SysidRequest) -> tuple[BaseVehicle, Settings]:
    """The vehicle and the settings, after every check that reads no logs.

    Raises:
        InputError: with the problems of all checks.
    """
    problems = Problems()
    reference = _reference(request)
    base = problems.of(lambda: load_base_vehicle(reference))
    settings = _parse_settings(request, base, problems.found)
    out, plot, mapping = request.out, request.plot, request.mapping
    checks: list[Callable[[], object]] = [
        lambda: None if base is None else _check_settings(base, settings),
        lambda: check_paths(request.logs),
        lambda: None if mapping is None else load_mapping(mapping),
        lambda: check_holdout(request.holdout),
        lambda: None if out is None else check_vehicle_target(out),
    ]
    if plot is not None:
        from kraft.plot import check_picture

        checks.append(partial(check_picture, plot))
    checks.append(lambda: _check_next(request))
    problems.of(lambda: check_all(*checks))
    problems.check()
    assert base is not None, "every problem was raised"
    return base, settings


def _reference(request: SysidRequest) -> str:
    """The initial vehicle; without a model the one with terms for the commands that the logs have."""
    if request.model != AUTO:
        return request.model
    try:
        return TWO_SIDES if has_two_sides(request.logs, request.mapping) else models_of_cars()[0]
    except InputError:  # of the mapping file, which is checked beside the other options
        return models_of_cars()[0]


def _check_next(request: SysidRequest) -> None:
    """Check the options of recommended drives."""
    if request.next is not None:
        check_next(NextRequest(request.next, request.area, request.commands))
        return
    problems = [
        Diagnostic(
            name, "is given, but no drives are requested", "expected --next too", code=Code.CONFLICT, argument=True
        )
        for name, given in (("area", request.area), ("commands", request.commands))
        if given is not None
    ]
    if problems:
        raise InputError(problems)


def _check_settings(base: BaseVehicle, settings: Settings) -> None:
    """Check that the settings fit the vehicle.

    Raises:
        InputError: with every option that does not.
    """
    try:
        check_settings(base.definition, settings)
        check_free_parameters(base.definition, settings)
    except InputError as error:
        raise InputError(replace(d, file=OPTIONS.get(d.file, d.file)) for d in error.diagnostics) from None


def _parse_settings(request: SysidRequest, base: BaseVehicle | None, problems: list[Diagnostic]) -> Settings:
    """The settings as far as they can be read; other options are added to `problems`.  A vehicle file is for planning.

    Without `base` the vehicle is not known.
    """
    values = parse_parameters(request.param, problems)
    noise = None if request.pose_noise is None else _parse_noise(request.pose_noise, problems)
    graph = next((known for known in GRAPHS if known == request.graph), None)
    if graph is None:
        problems.append(
            Diagnostic(
                "graph", f"is {request.graph!r}", suggestion(request.graph, GRAPHS), code=Code.UNKNOWN, argument=True
            )
        )
    if not HORIZON_MIN <= request.horizon <= HORIZON_MAX:
        expected = f"expected a time from {HORIZON_MIN:g} to {HORIZON_MAX:g} s"
        problems.append(Diagnostic("horizon", f"is {request.horizon:g}", expected, argument=True))
    auxiliary = _parse_extras(request.extras)
    terms = base is not None and has_terms(base.definition)
    if request.out is not None and auxiliary == "auto" and (request.model == AUTO or not terms):
        auxiliary = "plan"
    return Settings(
        horizon=request.horizon,
        noise=noise,
        frozen=_names(request.freeze),
        values=values,
        auxiliary=auxiliary,
        graph=graph or "fast",
    )


def _parse_extras(text: str) -> AuxiliarySelection:
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


def _parse_noise(text: str, problems: list[Diagnostic]) -> Noise | None:
    try:
        position, yaw = map(float, text.split(","))
    except ValueError:
        position = yaw = math.nan
    if 0.0 < position < math.inf and 0.0 < yaw < math.inf:
        return Noise(position, yaw)
    expected = "expected standard deviations of position (m) and yaw (rad), as in 0.01,0.02"
    problems.append(Diagnostic("pose_noise", f"is {text!r}", expected, code=Code.SYNTAX, argument=True))
    return None


class ProgressReporter:
    """Reports the iterations of the optimiser for a model, at most once per `PROGRESS_INTERVAL`."""

    def __init__(self, info: MessageSink, model: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        """Start the clock."""
        self._info, self._model, self._clock, self._last = info, model, clock, clock()

    def begin(self, model: str) -> None:
        """Note the name of the model that is fitted from now on."""
        self._model = model

    def __call__(self, iterations: int, cost: float) -> None:
        """Report the number of iterations and the cost, unless the last report is recent."""
        now = self._clock()
        if now - self._last >= PROGRESS_INTERVAL:
            self._last = now
            self._info(f"{self._model}: iteration {iterations}, cost {cost:.6g}")


def _excluded_note(base: BaseVehicle, settings: Settings) -> tuple[str, ...]:
    """The note that auxiliary parameters of the motion were not considered, if there are such."""
    names = excluded_for_planning(base.vehicle, settings)
    return (f"not considered, because planning does not model them: {', '.join(names)}",) if names else ()


def _untested(split: LogSplit, left_out: Sequence[Stretch]) -> tuple[str, ...]:
    """The warning that the held-out errors are not of all held-out logs, if stretches of them are left out."""
    held_out = {log.name for log in split.held_out}
    count = sum(stretch.log in held_out for stretch in left_out)
    if not count:
        return ()
    return (
        f"{counted(count, 'part')} of the held-out logs {'is' if count == 1 else 'are'} left out of the test: if they "
        "follow large steps of a command, the vehicle reacts more slowly than the models can, and errors are larger",
    )


def _of_two_cars(split: LogSplit) -> tuple[str, ...]:
    """The warning that the logs are of two cars, which may show only with those that are held out."""
    found = two_cars((*split.fitted, *split.held_out)) if split.held_out else ""
    return (f"with those held out, {found}",) if found else ()


def _not_planned_with(identification: Identification) -> list[str]:
    """Identified effects that planning does not model, and that are not zero."""
    return [
        name
        for name in identification.auxiliary
        if is_unknown_to_planning(name) and not identification.parameters[name].is_zero
    ]


def _preview_note(request: SysidRequest, identification: Identification) -> tuple[str, ...]:
    """The note that a vehicle file would be identified otherwise, if it would."""
    names = _not_planned_with(identification)
    if request.out is not None or request.extras != "auto" or not names:
        return ()
    return (
        f"planning does not model {', '.join(names)}: with --out, or --extras plan, the best model without them is "
        "identified, which may be another one",
    )


def _unknown_to_planning(request: SysidRequest, identification: Identification) -> tuple[str, ...]:
    """The warning that a vehicle file to plan with lacks identified effects, if any of them is not zero."""
    names = _not_planned_with(identification)
    if request.out is None or not names:
        return ()
    return (
        f"planning does not model {', '.join(names)}, so that {request.out} plans with an error of their size: for a "
        "file to plan with, leave them out of --extras, --param and --freeze",
    )


def _draw(result: SysidResult) -> None:
    if result.request.plot is not None:
        from kraft.plot.sysid import plot_identification

        plot_identification(
            result.request.plot,
            result.base.vehicle,
            result.split,
            result.identification,
            result.evaluation,
            result.objections,
        )


def _draw_logs(request: SysidRequest, base: BaseVehicle, split: LogSplit, error: InputError) -> None:
    if request.plot is not None:
        from kraft.plot.sysid_logs import plot_logs

        why = f"{error.diagnostics[0].file} {error.diagnostics[0].problem}"
        plot_logs(request.plot, base.vehicle, (*split.fitted, *split.held_out), why)


def _write(result: SysidResult) -> None:
    request = result.request
    if request.out is not None and not result.objections:
        record = identification_record(
            request.model, result.identification, result.split, result.evaluation, result.units
        )
        write_vehicle(request.out, result.base, result.identification.parameters, record)
