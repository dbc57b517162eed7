"""Vehicle file of an identification, which every command accepts in place of a bundled vehicle."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from kraft.config.schema import NAME, check
from kraft.config.source import Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, InputError
from kraft.files import check_writable, write_whole
from kraft.provenance import IDENTIFICATION, versions
from kraft.sysid.acceptance import PredictionEvaluation, errors_by_speed
from kraft.sysid.base_vehicle import BaseVehicle
from kraft.sysid.command_units import CommandUnit
from kraft.sysid.data import LogSplit
from kraft.sysid.interface import Identification, ParameterEstimate, PredictionErrors
from kraft.text import counted
from kraft.vehicles.config import Delay, Footprint, Parameter, VehicleConfig
from kraft.vehicles.identification_record import (
    CommandScale,
    Covariance,
    Extra,
    IdentificationRecord,
    Logged,
    PoseNoise,
    Prediction,
)
from kraft.vehicles.reference import relative_vehicle
from kraft.vehicles.true_robot import RobotTruth, with_files

if TYPE_CHECKING:
    from kraft.logs.log import Log


DIGITS: Final = 6
"""Significant digits of parameters: far more than their uncertainty justifies."""
STD_FACTOR: Final = 3.0
"""Standard deviation in the file over that of the estimate ..."""
STD_SHARE_MIN: Final = 0.1
"""... but at least this share of the one before: the car changes a little from day to day."""
STD_OF_VALUE: Final = 0.02
"""Least standard deviation in the file of a parameter of which none was stated, as a share of its value."""
DELAY_STD_MIN: Final = 0.01
"""Least standard deviation of an identified delay in the file, s: it changes from day to day."""
HEADER: Final = ("# Identified by kraft sysid; the record of the identification is at the end.",)


def check_vehicle_target(path: Path) -> None:
    """Refuse a path that cannot be written, or a file that no identification has written.

    Raises:
        InputError: if it is one of these.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise InputError.of(
            str(path), "is not the name of a vehicle file", "expected a name that ends in .yaml", Code.MISMATCH
        )
    check_writable(path)
    if os.path.lexists(path):
        config, _ = check(VehicleConfig, read_document(path))
        if config is None or config.identification is None:
            problem = "exists, and no identification wrote it"
            raise InputError.of(
                str(path), problem, "expected a new file, or one that an identification wrote", Code.EXISTS
            )


def write_vehicle(
    path: Path, base: BaseVehicle, estimated: Mapping[str, ParameterEstimate], record: IdentificationRecord
) -> None:
    """Write a vehicle with the name of the file, in one step.

    Raises:
        InputError: if it cannot be written.
    """
    name = path.stem if re.fullmatch(NAME, path.stem) else base.name
    fitted = sum(not log.held_out for log in record.logs)
    description = f"{base.name} identified from {counted(fitted, 'log')}"
    write_whole(path, vehicle_text(path.parent, name, description, HEADER, base, estimated, record).encode())


def vehicle_text(
    folder: Path,
    name: str,
    description: str,
    header: Sequence[str],
    base: BaseVehicle,
    estimated: Mapping[str, ParameterEstimate],
    record: IdentificationRecord,
    *,
    tighten: bool = True,
) -> str:
    """Content of a vehicle file that will be in `folder`.

    Args:
        folder: folder of the file; a path to the code of the model is relative to it.
        name: of the vehicle.
        description: of the vehicle.
        header: comments of the first lines.
        base: vehicle with the model, footprint and top speed.
        estimated: estimates of the parameters; auxiliary parameters are only in the record.
        record: the section `identification`.
        tighten: whether to reduce the standard deviations to the uncertainty of the estimates.
    """
    shape = written_footprint(base, estimated)
    offset = f", offset: {_number(shape.offset)}" if shape.offset else ""
    lines = [
        *header,
        f"name: {_text(name, flow=False)}",
        f"description: {_text(description, flow=False)}",
        "",
        f"model: {_model(base.model, folder)}",
        *_parameters(base, estimated, tighten=tighten),
        *_controls(base),
        "",
        f"footprint: {{length: {_number(shape.length)}, width: {_number(shape.width)}{offset}}}",
        f"top_speed: {base.top_speed if isinstance(base.top_speed, str) else _number(base.top_speed)}",
        *_kept(base, estimated, folder),
        "",
        "identification:",
        *_mapping(record.model_dump(mode="json", exclude_none=True), "  "),
    ]
    return "\n".join(lines) + "\n"


