"""`kraft sysid` without a terminal: from the request to identified parameters, a vehicle file and a page."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from kraft.errors import InputError, NegativeResult
from kraft.logs.log import Log, LogSet
from kraft.sysid.acceptance import (
    PredictionEvaluation,
    evaluate_predictions,
    objections,
    odd_log_warning,
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
from kraft.sysid.command_units import (
    ASSUMED_WHEELBASE,
    SIDES,
    CommandUnit,
    command_units,
    sign_warnings,
    unit_notes,
    with_units,
)
from kraft.sysid.data import LogSplit, split_logs
from kraft.sysid.factor_graph import ensure_identification_compiled
from kraft.sysid.floor import leaning_floor
from kraft.sysid.identify import identify
from kraft.sysid.interface import Identification, Settings
from kraft.sysid.model_choice import identify_car, models_of_cars
from kraft.sysid.parameters import is_unknown_to_planning, without_bounds
from kraft.sysid.screening import check_consistency, check_direction, two_cars
from kraft.sysid.selection import excluded_for_planning
from kraft.sysid.terms import check_controls, has_terms
from kraft.sysid.unexplained import Stretch, unexplained_stretches, without
from kraft.sysid.vehicle_file import identification_record, write_vehicle
from kraft.text import MessageSink, counted, no_messages
from kraft.vehicles import WHEELBASE, is_car
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.work.next_drives import NextDrives, NextRequest, next_drives
from kraft_cli.work.sysid_logs import read_sysid_logs, report_problems
from kraft_cli.work.sysid_request import AUTO, SysidRequest, checked

PROGRESS_INTERVAL: Final = 2.0
"""Least time between two progress messages, and before the first one, s."""
LARGEST: Final = 0.7
"""Length of the largest vehicle for which the bundled scenarios have room, m."""


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

    @property
    def fits_bundled_scenarios(self) -> bool:
        """Whether the vehicle is of a size for which the bundled scenarios have room."""
        recorded = self.base.recorded
        footprint = self.base.vehicle.footprint if recorded is None else recorded.footprint
        return footprint.length <= LARGEST


def run_sysid(
    request: SysidRequest, info: MessageSink, warn: MessageSink, detail: MessageSink = no_messages
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
    base, settings = checked(request)
    any_unit = request.model == AUTO
    auto = any_unit and is_car(base.vehicle)
    limits = base.vehicle.controls
    controls = tuple(limits)
    logs = read_sysid_logs(request.logs, request.mapping, limits, info, warn, detail, any_command_unit=any_unit)
    split = split_logs(logs.logs, request.holdout)
    info(split.note)
    units = command_units(split.fitted, settings.values.get(WHEELBASE, ASSUMED_WHEELBASE)) if any_unit else {}
    recorded = split.held_out
    split = replace(split, fitted=with_units(split.fitted, units), held_out=with_units(split.held_out, units))
    try:
        check_direction(split.fitted)
        if auto or has_terms(base.definition):  # before drives that a constant does not explain are taken for two cars
            check_controls(split.fitted, SteeringInMotion.of(split.fitted))
        check_consistency(split.fitted)
        split, left_out = _without_unexplained(split, info)
        ensure_identification_compiled(base.vehicle, base.reference, info)
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
        if request.plot is not None:
            info(f"picture {request.plot}")
        report_problems(error, warn)
        raise NegativeResult("the parameters cannot be identified from these logs", error.diagnostics) from None
    unknown = (
        *_untested(split, left_out),
        *_of_two_cars(split),
        *odd_log_warning(evaluation),
        *_of_leaning_floor(split, base),
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
            *_wheelbase_note(base, identification, settings, units),
            *_braking_note(request, base),
            *_bounds_note(request, base),
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
        ensure_identification_compiled(base.vehicle, base.reference, info)
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


class ProgressReporter:
    """Reports the iterations of the optimiser in a stage, at most once per `PROGRESS_INTERVAL`."""

    def __init__(self, info: MessageSink, stage: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        """Start the clock."""
        self._info, self._stage, self._clock, self._last = info, stage, clock, clock()

    def begin(self, stage: str) -> None:
        """Note what is fitted from now on."""
        self._stage = stage

    def __call__(self, iterations: int, cost: float) -> None:
        """Report the number of iterations and the cost, unless the last report is recent."""
        now = self._clock()
        if now - self._last >= PROGRESS_INTERVAL:
            self._last = now
            self._info(f"{self._stage}: iteration {iterations}, cost {cost:.6g}")


def _excluded_note(base: BaseVehicle, settings: Settings) -> tuple[str, ...]:
    """The note that auxiliary parameters of the motion were not considered, if there are such."""
    names = excluded_for_planning(base.vehicle, settings)
    return (f"not considered, because planning does not model them: {', '.join(names)}",) if names else ()


def _wheelbase_note(
    base: BaseVehicle, identification: Identification, settings: Settings, units: Mapping[str, CommandUnit]
) -> tuple[str, ...]:
    """The note that the wheelbase is assumed, if the result depends on it and nobody stated it."""
    known = identification.parameters.get(WHEELBASE)
    of_terms = known is not None and known.frozen and has_terms(base.definition)
    converted = not units.get("steering", CommandUnit()).as_is
    if WHEELBASE in settings.values or not (of_terms or converted):
        return ()
    assumed = known.value if known is not None and of_terms else ASSUMED_WHEELBASE
    angles = "wheel angles and the scale of the steering" if converted else "wheel angles"
    return (
        f"{WHEELBASE}, the wheelbase, is taken as {assumed:g} m: poses show only its ratio to the steering. "
        f"Predictions hardly depend on it, {angles} do; if you have measured it, state it with --param {WHEELBASE}=...",
    )


def _bounds_note(request: SysidRequest, base: BaseVehicle) -> tuple[str, ...]:
    """The note that bounds of parameters are assumed because nobody states them."""
    names = without_bounds(base.definition)
    if not names:
        return ()
    written = f" and written to {request.out}" if request.out is not None else ""
    return (
        f"nothing states min, max and std of {', '.join(names)}: bounds are assumed (a tenth of the value to "
        f"ten times the value; of small angles -1 to 1){written}",
    )


def _braking_note(request: SysidRequest, base: BaseVehicle) -> tuple[str, ...]:
    """The note that a car plans without brakes because it is written with the commands of logs that have none."""
    limits = base.vehicle.controls.get("throttle", (-1.0, 1.0))
    if request.out is None or not has_terms(base.definition) or limits[0] < 0.0:
        return ()
    return (
        f"the logs have no throttle below 0, so that the vehicle of {request.out} neither brakes nor drives backwards: "
        "if the car can, log such drives too (in simulation: kraft record --commands FILE with such throttle, and "
        "--vehicle of one that takes it, such as mushr-drive)",
    )


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


def _of_leaning_floor(split: LogSplit, base: BaseVehicle) -> tuple[str, ...]:
    """The warning that the floor leans, for a model without a force on the vehicle."""
    found = "" if "a_x" in base.vehicle.parameters else leaning_floor(split.fitted)
    return (found,) if found else ()


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
