"""Warnings and notes of an identification that depend on the request, the logs and the vehicle file to write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from kraft.config.source import Source
from kraft.errors import InputError
from kraft.sysid.acceptance import odd_log_warning
from kraft.sysid.base_vehicle import BaseVehicle
from kraft.sysid.command_units import ASSUMED_WHEELBASE, CommandUnit, sign_warnings, unit_notes
from kraft.sysid.data import LogSplit
from kraft.sysid.floor import leaning_floor
from kraft.sysid.interface import Identification, ParameterEstimate, Settings
from kraft.sysid.parameters import is_unknown_to_planning, without_bounds
from kraft.sysid.screening import two_cars
from kraft.sysid.selection import excluded_for_planning
from kraft.sysid.terms import has_terms
from kraft.sysid.tracked_side import SIDE
from kraft.sysid.unexplained import Stretch
from kraft.sysid.vehicle_file import written_footprint
from kraft.text import counted
from kraft.trial.planning_vehicle import own_robot, stated_robot
from kraft.vehicles import WHEELBASE
from kraft_cli.work.sysid_fit import Fit
from kraft_cli.work.sysid_request import SysidRequest
from ompl_ext.vehicle import Footprint


def annotated(
    request: SysidRequest, fit: Fit, base: BaseVehicle, settings: Settings, taken_over: str
) -> Identification:
    """The identification with the warnings and notes about logs, units and `base`, the vehicle to write.

    `taken_over` is the note about what `base` has from the logs, empty if it has nothing.
    """
    identification, split = fit.identification, fit.split
    return replace(
        identification,
        warnings=(
            *identification.warnings,
            *sign_warnings(fit.units),
            *fit.evaluation.warnings,
            *_untested(split, fit.left_out),
            *_of_two_cars(split),
            *odd_log_warning(fit.evaluation),
            *_of_leaning_floor(split, fit.base),
            *_unknown_to_planning(request, identification),
            *beside_the_middle(request.out, identification),
            *uncovered_robot(request, base, identification.parameters),
        ),
        notes=(
            *identification.notes,
            *unit_notes(fit.units),
            *_wheelbase_note(base, identification, settings, fit.units),
            *braking_note(request, base),
            *bounds_note(request, base),
            *_excluded_note(fit.base, settings),
            *_preview_note(request, identification),
            *((taken_over,) if taken_over else ()),
        ),
    )


def uncovered_robot(
    request: SysidRequest, base: BaseVehicle, estimated: Mapping[str, ParameterEstimate]
) -> tuple[str, ...]:
    """The warning that the vehicle file to write states a true robot that its footprint does not cover.

    One that does not load is a warning too: the parameters are identified without it.
    """
    if request.out is None:
        return ()
    shape = written_footprint(base, estimated)
    footprint = Footprint(shape.length, shape.width, shape.offset)
    written = replace(base.vehicle, name=str(request.out), footprint=footprint)
    recorded = base.recorded.truth if base.recorded is not None else None
    try:
        found = stated_robot(recorded, Source(str(request.out)), written) if recorded else own_robot(written)
    except InputError as error:
        reasons = "; ".join(diagnostic.problem for diagnostic in error.diagnostics)
        found = f"the true robot that {request.out} states does not load: {reasons}"
    return (found,) if found else ()


def _excluded_note(base: BaseVehicle, settings: Settings) -> tuple[str, ...]:
    """The note that auxiliary parameters of the motion were not considered, if there are such."""
    names = [] if has_terms(base.definition) else excluded_for_planning(base.vehicle, settings)
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


def bounds_note(request: SysidRequest, base: BaseVehicle) -> tuple[str, ...]:
    """The note that bounds of parameters are assumed because nobody states them."""
    names = without_bounds(base.definition)
    if not names:
        return ()
    written = f" and written to {request.out}" if request.out is not None else ""
    return (
        f"nothing states min, max and std of {', '.join(names)}: bounds are assumed (a tenth of the value to "
        f"ten times the value; of small angles -1 to 1){written}",
    )


def braking_note(request: SysidRequest, base: BaseVehicle) -> tuple[str, ...]:
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


def beside_the_middle(out: Path | None, identification: Identification) -> tuple[str, ...]:
    """The warning that the tracked point is beside the middle of the vehicle, which no vehicle file states."""
    if SIDE not in identification.auxiliary or identification.parameters[SIDE].is_zero:
        return ()
    side = identification.parameters[SIDE].value
    where = "the vehicle file" if out is None else str(out)
    hand = "left" if side > 0.0 else "right"
    return (
        f"the tracked point is {abs(side):.3f} m to the {hand} of the middle of the vehicle, and planning and driving "
        f"take it for the middle: move the marker there, or state a footprint that is {2.0 * abs(side):.3f} m wider in "
        f"{where}",
    )


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
