"""JSON Schemas of the configuration files, for editors.

``python -m kraft_cli.work.json_schema`` writes them into the folders of the bundled files; each bundled file
names its schema in its first line, for completion and checks in editors.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from kraft.config import bundled
from kraft.driving.method import METHOD_FILES, Method
from kraft.evaluation.suite import SuiteFile
from kraft.logs.mapping import Mapping
from kraft.robot.robot_file import Robot
from kraft.scenario.schema import ScenarioFile
from kraft.vehicles.config import VehicleConfig

DIALECT = "https://json-schema.org/draft/2020-12/schema"
BASED: Final = frozenset({Method})
"""Models of files that may have the key `base`."""
PARTIAL: Final = "Partial"
"""End of the names of definitions without required keys, for files with a base."""


def files() -> dict[Path, type[BaseModel]]:
    """Each schema file and its model."""
    return {
        bundled.folder("scenario") / "scenario.schema.json": ScenarioFile,
        bundled.folder("vehicle") / "vehicle.schema.json": VehicleConfig,
        bundled.folder("method") / "method.schema.json": Method,
        bundled.folder("suite") / "suite.schema.json": SuiteFile,
        bundled.folder("robot") / "robot.schema.json": Robot,
        bundled.root() / "configs" / "logs" / "mapping.schema.json": Mapping,
    }


def text(model: type[BaseModel]) -> str:
    """JSON Schema of a model as text."""
    schema = model.model_json_schema()
    content: dict[str, Any] = {"$schema": DIALECT, **(_with_base(schema) if model in BASED else schema)}
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _with_base(schema: dict[str, Any]) -> dict[str, Any]:
    """Schema of files that may have a base: with one, only their own keys are required."""
    definitions = {f"{name}{PARTIAL}": _partial(part) for name, part in schema["$defs"].items()}
    own = [name for name in schema["required"] if name in METHOD_FILES.own]
    return {
        **_partial({key: value for key, value in schema.items() if key != "$defs"}),
        "$defs": {**schema["$defs"], **definitions},
        "required": own,
        "if": {"properties": {"base": {"type": "string"}}, "required": ["base"]},
        "else": {"properties": schema["properties"], "required": schema["required"]},
    }


def _partial(schema: Any) -> Any:
    """Schema in which no key is required; a mapping without its `kind` may be of any of its kinds."""
    if isinstance(schema, list):
        return [_partial(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    found: dict[str, Any] = {}
    for key, value in schema.items():
        if key in ("required", "discriminator") and not isinstance(value, str):
            continue
        if key == "$ref":
            found[key] = f"{value}{PARTIAL}"
        elif key == "properties":  # its keys are names
            found[key] = {name: _partial(each) for name, each in value.items()}
        else:
            found["anyOf" if key == "oneOf" else key] = _partial(value)
    return found


if __name__ == "__main__":
    for path, model in files().items():
        path.write_text(text(model), encoding="utf-8")
        print(path)
