"""JSON Schemas of the configuration files, for editors.

``python -m kraft_cli.work.json_schema`` writes them into the folders of the bundled files; each bundled file
names its schema in its first line, for completion and checks in editors.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from kraft.config import bundled
from kraft.driving.method import Method
from kraft.evaluation.suite import SuiteFile
from kraft.logs.mapping import Mapping
from kraft.robot.robot_file import Robot
from kraft.scenario.schema import ScenarioFile
from kraft.vehicles.config import VehicleConfig

DIALECT = "https://json-schema.org/draft/2020-12/schema"


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
    schema: dict[str, Any] = {"$schema": DIALECT, **model.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for path, model in files().items():
        path.write_text(text(model), encoding="utf-8")
        print(path)
