"""Recommended drives of `kraft sysid --next` and `kraft record --for`: planned, in words, as JSON and as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.method import RANGES_IN_CODE
from kraft.driving.vehicle_model import VehicleModel
from kraft.elapsed import elapsed_time
from kraft.errors import Code, Diagnostic, InputError, Problems, out_of_range
from kraft.files import check_new_folder
from kraft.logs.log import Log, Part
from kraft.planning.compilation import ensure_compiled
from kraft.sysid.base_vehicle import COMMANDS_OF, BaseVehicle, for_commands, load_base_vehicle
from kraft.sysid.command_units import CommandUnit, with_units
from kraft.sysid.interface import Identification, Noise, Settings
from kraft.sysid.terms import has_terms
from kraft.text import MessageSink, counted
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.load import configured
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.recording.area import Area
    from kraft.recording.experiment import PlannedDrive
    from kraft.recording.manoeuvres import Manoeuvre
    from kraft.recording.recorder import Recorder, RunStart
    from kraft.scenario import Scenario

COUNT_MAX: Final = 20
NOISE: Final = Noise(0.005, 0.02)
"""Noise of the poses where neither logs nor the vehicle file state it."""
NO_ROOM: Final = "expected more room, or a model that turns in a smaller circle"


@dataclass(frozen=True)
class NextRequest:
    """Options of the recommended drives, as written: their number, the free area, and a folder for their commands."""

    count: int
    area: str | None = None
    commands: Path | None = None


@dataclass(frozen=True)
class NextDrives:
    """Recommended drives, the area for them, and the files of their commands, if there are such.

    `unidentified` are the parameters that the logs hardly show.
    """

    drives: tuple[PlannedDrive, ...]
    area: Area
    files: tuple[Path, ...]
    unidentified: tuple[str, ...] = ()


def check_next(request: NextRequest) -> None:
    """Check the options before anything is identified.

    Raises:
        InputError: with every problem.
    """
    problems = Problems()
    problems.found += out_of_range("next", request.count, 1, COUNT_MAX)
    if request.area is not None and _sides(request.area) is None:
        expected = "expected length and width in m, as in 6,4"
        problems.found.append(Diagnostic("area", f"is {request.area!r}", expected, code=Code.SYNTAX, argument=True))
    if request.commands is not None:
        problems.of(partial(check_new_folder, request.commands, "expected a new folder for the commands"))
    problems.check()


def _sides(text: str) -> tuple[float, float] | None:
    try:
        length, width = map(float, text.split(","))
    except ValueError:
        return None
    return (length, width) if 0.0 < length < 1e6 and 0.0 < width < 1e6 else None


def next_drives(
    request: NextRequest,
    base: BaseVehicle,
    identification: Identification,
    settings: Settings,
    logs: Sequence[Log],
    units: Mapping[str, CommandUnit],
    report: MessageSink,
) -> NextDrives:
    """Plan the drives that follow an identification, and write their commands.

    `logs` are as they were recorded, in the `units` in which the drives are told and written too.

    Raises:
        InputError: if no drive fits into the area, or the commands cannot be written.
        NegativeResult: if no drive shows any parameter.
    """
    from kraft.recording.area import Area, extent
    from kraft.recording.experiment import planned_drives
    from kraft.recording.manoeuvres import write_commands
    from kraft.sysid.information import known_after

    logs = with_units(logs, units)
    parts = [part for log in logs for part in log.parts]
    sides = None if request.area is None else _sides(request.area)
    area = extent([part.poses for part in parts]) if sides is None else Area(*sides)
    definition = _within_logs(base.definition, logs)
    interval = float(np.median([np.median(np.diff(part.pose_times)) for part in parts]))
    known = known_after(definition, identification, settings, [_commands(part) for part in parts], 1.0 / interval)
    vehicle = known.parameters.vehicle
    ensure_compiled(vehicle, report, steps=True)
    drives = []
    with elapsed_time(report, f"planning {counted(request.count, 'drive')}"):
        for drive in planned_drives(known, request.count, area.room):
            drives.append(_as_recorded(drive, model_of(vehicle), units))
            report(f"planned drive {len(drives)} of {request.count}")
    if not drives:
        origin = "of the logs " if sides is None else ""
        problem = f"{origin}is {area.length:.2g} m x {area.width:.2g} m, in which no drive fits"
        raise InputError.of_argument("area", problem, NO_ROOM, Code.GEOMETRY)
    files = []
    if request.commands is not None:
        for k, drive in enumerate(drives, 1):
            files.append(request.commands / f"drive_{k}" / "commands.csv")
            write_commands(files[-1], tuple(vehicle.controls), drive.commands)
    return NextDrives(tuple(drives), area, tuple(files), identification.unidentified)


@dataclass(frozen=True)
class _Recorded:
    """A model whose controls are told as they were recorded."""

    model: VehicleModel
    units: Mapping[str, CommandUnit]

    @property
    def vehicle(self) -> Vehicle:
        return self.model.vehicle

    def drive_control(self, drive: float, turn: float) -> Floats:
        return self.recorded(self.model.drive_control(drive, turn))

    def recorded(self, controls: Floats) -> Floats:
        units = [self.units.get(name, CommandUnit()) for name in self.vehicle.controls]
        back: Floats = controls / [unit.scale for unit in units] + [unit.neutral for unit in units]
        return back


def _as_recorded(drive: PlannedDrive, model: VehicleModel, units: Mapping[str, CommandUnit]) -> PlannedDrive:
    """The drive with words and commands in the units of the logs."""
    from kraft.recording.element import in_words

    if all(unit.as_is for unit in units.values()):
        return drive
    told = _Recorded(model, units)
    commands = replace(drive.commands, controls=told.recorded(drive.commands.controls))
    return replace(drive, words=in_words(drive.elements, told), commands=commands)


def _commands(part: Part) -> Manoeuvre:
    """Commands of a part of a log."""
    from kraft.recording.manoeuvres import Manoeuvre

    since = part.command_times - part.pose_times[0]
    return Manoeuvre("driven", since, part.commands, float(part.pose_times[-1] - part.pose_times[0]))


def _within_logs(definition: VehicleConfig | Vehicle, logs: Sequence[Log]) -> VehicleConfig | Vehicle:
    """The vehicle with the limits of the logs where its own are in another unit, as those of a car of any make."""
    limits = {}
    controls = definition.controls if isinstance(definition, Vehicle) else configured(definition).controls
    for name, (low, high) in controls.items():
        commands = np.concatenate([part.commands[:, log.controls.index(name)] for log in logs for part in log.parts])
        least, most = min(float(commands.min()), 0.0), max(float(commands.max()), 0.0)
        if not has_terms(definition):
            limits[name] = (min(low, least), max(high, most))
        else:
            if name == "throttle" and most <= 0.0:
                expected = "expected logs of a vehicle that drives forward too"
                raise InputError.of_argument("next", "the logs never drive forward", expected)
            reach = max(-least, most)
            limits[name] = (-reach, reach) if name == "steering" else (least, most)
    return _with_controls(definition, limits)


def _with_controls(
    definition: VehicleConfig | Vehicle, limits: Mapping[str, tuple[float, float]]
) -> VehicleConfig | Vehicle:
    if isinstance(definition, VehicleConfig):
        return definition.with_controls(limits)
    return replace(definition, controls={**definition.controls, **limits})


def load_prior(reference: str, vehicle: Vehicle | None) -> VehicleConfig | Vehicle:
    """The model to identify, with the commands of the vehicle that drives; with its own if that is None.

    Raises:
        InputError: if it has other controls, no parameter to identify, or a parameter without prior.
    """
    base = load_base_vehicle(reference)
    vehicle = vehicle or base.vehicle
    if set(base.vehicle.controls) != set(vehicle.controls):
        problem = f"has the controls {', '.join(base.vehicle.controls)}"
        expected = f"expected {', '.join(vehicle.controls)}, those of {vehicle.name}, which drives"
        raise InputError.of(reference, problem, expected, Code.MISMATCH)
    definition = base.definition
    _check_priors(base)
    if has_terms(definition) and set(COMMANDS_OF.values()) <= set(definition.parameters):
        extremes = np.array([vehicle.controls[name] for name in vehicle.controls]).T
        part = Part(np.array([0.0, 1.0]), extremes, np.array([0.0, 1.0]), np.zeros((2, 3)))
        return for_commands(base, [Log("", (), tuple(vehicle.controls), (part,))]).definition
    own = base.vehicle.controls
    limits = {name: (max(low, own[name][0]), min(high, own[name][1])) for name, (low, high) in vehicle.controls.items()}
    return _with_controls(definition, limits)


def _check_priors(base: BaseVehicle) -> None:
    """Check that bounds and prior of each parameter to identify are stated.

    Raises:
        InputError: with every parameter that lacks them, or if there is none to identify.
    """
    definition, reference = base.definition, base.reference
    free = {name: p for name, p in base.parameters.items() if not p.fixed}
    if not free:
        expected = "expected one with min, max and std that is not fixed"
        raise InputError.of(reference, "has no parameter to identify", expected, Code.MISSING)
    lacking = {name: [key for key in ("min", "max", "std") if getattr(p, key) is None] for name, p in free.items()}
    unstated = {name: keys for name, keys in lacking.items() if keys}
    if unstated and not isinstance(definition, VehicleConfig):
        expected = f"expected {RANGES_IN_CODE}, or a vehicle file that states them"
        raise InputError.of(reference, f"states no min, max and std of {', '.join(unstated)}", expected, Code.MISSING)
    if unstated:
        assert isinstance(definition, VehicleConfig), "code is refused above"
        raise InputError(
            [
                definition.source.diagnostic(
                    ("parameters", name), f"has no {' and no '.join(keys)}", "expected bounds and prior",
                    code=Code.MISSING,
                )
                for name, keys in unstated.items()
            ]
        )  # fmt: skip


def drives_for(
    definition: VehicleConfig | Vehicle,
    scenario: Scenario,
    recorder: Recorder,
    count: int,
    seed: int,
    report: MessageSink,
) -> list[tuple[Manoeuvre, RunStart | None]]:
    """Drives in a scenario that show the parameters of a model, from its priors, and where each begins.

    Raises:
        InputError: if the scenario has no room for any.
        NegativeResult: if no drive shows any parameter.
    """
    from kraft.recording.experiment import coarse, planned_drives
    from kraft.sysid.information import known_before

    record = definition.identification if isinstance(definition, VehicleConfig) else None
    noise = NOISE if record is None else Noise(record.noise.position, record.noise.yaw)
    known = known_before(definition, noise, scenario.sensing.rate_hz)
    ensure_compiled(known.parameters.vehicle, report, steps=True)

    def room(number: int, path: Matrix) -> float:
        return recorder.place(number, path).time

    found: list[tuple[Manoeuvre, RunStart | None]] = []
    with elapsed_time(report, f"planning {counted(count, 'drive')}"):
        for k, drive in enumerate(planned_drives(known, count, room, seed), 1):
            report(f"planned drive {k} of {count}:")
            for words in drive.words:
                report(f"  {words}")
            found.append((drive.commands, recorder.place(k, coarse(drive.path))))
    if not found:
        problem = f"has no room for any drive that shows the parameters of {definition.name}"
        raise InputError.of(scenario.name, problem, NO_ROOM, Code.GEOMETRY)
    return found


def next_json(found: NextDrives) -> dict[str, Any]:
    """Content of the key `next` of ``kraft.sysid/1``."""
    return {
        "area_m": [found.area.length, found.area.width],
        "drives": [_json(drive, found.files[k] if found.files else None) for k, drive in enumerate(found.drives)],
    }


def _json(drive: PlannedDrive, file: Path | None) -> dict[str, Any]:
    from kraft.recording.area import needed_area

    needed = needed_area(drive.path)
    return {
        "steps": list(drive.words),
        "duration_s": drive.commands.end,
        "needs_m": [needed.length, needed.width],
        "shows": list(drive.shown),
        "std": {name: {"before": drive.before[name], "after": drive.after[name]} for name in drive.before},
        "error_before_m": drive.error_before,
        "error_after_m": drive.error_after,
        "commands": None if file is None else str(file),
    }


def next_lines(found: NextDrives) -> list[str]:
    """Recommended drives for a person."""
    from kraft.recording.area import needed_area
    from kraft.recording.manoeuvres import REST

    size = f"{found.area.length:.2g} m x {found.area.width:.2g} m"
    lines = [
        f"NEXT {counted(len(found.drives), 'drive').upper()}, in an area of {size}",
        "commands as read from the logs: of a column in degrees in rad, with a mapping file after its zero and scale",
    ]
    for k, drive in enumerate(found.drives, 1):
        needed = needed_area(drive.path)
        lines.append(
            f"{k}. from standstill, at rest for {REST:g} s; {drive.commands.end:g} s, "
            f"{needed.length:.1f} m x {needed.width:.1f} m"
        )
        lines += [f"   {step}" for step in drive.words]
        stds = ", ".join(f"{name} {drive.before[name]:.2g} to {drive.after[name]:.2g}" for name in drive.shown)
        lines.append(f"   shows {stds} (standard deviation)" if stds else "   shows all parameters a little")
        lines.append(
            f"   prediction error by the uncertainty of the parameters: {100 * drive.error_before:.2g} cm "
            f"to {100 * drive.error_after:.2g} cm"
        )
    first, last = found.drives[0].before, found.drives[-1].after
    # of what the logs show already, a drive need not tell more
    unseen = [name for name in found.unidentified if name in first and last[name] > 0.9 * first[name]]
    if unseen:
        lines.append(f"no drive shows {', '.join(unseen)}")
    return [*lines, *(f"commands {file}" for file in found.files)]
