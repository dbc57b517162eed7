"""The vehicle whose parameters are identified: a bundled vehicle, a vehicle file or code."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kraft.config import bundled
from kraft.config.source import Source
from kraft.config.user_code import is_code, split_file
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.interface import Identification
from kraft.sysid.log_motion import motions
from kraft.sysid.smoothing import high_speed
from kraft.vehicles import WHEELBASE
from kraft.vehicles.code import check_functions, vehicle_in_code
from kraft.vehicles.config import Footprint, Parameter, VehicleConfig, stated_parameters
from kraft.vehicles.load import (
    RecordedVehicle,
    configured,
    natural_robot,
    read_vehicle_file,
    resolved_reference,
    units_of,
)
from kraft.vehicles.reference import resolve_vehicle
from kraft.vehicles.true_robot import with_files
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


SPEED_SETTLING, SPEED_STEP = 20.0, 0.05
"""Time after which full throttle has led to the top speed, and step of the simulation, s."""


@dataclass(frozen=True)
class BaseVehicle:
    """The vehicle whose parameters are identified.

    Attributes:
        reference: name, file or code as the user gave it.
        definition: the vehicle file, with bounds and priors, or the vehicle from code.
        vehicle: the same vehicle as the planner uses it.
        model: reference to the code; the path of a file is absolute.
        recorded: what the logs state of the vehicle that drove, in place of what is stated here; None if they do not.
    """

    reference: str
    definition: VehicleConfig | Vehicle
    vehicle: Vehicle
    model: str
    recorded: RecordedVehicle | None = None

    @property
    def name(self) -> str:
        """Name of the vehicle."""
        return self.vehicle.name

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the model as in a vehicle file; those that nothing states have a value and a unit only."""
        stated = stated_parameters(self.definition)
        units = units_of(self.model)
        return {
            name: stated.get(name) or Parameter(value=value, unit=units.get(name, "1"))
            for name, value in self.vehicle.parameters.items()
        }

    @property
    def footprint(self) -> Footprint:
        """Footprint as in a vehicle file."""
        shape = self.vehicle.footprint
        return Footprint(length=shape.length, width=shape.width, offset=shape.offset)

    @property
    def controls(self) -> Mapping[str, tuple[float, float]]:
        """Limits of the controls where they differ from those of the model's code."""
        return self.definition.controls if isinstance(self.definition, VehicleConfig) else {}

    @property
    def top_speed(self) -> float | str:
        """Top speed, m/s, or the name of the parameter that is the top speed."""
        return (
            self.definition.top_speed if isinstance(self.definition, VehicleConfig) else float(self.vehicle.top_speed)
        )


def load_base_vehicle(reference: str) -> BaseVehicle:
    """Load a bundled vehicle, a vehicle file, or code.

    Raises:
        InputError: with everything that is wrong with it.
    """
    resolved = resolved_reference(reference, Path.cwd())
    if is_code(resolved):
        vehicle = vehicle_in_code(resolved, reference)
        base = BaseVehicle(reference, vehicle, vehicle, resolved)
    else:
        config = read_vehicle_file(resolved)
        model = config.model
        if split_file(model) is not None:
            model = resolve_vehicle(model, Path(config.source.file).parent)
        base = BaseVehicle(reference, config, configured(config), model)
    check_functions(base.vehicle, reference)
    return base


MANIFEST = "manifest.json"
"""File beside a log that `kraft record` wrote."""


def with_recorded(base: BaseVehicle, logs: Sequence[Log]) -> tuple[BaseVehicle, str]:
    """The vehicle with what the manifests of all logs state of the one that drove, and what there is to say about it.

    Nothing is taken over if that is the robot that the vehicle itself states.
    """
    stated = [_recorded(Path(log.sources[0].file).parent / MANIFEST) if log.sources else None for log in logs]
    known = next((vehicle for vehicle in stated if vehicle is not None), None)
    if known is None:
        return base, _unstated(base) if base.reference in bundled.names("vehicle") else ""
    if any(vehicle != known for vehicle in stated):
        names = ", ".join(dict.fromkeys(vehicle.name if vehicle else "not stated" for vehicle in stated))
        return base, f"the logs do not agree about the vehicle that drove ({names}): nothing is taken over from them"
    if RecordedVehicle.of(base.vehicle, natural_robot(base.vehicle)[0]).located().truth == known.truth:
        return base, ""
    missing = with_files(known.truth, Path(), Source(""))[1] if known.truth else []
    if missing:
        return base, f"nothing is taken over from the recorded {known.name}: {missing[0].problem}"
    taken = ["footprint", *(["delay"] if known.delay else []), *(["true robot"] if known.truth else [])]
    return replace(base, recorded=known), f"taken over from the recorded {known.name}: {', '.join(taken)}"


