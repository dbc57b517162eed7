"""Whether what a vehicle file states fits its model: names of parameters and controls, units, the top speed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from kraft.config import bundled
from kraft.config.source import Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic
from kraft.text import suggestion
from kraft.vehicles.config import SPEED_EXPECTED, Parameter
from ompl_ext.vehicle import Vehicle


def fit_problems(model: Vehicle, reference: str, content: Mapping[str, object], source: Source) -> list[Diagnostic]:
    """Problems of the content of a vehicle file, as far as that is valid, beside its model.

    Args:
        model: the model.
        reference: reference of the file to the model's code.
        content: values of the file by key, of any type.
        source: positions in the file.
    """
    parameters, controls = _mapping(content.get("parameters")), _mapping(content.get("controls"))
    units = units_of(reference)
    problems = []
    for name, stated in parameters.items():
        if name not in model.parameters:
            expected = suggestion(name, model.parameters, none=f"{model.name} has no parameters")
            problem = f"{model.name} has no such parameter"
            problems.append(source.diagnostic(("parameters", name), problem, expected, at_key=True, code=Code.UNKNOWN))
        elif name in units and (unit := _unit(stated)) not in (None, units[name]):
            problem, expected = f"is {unit!r}", f"expected {units[name]!r}, the unit of the model"
            problems.append(source.diagnostic(("parameters", name, "unit"), problem, expected, code=Code.MISMATCH))
    for name in controls:
        if name not in model.controls:
            problem, expected = f"{model.name} has no such control", suggestion(name, model.controls)
            problems.append(source.diagnostic(("controls", name), problem, expected, at_key=True, code=Code.UNKNOWN))
    speed = content.get("top_speed")
    if isinstance(speed, str) and speed not in model.parameters:
        problems.append(source.diagnostic("top_speed", f"is the text {speed!r}", SPEED_EXPECTED, code=Code.UNKNOWN))
    return problems


def units_of(reference: str) -> Mapping[str, str]:
    """Units of the parameters of a model that has a bundled file; none for other code, which states no units."""
    return _bundled_units().get(reference, {}) if reference.startswith("kraft.") else {}


@cache
def _bundled_units() -> dict[str, dict[str, str]]:
    """Units of the parameters of all bundled vehicles, by the reference to their code."""
    found: dict[str, dict[str, str]] = {}
    for name in bundled.names("vehicle"):
        data = _mapping(read_document(bundled.folder("vehicle") / f"{name}.yaml").data)
        stated = {key: _unit(parameter) for key, parameter in _mapping(data.get("parameters")).items()}
        found[str(data.get("model"))] = {key: unit for key, unit in stated.items() if unit is not None}
    return found


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _unit(parameter: object) -> str | None:
    unit = parameter.unit if isinstance(parameter, Parameter) else _mapping(parameter).get("unit")
    return unit if isinstance(unit, str) else None