def updated_parameter(parameter: Parameter, estimate: ParameterEstimate, *, tighten: bool = True) -> Parameter:
    """A parameter with the estimate in place of its value.

    The bounds remain, unless the estimate is outside them.  The standard deviation is reduced, but not to that of the
    estimate, because it is the prior of the next identification, and not below the variation from drive to drive.
    Bounds that nobody stated are those of the identification.  Without `tighten` all remain.
    """
    value = float(f"{estimate.value:.{DIGITS}g}")
    low, high, std = parameter.min, parameter.max, parameter.std
    if tighten and not estimate.frozen:
        low, high = estimate.min if low is None else low, estimate.max if high is None else high
        std = float(f"{_tightened(std, estimate):.2g}")
    low, high = None if low is None else min(low, value), None if high is None else max(high, value)
    return Parameter(
        value=value,
        unit=estimate.unit or parameter.unit,
        description=estimate.description,
        min=low,
        max=high,
        std=std,
        neutral=parameter.neutral,
        fixed=parameter.fixed,
        variation=float(f"{estimate.variation or parameter.variation:.2g}"),
    )


def _tightened(std: float | None, estimate: ParameterEstimate) -> float:
    """Standard deviation of the next prior, from that of the last one, if one was stated, and the estimate."""
    found = STD_FACTOR * estimate.std
    if std is None:
        return max(found, STD_OF_VALUE * abs(estimate.value), estimate.variation)
    return max(min(std, max(found, STD_SHARE_MIN * std)), estimate.variation)


def _parameters(base: BaseVehicle, estimated: Mapping[str, ParameterEstimate], *, tighten: bool) -> Iterator[str]:
    yield "parameters:" if base.parameters else "parameters: {}"
    for name, before in base.parameters.items():
        parameter = updated_parameter(before, estimated[name], tighten=tighten)
        limits = ((key, getattr(parameter, key)) for key in ("min", "max", "std", "neutral"))
        stated = "".join(f", {key}: {_number(value)}" for key, value in limits if value is not None)
        stated += ", fixed: true" if parameter.fixed else ""
        stated += f", variation: {_number(parameter.variation)}" if parameter.variation else ""
        description = f", description: {_text(parameter.description)}" if parameter.description else ""
        yield f"  {name}: {{value: {_number(parameter.value)}, unit: {_text(parameter.unit)}{stated}{description}}}"


def _controls(base: BaseVehicle) -> Iterator[str]:
    if base.controls:
        limits = ", ".join(f"{name}: [{_number(a)}, {_number(b)}]" for name, (a, b) in base.controls.items())
        yield ""
        yield f"controls: {{{limits}}}"


def written_footprint(base: BaseVehicle, estimated: Mapping[str, ParameterEstimate]) -> Footprint:
    """Footprint that the file of an identified vehicle states: that of the robot in the logs, or the initial one."""
    return base.recorded.footprint if base.recorded else _about_tracked_point(base, estimated)


def _about_tracked_point(base: BaseVehicle, estimated: Mapping[str, ParameterEstimate]) -> Footprint:
    """Footprint of the initial vehicle about the point whose poses are observed, if that is a parameter."""
    shape, before = base.footprint, base.parameters
    if "lever" not in before:
        return shape
    moved = estimated["lever"].value - before["lever"].value
    return shape.model_copy(update={"offset": shape.offset - moved})


def _kept(base: BaseVehicle, estimated: Mapping[str, ParameterEstimate], folder: Path) -> Iterator[str]:
    """What is true of the robot beside its model, as the logs or the initial vehicle state it; its identified delay."""
    definition, recorded = base.definition, base.recorded
    stated = definition if isinstance(definition, VehicleConfig) else None
    if stated is not None and stated.gravity_share is not None:
        yield f"gravity_share: {_number(stated.gravity_share)}"
    delay = _delay(estimated) or (recorded and recorded.delay) or (stated and stated.delay)
    if delay is not None:
        yield f"delay: {_flow(delay.model_dump())}"
    if recorded is not None and recorded.truth is not None:
        yield f"truth: {_flow(_robot(recorded.truth, Source(''), folder))}"
    elif stated is not None and stated.truth is not None:
        yield f"truth: {_flow(_robot(stated.truth, stated.source, folder))}"


def _delay(estimated: Mapping[str, ParameterEstimate]) -> Delay | None:
    """The delay that was identified, if commands take effect later."""
    found = estimated.get("delay")
    if found is None or found.value <= 0.0:
        return None
    return Delay(value=float(f"{found.value:.3g}"), std=float(f"{max(found.std, DELAY_STD_MIN):.2g}"))


def _robot(robot: RobotTruth, source: Source, folder: Path) -> dict[str, Any]:
    """A `truth` section for a file in `folder`; files by their paths relative to the folder."""
    content = robot.model_dump(mode="json", exclude_defaults=True)
    files, _ = with_files(robot, Path(source.file).parent, source)  # they were there when the file was loaded
    if "model" in files:
        content["model"] = relative_vehicle(files["model"], folder)
    if robot.car is not None:
        content["car"] = {"preset": robot.car.preset, **content["car"]}
    if "mjcf" in files:
        content["mjcf"] = os.path.relpath(files["mjcf"], os.path.realpath(folder))
    return content