def _unstated(base: BaseVehicle) -> str:
    """What to say where a bundled vehicle lends the written one what no log states."""
    shape = base.vehicle.footprint
    return (
        f"no log states which vehicle drove: the footprint of the written one, {shape.length:g} x {shape.width:g} m, "
        f"the place of its centre and the true robot are those of {base.name}; state yours in the file "
        "(`footprint: {length, width, offset}`, `truth`)"
    )


def _recorded(manifest: Path) -> RecordedVehicle | None:
    """The vehicle that a manifest states; None if there is no such file, or if another program wrote it."""
    try:
        content = json.loads(manifest.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    stated = content.get("vehicle") if isinstance(content, dict) else None
    return RecordedVehicle.read(stated, manifest) if isinstance(stated, dict) else None


LEVER = "lever"
"""Parameter of `kraft.vehicles.car` that is a length, as the wheelbase is."""
WHEELS_TURNED = 0.4
"""Angle of the wheels in the sharpest turn of a car whose wheelbase is chosen, rad."""
WHEELS_TURNED_USUALLY = 0.15, 0.7
"""Range of this angle in which the wheelbase of the vehicle file suits, rad."""
SHARPEST = 0.98
"""Quantile of the curvature that counts as that of the sharpest turn."""
SHARE_OF_SPEED = 0.3
"""Share of the top speed of the logs from which on the curvature is measured."""
COMMANDS_OF = {"throttle": "full_throttle", "steering": "full_steering"}
"""Parameters of `kraft.vehicles.car` that state what command counts as full."""


def for_commands(base: BaseVehicle, logs: Sequence[Log]) -> BaseVehicle:
    """The car with the commands of the logs: their limits, and the largest ones as the full ones."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    values, limits = {}, {}
    for name, full in COMMANDS_OF.items():
        column = [part.commands[:, log.controls.index(name)] for log in logs for part in log.parts]
        low, high = (float(edge) for edge in (min(c.min() for c in column), max(c.max() for c in column)))
        largest = max(abs(low), abs(high))
        if largest > 0.0:
            values[full], limits[name] = largest, (low, high)
        if name == "throttle" and low < 0.0:
            values["full_reverse"] = -low / largest
    if "steering" in limits:  # a car turns as far to one side as to the other unless the logs show otherwise
        reach = values["full_steering"]
        limits["steering"] = (-reach, reach)
    changed = config.with_values(values).with_controls(limits)
    return replace(base, definition=changed, vehicle=configured(changed))


def for_turns(base: BaseVehicle, logs: Sequence[Log]) -> BaseVehicle:
    """The car with a wheelbase that suits its size: poses show only its ratio to the tangent of the wheel angle.

    The steering curve is one of angles.  At the wheelbase of a car of another size it would have to follow the curve of
    the tangent, so that the sharpest turn of the logs is one of `WHEELS_TURNED` there.  Lengths have bounds in
    proportion.  A car of about the size of the vehicle file remains as it is.
    """
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    known, found = config.parameters[WHEELBASE], motions(logs)
    if not found:
        return base
    speed, rate = (np.abs(np.concatenate([getattr(m, name) for m in found])) for name in ("speed", "rate"))
    fast = speed > SHARE_OF_SPEED * np.quantile(speed, 0.95)
    sharpest = float(np.quantile(rate[fast] / np.maximum(speed[fast], 1e-6), SHARPEST)) if fast.any() else 0.0
    low, high = WHEELS_TURNED_USUALLY
    if sharpest <= 0.0 or low <= math.atan(sharpest * known.value) <= high:
        return base
    wheelbase = float(f"{math.tan(WHEELS_TURNED) / sharpest:.1g}")
    wheelbase = float(np.clip(wheelbase, known.min or 0.0, known.max or math.inf))
    changed = config.with_stated({WHEELBASE: {"value": wheelbase}, LEVER: _lever_bounds(config, wheelbase)})
    return replace(base, definition=changed, vehicle=configured(changed))


def for_wheelbase(base: BaseVehicle, wheelbase: float) -> BaseVehicle:
    """The car for a stated wheelbase (m): lengths have bounds in proportion if theirs would not hold both axles."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    longest = config.parameters[LEVER].max
    if longest is None or wheelbase <= longest:
        return base
    changed = config.with_stated({LEVER: _lever_bounds(config, wheelbase)})
    return replace(base, definition=changed, vehicle=configured(changed))


def _lever_bounds(config: VehicleConfig, wheelbase: float) -> dict[str, float]:
    """Bounds and prior of the lever in proportion to the wheelbase, m."""
    lever, ratio = dict(config.parameters[LEVER]), wheelbase / config.parameters[WHEELBASE].value
    return {key: ratio * lever[key] for key in ("min", "max", "std") if lever[key] is not None}


def with_backward_commands(base: BaseVehicle, logs: Sequence[Log]) -> BaseVehicle:
    """The car with throttle as far below 0 as the logs have it, at most as far as above: it can brake and reverse."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file
    low, high = base.vehicle.controls["throttle"]
    logged = min(float(part.commands[:, log.controls.index("throttle")].min()) for log in logs for part in log.parts)
    if logged >= low:
        return base
    changed = config.with_controls({**base.vehicle.controls, "throttle": (max(logged, -high), high)})
    return replace(base, definition=changed, vehicle=configured(changed))


def with_coasting(base: BaseVehicle) -> BaseVehicle:
    """The car with throttle 0 within its limits: a car that no log shows without throttle can be left without it."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    low, high = base.vehicle.controls["throttle"]
    if low <= 0.0 <= high:
        return base
    changed = config.with_controls({**base.vehicle.controls, "throttle": (min(low, 0.0), max(high, 0.0))})
    return replace(base, definition=changed, vehicle=configured(changed))


def for_sides(base: BaseVehicle, logs: Sequence[Log]) -> BaseVehicle:
    """The robot with two driven sides with the limits of the commands in the logs, the same for both sides."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    given = np.concatenate([part.commands.ravel() for log in logs for part in log.parts])
    limits = min(float(given.min()), 0.0), max(float(given.max()), 0.0)
    changed = config.with_controls(dict.fromkeys(base.vehicle.controls, limits))
    return replace(base, definition=changed, vehicle=configured(changed))


def with_recorded_commands(
    base: BaseVehicle, identification: Identification, scales: Mapping[str, float]
) -> tuple[BaseVehicle, Identification]:
    """The car and its identification with commands as they were recorded: those of the fit are `scales` times them."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    values = {full: base.vehicle.parameters[full] / scales[name] for name, full in COMMANDS_OF.items()}
    limits = {name: (low / scales[name], high / scales[name]) for name, (low, high) in base.controls.items()}
    changed = config.with_values(values).with_controls(limits)
    parameters = {
        name: replace(p, value=values[name], initial=values[name], ci95=(values[name], values[name]))
        if name in values
        else p
        for name, p in identification.parameters.items()
    }
    scale = np.array([scales[name] for name in base.vehicle.controls])
    logs = tuple(
        replace(log, parts=tuple(replace(part, controls=part.controls / scale) for part in log.parts))
        for log in identification.logs
    )
    car = replace(base, definition=changed, vehicle=configured(changed))
    return car, replace(identification, parameters=parameters, logs=logs)


STEERING_SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Steering for which the top speed is computed, as shares of the full one: a tracked point ahead of the rear axle is
faster than it in a turn."""


def with_speed(base: BaseVehicle, identification: Identification, logs: Sequence[Log]) -> BaseVehicle:
    """The vehicle with a top speed: that of its full commands, or the highest in the logs if it is higher."""
    model, values = base.vehicle, identification.values
    car = model.with_parameters({name: values[name] for name in model.parameters})
    steps, ways = round(SPEED_SETTLING / SPEED_STEP), len(STEERING_SHARES)
    controls = np.zeros((steps, ways, len(model.controls)))
    for k, (name, (low, high)) in enumerate(model.controls.items()):  # two sides may count backwards
        full = high if high >= -low or name == "throttle" else low
        controls[:, :, k] = high * np.array(STEERING_SHARES) if name == "steering" else full
    states = DiscreteModel(car).simulate(
        np.zeros((ways, len(model.state))), controls, np.tile(car.parameter_array, (ways, 1)),
        np.full(ways, SPEED_STEP),
    )  # fmt: skip
    moved = np.diff(states[..., [model.index("x"), model.index("y")]], axis=0)
    steady = float(np.hypot(moved[..., 0], moved[..., 1]).max()) / SPEED_STEP
    seen = max(high_speed(part) for log in logs for part in log.parts)
    config = base.definition
    assert isinstance(config, VehicleConfig)
    changed = config.with_top_speed(float(f"{max(steady, seen):.3g}"))
    return replace(base, definition=changed, vehicle=configured(changed))
