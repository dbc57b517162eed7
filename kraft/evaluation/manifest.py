"""`manifest.json`: what running the evaluation again would need, and what must be the same to go on with it."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from kraft.driving.method import Method
from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation.experiment import Experiment
from kraft.planning.plan_file import vehicle_content
from kraft.provenance import SIMULATION, plain, plain_hash, versions
from kraft.scenario import Scenario

NAME: Final = "manifest.json"
SCHEMA: Final = "kraft.eval-manifest/1"
DESCRIPTIVE: Final = ("arguments", "began", "host")
"""keys that may differ when an evaluation is gone on with"""
TEXTS: Final = ("title", "description")
"""keys of scenarios and methods that nothing depends on"""
SECTIONS: Final = ("scenarios", "methods", "vehicles")
"""sections with an entry for each"""
MISSING: Final = object()


def manifest_of(experiment: Experiment, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Content of the manifest; `arguments` is what was asked for, as it was written."""
    cells = experiment.cells
    vehicles = {cell.reference: vehicle_content(cell.vehicle, cell.reference) for cell in cells}
    labels = _labels({cell.reference: cell.vehicle.name for cell in cells})
    for reference, content in vehicles.items():
        content["code"] = next(cell.vehicle.hash for cell in cells if cell.reference == reference)
        del content["reference"]  # where a file is does not matter, what it says does
    return {
        "schema": SCHEMA,
        "arguments": dict(arguments),
        "began": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "trials": experiment.trials,
        "seed": experiment.seed,
        "realtime": experiment.realtime,
        "rows": [
            {
                "scenario": cell.scenario.name,
                "method": cell.method.name,
                "title": cell.method.title,
                "vehicle": labels[cell.reference],
            }
            for cell in cells
        ],
        "scenarios": {cell.scenario.name: scenario_entry(cell.scenario) for cell in cells},
        "methods": {cell.method.name: _hashed(_method(cell.method)) for cell in cells},
        "vehicles": {labels[reference]: _hashed(content) for reference, content in vehicles.items()},
        "versions": versions(SIMULATION),
    }


def scenario_entry(scenario: Scenario) -> dict[str, Any]:
    """A scenario without its vehicle, which has a section of its own: `content`, and its hash `sha256`."""
    names = (f.name for f in fields(scenario) if f.compare and f.name not in ("vehicle", *TEXTS))
    return _hashed({name: plain(getattr(scenario, name)) for name in names})


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises:
        InputError: if it is not one.
    """
    expected = "expected a manifest as kraft eval writes it"
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError.of(str(path), f"cannot be read: {error.strerror}", expected, Code.UNREADABLE) from None
    except (ValueError, RecursionError) as error:
        raise InputError.of(str(path), f"is not JSON: {error}", expected, Code.SYNTAX) from None
    if not isinstance(content, dict) or not isinstance(content.get("schema"), str):
        raise InputError.of(str(path), "has no schema", expected, Code.MISSING)
    return content


def check_same(path: Path, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that an evaluation can be gone on with.

    Raises:
        InputError: with every field that differs.
    """
    before, after = _compared(was), _compared(now)
    for rows in (before["rows"], after["rows"]):  # what only one of them has is said by its scenario or method
        for row in rows.keys() - (before["rows"].keys() & after["rows"].keys()):
            del rows[row]
    differing = list(_differences(before, after))
    if differing:
        raise InputError(
            Diagnostic(
                str(path),
                _difference(key, before, after),
                "expected the same, or another folder",
                path=key,
                code=Code.MISMATCH,
            )
            for key, before, after in differing
        )


def _compared(content: Mapping[str, Any]) -> dict[str, Any]:
    """What must be the same, as it reads back from JSON; the order of the rows need not be."""
    kept = {key: value for key, value in content.items() if key not in DESCRIPTIVE}
    rows = {f"{row['scenario']}, {row['method']}": row["vehicle"] for row in kept["rows"]}
    result: dict[str, Any] = json.loads(json.dumps({**kept, "rows": rows}))
    return result


def _differences(was: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Path and both values of everything that differs; hashes only where nothing else tells."""
    if isinstance(was, dict) and isinstance(now, dict):
        found = [
            difference
            for key in {**was, **now}
            for difference in _differences(was.get(key, MISSING), now.get(key, MISSING), f"{path}.{key}".lstrip("."))
        ]
        of_values = [difference for difference in found if not difference[0].endswith(".sha256")]
        yield from of_values or found
    elif was != now:
        yield path, was, now


def _difference(key: str, before: Any, after: Any) -> str:
    """What is different at a key, in words."""
    section, _, name = key.partition(".")
    part = f"{section.removesuffix('s')} {name}"
    known = section in SECTIONS and "." not in name
    if before is MISSING:
        return f"{part} is not part of it" if known else f"was made without it, now it is {_json(after)}"
    if after is MISSING:
        return f"{part} is part of it, but left out now" if known else f"was made with {_json(before)}, now without"
    return f"was made with {_json(before)}, now it is {_json(after)}"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _labels(names: Mapping[str, str]) -> dict[str, str]:
    """A label for each reference: the vehicle's name, or the reference where two have the same name."""
    counts = list(names.values())
    return {reference: name if counts.count(name) == 1 else reference for reference, name in names.items()}


def _method(method: Method) -> dict[str, Any]:
    return method.model_dump(mode="json", exclude=set(TEXTS))


def _hashed(content: Any) -> dict[str, Any]:
    return {"sha256": plain_hash(content), "content": content}