def _model(reference: str, folder: Path) -> str:
    """Reference to the model for a file in `folder`; code in a file by its path relative to the folder."""
    relative = relative_vehicle(reference, folder)
    return relative if relative == reference else _text(relative)


# Written by hand: a Dumper of PyYAML that keeps this layout needs the same rules for quotes, flow style and digits, and
# more lines (it writes 1e-05 as !!float '1e-05', indents no list, and quotes other texts).
def _mapping(content: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Lines of a mapping: a value of plain numbers on one line, a matrix with one row on each line."""
    for key, value in content.items():
        label = f"{indent}{_text(key)}:"
        if isinstance(value, dict) and any(isinstance(item, dict | list) for item in value.values()):
            yield label
            yield from _mapping(value, indent + "  ")
        elif isinstance(value, list) and any(isinstance(item, dict | list) or " " in str(item) for item in value):
            yield label
            yield from (f"{indent}  - {_flow(item)}" for item in value)
        else:
            yield f"{label} {_flow(value)}"


def _flow(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_text(key)}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float | int):
        return f"{value:.9g}"
    return _text(value)


def _number(value: float) -> str:
    return f"{value + 0.0:.{DIGITS}g}"  # 0, not -0


def _text(text: str, *, flow: bool = True) -> str:
    """A text, plain if every YAML reader reads it as text, else quoted; `flow` if it is between braces."""
    if re.fullmatch(r"[0-9a-f]{64}", text):
        return f'"{text}"'  # a hash of digits alone would be read as a number
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_/^.-]*( [A-Za-z0-9_/^.,-]+)*", text) and not re.fullmatch(
        r"(?i)true|false|null|yes|no|on|off|y|n", text
    )
    return text if plain and not (flow and ", " in text) else json.dumps(text, ensure_ascii=False)


def identification_record(
    started_from: str,
    identification: Identification,
    split: LogSplit,
    evaluation: PredictionEvaluation,
    units: Mapping[str, CommandUnit] = MappingProxyType({}),
) -> IdentificationRecord:
    """Record of an identification for a vehicle file.

    Args:
        started_from: vehicle as the user gave it.
        identification: the result.
        split: the fitted and the held-out logs.
        evaluation: prediction errors of the logs.
        units: meaning of the numbers of commands in the logs.
    """
    unseen = evaluation.held_out
    converted = {name: CommandScale(neutral=u.neutral, scale=u.scale) for name, u in units.items() if not u.as_is}
    matrix = tuple(tuple(map(float, row)) for row in identification.covariance)
    return IdentificationRecord(
        started_from=started_from,
        interval=identification.interval,
        covariance=Covariance(names=identification.names, matrix=matrix),
        extras={name: _extra(identification, name) for name in identification.auxiliary},
        commands=converted or None,
        noise=PoseNoise(
            position=identification.noise.position,
            yaw=identification.noise.yaw,
            measured=identification.noise_measured,
        ),
        fitted=_prediction(evaluation.fitted.errors),
        held_out=None if unseen is None else _prediction(unseen.errors),
        held_out_before=None if unseen is None else _prediction(unseen.initial_errors),
        by_speed=() if unseen is None else errors_by_speed(unseen.identified),
        warnings=identification.warnings,
        logs=(*_logged(split.fitted, held_out=False), *_logged(split.held_out, held_out=True)),
        versions=versions(IDENTIFICATION),
    )


def _extra(identification: Identification, name: str) -> Extra:
    estimate = identification.parameters[name]
    return Extra(value=estimate.value, unit=estimate.unit, std=estimate.std, description=estimate.description)


def _prediction(errors: PredictionErrors) -> Prediction:
    return Prediction(
        position=tuple(errors.position[t] for t in sorted(errors.position)),
        yaw=tuple(errors.yaw[t] for t in sorted(errors.yaw)),
        overall_position=errors.overall_position,
        overall_yaw=errors.overall_yaw,
    )


def _logged(logs: Sequence[Log], *, held_out: bool) -> list[Logged]:
    return [Logged(name=log.name, held_out=held_out, files=_files(log)) for log in logs]


def _files(log: Log) -> dict[str, str]:
    """SHA-256 by file name, independent of the folder of the logs; by path if two files share a name."""
    names = [Path(source.file).name for source in log.sources]
    unique = len(set(names)) == len(names)
    return {(Path(s.file).name if unique else s.file): s.sha256 for s in log.sources}
