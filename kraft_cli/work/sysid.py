"""`kraft sysid` without a terminal: from the request to identified parameters, a vehicle file and a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from kraft.errors import InputError, NegativeResult
from kraft.logs.log import Log, LogSet
from kraft.sysid.acceptance import PredictionEvaluation, objections, replacement_objections
from kraft.sysid.base_vehicle import BaseVehicle, with_recorded
from kraft.sysid.command_units import ASSUMED_WHEELBASE, CommandUnit, command_units, with_units
from kraft.sysid.data import LogSplit, split_logs
from kraft.sysid.interface import Identification, Settings
from kraft.sysid.unexplained import Stretch, without
from kraft.sysid.vehicle_file import identification_record, write_vehicle
from kraft.text import MessageSink, no_messages
from kraft.vehicles import WHEELBASE
from kraft.vehicles.config import load_vehicle_config
from kraft_cli.work.next_drives import NextDrives, NextRequest, next_drives
from kraft_cli.work.sysid_fit import fit_vehicle, in_units
from kraft_cli.work.sysid_logs import read_sysid_logs
from kraft_cli.work.sysid_notes import annotated
from kraft_cli.work.sysid_request import AUTO, SysidRequest, checked

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
    any_unit, limits = request.model == AUTO, base.vehicle.controls
    logs = read_sysid_logs(request.logs, request.mapping, limits, info, warn, detail, any_command_unit=any_unit)
    recorded = split_logs(logs.logs, request.holdout)
    info(recorded.note)
    units = command_units(recorded.fitted, settings.values.get(WHEELBASE, ASSUMED_WHEELBASE)) if any_unit else {}
    fit = fit_vehicle(request, base, in_units(recorded, units), units, settings, info, warn)
    base, taken_over = with_recorded(fit.base, logs.logs) if request.out is not None else (fit.base, "")
    identification = annotated(request, fit, base, settings, taken_over)
    found = objections(identification, fit.evaluation)
    if request.out is not None and request.out.exists() and not found:
        held_out = without(recorded.held_out, fit.left_out)
        found = _earlier_objections(request.out, held_out, tuple(limits), fit.evaluation, settings)
    result = SysidResult(
        request, base, logs, fit.split, identification, fit.evaluation, found, fit.seconds, fit.units, fit.left_out
    )
    _write(result)  # first: a plot that cannot be written does not cost the vehicle file
    _draw(result)
    return result if request.next is None else _with_next_drives(result, request.next, settings, info)


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


def _write(result: SysidResult) -> None:
    request = result.request
    if request.out is not None and not result.objections:
        record = identification_record(
            request.model, result.identification, result.split, result.evaluation, result.units
        )
        write_vehicle(request.out, result.base, result.identification.parameters, record)
