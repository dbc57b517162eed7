"""From logs to a vehicle with identified parameters: checks, the fit, and how well it predicts the logs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

from kraft.errors import InputError, NegativeResult
from kraft.sysid.acceptance import PredictionEvaluation, evaluate_predictions
from kraft.sysid.base_vehicle import BaseVehicle, for_sides, load_base_vehicle, with_recorded_commands, with_speed
from kraft.sysid.checks import SteeringInMotion
from kraft.sysid.command_units import SIDES, CommandUnit, with_units
from kraft.sysid.data import LogSplit
from kraft.sysid.factor_graph import ensure_identification_compiled
from kraft.sysid.identify import identify
from kraft.sysid.interface import Identification, Settings
from kraft.sysid.model_choice import identify_car, models_of_cars
from kraft.sysid.screening import check_consistency, check_direction
from kraft.sysid.terms import check_controls, has_terms
from kraft.sysid.unexplained import Stretch, unexplained_stretches, without
from kraft.text import MessageSink
from kraft.vehicles import is_car
from kraft_cli.work.sysid_logs import report_problems
from kraft_cli.work.sysid_progress import ProgressReporter
from kraft_cli.work.sysid_request import AUTO, SysidRequest


@dataclass(frozen=True)
class Fit:
    """A vehicle with its identified parameters, the logs and the units that they are for, and its prediction errors.

    `left_out` are the stretches of the logs that no model explains; `seconds` is the duration of the identification.
    """

    base: BaseVehicle
    identification: Identification
    split: LogSplit
    units: Mapping[str, CommandUnit]
    left_out: tuple[Stretch, ...]
    evaluation: PredictionEvaluation
    seconds: float


def fit_vehicle(
    request: SysidRequest,
    base: BaseVehicle,
    split: LogSplit,
    units: dict[str, CommandUnit],
    settings: Settings,
    info: MessageSink,
    warn: MessageSink,
) -> Fit:
    """Check the logs, whose commands are in `units`, identify the vehicle and predict the logs.

    Raises:
        NegativeResult: if the logs do not identify it; the page shows the logs then.
    """
    auto = request.model == AUTO and is_car(base.vehicle)
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
            controls = set(base.vehicle.controls)
            identification = identify(base.definition, split.fitted, settings, ProgressReporter(info, base.name))
            if has_terms(base.definition) and controls == set(SIDES):
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
    return Fit(base, identification, split, units, left_out, evaluation, seconds)


def _without_unexplained(split: LogSplit, info: MessageSink) -> tuple[LogSplit, tuple[Stretch, ...]]:
    """The logs without the stretches that no model explains, and these, which `info` receives."""
    left_out = unexplained_stretches((*split.fitted, *split.held_out))
    for stretch in left_out:
        info(f"left out, because no model explains it: {stretch}")
    fitted, held_out = without(split.fitted, left_out), without(split.held_out, left_out)
    return replace(split, fitted=fitted, held_out=held_out), left_out


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


def _restored(split: LogSplit, units: Mapping[str, CommandUnit]) -> LogSplit:
    """The split with commands as they were recorded, for units without a neutral value."""
    return in_units(split, {name: CommandUnit(0.0, 1.0 / unit.scale) for name, unit in units.items()})


def in_units(split: LogSplit, units: Mapping[str, CommandUnit]) -> LogSplit:
    """The split with commands in the units of the model, for the meaning of their recorded numbers."""
    return replace(split, fitted=with_units(split.fitted, units), held_out=with_units(split.held_out, units))


def _draw_logs(request: SysidRequest, base: BaseVehicle, split: LogSplit, error: InputError) -> None:
    if request.plot is not None:
        from kraft.plot.sysid_logs import plot_logs

        why = f"{error.diagnostics[0].file} {error.diagnostics[0].problem}"
        plot_logs(request.plot, base.vehicle, (*split.fitted, *split.held_out), why)
