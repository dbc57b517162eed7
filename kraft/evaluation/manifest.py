"""`manifest.json`: arguments, resolved configuration and versions of an evaluation, compared when it is resumed."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import kraft
import ompl_ext
from kraft.driving.control.user_controller import CODE_HASH, code_content
from kraft.driving.control_settings import UserCode
from kraft.driving.method import Method
from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation.experiment import Experiment
from kraft.evaluation.robots import robots_of
from kraft.planning.plan_file import vehicle_content
from kraft.provenance import MISSING, SIMULATION, difference_text, differences, plain, plain_hash, versions
from kraft.scenario import Scenario
from kraft.trial.robot_content import FILES, estimation_content

MANIFEST: Final = "manifest.json"
MANIFEST_SCHEMA: Final = "kraft.eval-manifest/1"
OTHERS: Final = {
    "kraft.drive-manifest/1": "a drive (kraft drive)",
    "kraft.run-manifest/1": "one trial (kraft run)",
}
"""What the other folders with a manifest are of, by its schema."""
DESCRIPTIVE: Final = ("arguments", "began", "host", "bounds_s", "warnings")
"""Keys that may differ when an evaluation is resumed."""
TEXTS: Final = ("title", "description")
"""Keys of scenarios and methods that no result depends on."""
SECTIONS: Final = ("scenarios", "methods", "vehicles")
"""Sections with one entry for each name."""
PACKAGES: Final = (Path(kraft.__file__).parent, Path(ompl_ext.__file__).parent)
"""Folders of `kraft` and `ompl_ext`."""
OF_TRIALS: Final = ("driving", "planning", "scenario", "simulation", "sysid", "trial", "vehicles")
"""Subpackages of `kraft` on which the results of trials depend, beside all of `ompl_ext`: also identification."""
SOURCE: Final = "source"
"""Key of the hash of the code on which they depend; older manifests have none."""
ROW_KEYS: Final = {"scenario", "method", "vehicle"}


def manifest_of(experiment: Experiment, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Content of the manifest; `arguments` are those of the user, as written."""
    cells = experiment.cells
    vehicles = {cell.reference: vehicle_content(cell.vehicle, cell.reference) for cell in cells}
    labels, robots = _labels({cell.reference: cell.vehicle.name for cell in cells}), robots_of(cells)
    for reference, content in vehicles.items():
        vehicle = next(cell.vehicle for cell in cells if cell.reference == reference)
        content["code"] = vehicle.hash
        content.update(estimation_content(vehicle))
        del content["reference"]  # the content of a file matters, not its path
    return {
        "schema": MANIFEST_SCHEMA,
        "arguments": dict(arguments),
        "began": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "trials": experiment.trials,
        "seed": experiment.seed,
        "realtime": experiment.realtime,
        "bounds_s": {entry: round(seconds, 6) for entry, seconds in experiment.bounds.items()},
        "warnings": list(experiment.warnings),
        "rows": [
            {
                "entry": cell.entry.name,
                "base": cell.entry.base,
                "scenario": cell.scenario.name,
                "reference": cell.entry.reference,
                "set": dict(cell.entry.settings),
                "method": cell.method.name,
                "title": cell.method.title,
                "vehicle": labels[cell.reference],
                "robot": robots[cell.key],
                "of_paper": cell.of_paper,
                **_score(cell.scenario),
            }
            for cell in cells
        ],
        "scenarios": {cell.entry.name: scenario_content(cell.scenario) for cell in cells},
        "methods": {cell.method.name: _hashed(_method(cell.method)) for cell in cells},
        "vehicles": {labels[reference]: _hashed(content) for reference, content in vehicles.items()},
        "versions": versions(SIMULATION),
        SOURCE: trial_code_hash(),
    }


def trial_code_hash() -> str:
    """SHA-256 of the code on which the results of trials depend: of a clone it changes within a version."""
    (package, planner), digest = PACKAGES, hashlib.sha256()
    for folder in (*(package / name for name in OF_TRIALS), planner):
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{folder.name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def scenario_content(scenario: Scenario) -> dict[str, Any]:
    """Content and SHA-256 of a scenario without its vehicle, which has a section of its own."""
    names = (f.name for f in fields(scenario) if f.compare and f.name not in ("vehicle", *TEXTS))
    return _hashed({name: plain(getattr(scenario, name)) for name in names})


def _score(scenario: Scenario) -> dict[str, Any]:
    """Score of a scenario as a part of its row, if it has one."""
    score = scenario.trial.score
    return {} if score is None else {"score": score.model_dump()}


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises:
        InputError: if the file cannot be read, is not a JSON object with this schema, or has no rows.
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
    if content["schema"] != MANIFEST_SCHEMA:
        if (made := OTHERS.get(content["schema"])) is not None:
            folder = "expected the results folder of an evaluation (kraft eval), which is what kraft report shows"
            raise InputError.of(str(path.parent), f"is the folder of {made}", folder, Code.MISMATCH)
        problem = f"has the schema {content['schema']!r}"
        raise InputError.of(str(path), problem, f"expected {MANIFEST_SCHEMA!r}", Code.MISMATCH)
    rows = content.get("rows")
    if not isinstance(rows, list) or not all(map(_is_row, rows)):
        raise InputError([Diagnostic(str(path), "is damaged", expected, path="rows", code=Code.SYNTAX)])
    return content


def _is_row(row: Any) -> bool:
    """Whether a row has its keys, and names as their values."""
    return isinstance(row, dict) and all(isinstance(row.get(key), str) for key in ROW_KEYS)


def check_continues(path: Path, was: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Check that a manifest is of the same evaluation, or of one that has more trials or methods now.

    Returns:
        Whether it has more now, so that `now` replaces the manifest at `path`.

    Raises:
        InputError: with every other difference.
    """
    before, after = _compared(was), _compared(now)
    grown = False
    if all(isinstance(before.get(name), dict) for name in SECTIONS):  # otherwise it is damaged, which is a difference
        _relabel_vehicles(before, after)
        grown = _remove_additions(was, now, before, after)
    _remove_uncommon_rows(before, after)
    _remove_uncommon_robots(before, after)
    _remove_unstated_source(before, after)
    differing = list(differences(before, after))
    if differing:
        raise InputError(
            Diagnostic(
                str(path),
                _difference(keys, before, after),
                _expected(keys, before),
                path=".".join(keys),
                code=Code.MISMATCH,
            )
            for keys, before, after in differing
        )
    return grown


def grown_manifest(was: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Manifest of an evaluation that has more trials or methods now; it began when, where and with the code it did."""
    kept = {key: was[key] for key in ("began", "host", SOURCE) if key in was}
    return {key: value for key, value in now.items() if key != SOURCE} | kept


@dataclass(frozen=True)
class Difference:
    """Value of a manifest that another one has otherwise, by its path; `MISSING` where one of them has none."""

    path: tuple[str, ...]
    one: Any
    other: Any


def manifest_differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Difference]:
    """What differs between two manifests, apart from rows, scenarios, methods and vehicles that only one has."""
    before, after = _compared(one), _compared(other)
    _relabel_vehicles(before, after)
    for section in ("rows", *SECTIONS):
        common = before.get(section, {}).keys() & after.get(section, {}).keys()  # older manifests have no methods
        for content in (before, after):
            content[section] = {name: value for name, value in content.get(section, {}).items() if name in common}
    _remove_uncommon_robots(before, after)
    _remove_unstated_source(before, after)
    return [Difference(*found) for found in differences(before, after)]


def _relabel_vehicles(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Give vehicles of `before` their labels in `after`: one that has the name of an added vehicle got a longer one."""
    for row in before["rows"].keys() & after["rows"].keys():
        label, new = before["rows"][row], after["rows"][row]
        was = before["vehicles"].get(label)
        if label != new and was is not None and was == after["vehicles"].get(new):
            before["vehicles"][new] = before["vehicles"].pop(label)
            before["rows"] = {each: new if given == label else given for each, given in before["rows"].items()}


def _remove_additions(
    was: Mapping[str, Any], now: Mapping[str, Any], before: Mapping[str, Any], after: dict[str, Any]
) -> bool:
    """Remove from `after` what an evaluation may get more of: trials, and methods with their vehicles.

    Returns:
        Whether there was any.
    """
    added = after["methods"].keys() - {row["method"] for row in was["rows"]}
    used = {row["vehicle"] for row in now["rows"] if row["method"] not in added}
    for name in added:
        del after["methods"][name]
    for label in after["vehicles"].keys() - before["vehicles"].keys() - used:
        del after["vehicles"][label]
    more = isinstance(before.get("trials"), int) and 1 <= before["trials"] < after["trials"]
    if more:
        after["trials"] = before["trials"]
    return bool(added) or more


def _remove_uncommon_rows(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Remove rows of one side alone, with the vehicles that only these have: their scenario or method is reported."""
    common = before["rows"].keys() & after["rows"].keys()
    for content, other in ((before, after), (after, before)):
        uncommon = {content["rows"].pop(row) for row in content["rows"].keys() - common}
        if isinstance(content.get("vehicles"), dict) and isinstance(other.get("vehicles"), dict):
            for label in uncommon - set(content["rows"].values()) - other["vehicles"].keys():
                content["vehicles"].pop(label, None)


def _remove_uncommon_robots(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Keep the true robots of rows that state them on both sides, and of those that differ alike the first one.

    Older manifests state none.
    """
    one, other = before["robots"], after["robots"]
    kept: dict[str, str] = {}
    for row in one:
        if row in other:
            kept.setdefault(json.dumps([one[row], other[row]], sort_keys=True), row)
    for content, robots in ((before, one), (after, other)):
        content["robots"] = {row: robots[row] for row in kept.values()}


def _remove_unstated_source(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Remove the hash of the code where only one of the two has one."""
    if SOURCE not in before or SOURCE not in after:
        for content in (before, after):
            content.pop(SOURCE, None)


def _compared(content: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that must be equal, as read back from JSON; vehicles and true robots by the name of their row.

    The order of the rows does not matter.
    """
    kept = {key: value for key, value in content.items() if key not in DESCRIPTIVE}
    names = {f"{row.get('entry', row['scenario'])}, {row['method']}": row for row in kept["rows"]}
    rows = {name: row["vehicle"] for name, row in names.items()}
    robots = {name: row["robot"] for name, row in names.items() if "robot" in row}
    result: dict[str, Any] = json.loads(json.dumps({**kept, "rows": rows, "robots": robots}))
    return result


def _difference(keys: tuple[str, ...], before: Any, after: Any) -> str:
    """Message about a difference."""
    part = f"{keys[0].removesuffix('s')} {keys[-1]}"
    known = keys[0] in SECTIONS and len(keys) == 2
    if known and before is MISSING:
        return f"{part} is not in the folder's evaluation"
    if keys[-1] == CODE_HASH and MISSING not in (before, after):
        return "the file of the controller's code has changed"
    if keys[0] == SOURCE:
        return "the code of kraft that trials run has changed"
    if keys[0] == "robots" and keys[-1] == "sha256":
        file = f"{keys[-2]}, a file" if keys[-3] == FILES else "the file"
        return f"{file} of the true robot has changed"
    return f"{part} is missing now" if known and after is MISSING else difference_text(before, after)


def _expected(keys: tuple[str, ...], before: Any) -> str:
    """What a resumed evaluation may have instead."""
    if keys == ("trials",):
        return f"expected at least {before}, or another folder"
    if keys[0] == "methods" and len(keys) == 2:
        return "expected it among the methods, as they may become more but not fewer, or another folder"
    if keys[-1] == CODE_HASH:
        return "expected no change, or another folder for this method; kraft compare shows two folders together"
    if keys[0] == SOURCE:
        return "expected that of the folder's trials, or another folder; kraft compare shows two folders together"
    return "expected no change, or another folder"


def _labels(names: Mapping[str, str]) -> dict[str, str]:
    """Label of each reference: the vehicle's name, or the reference where two vehicles have the same name."""
    counts = list(names.values())
    return {reference: name if counts.count(name) == 1 else reference for reference, name in names.items()}


def _method(method: Method) -> dict[str, Any]:
    content = method.model_dump(mode="json", exclude=set(TEXTS))
    if isinstance(method.controller, UserCode):
        content["controller"] |= code_content(method.controller)
    return content


def _hashed(content: Any) -> dict[str, Any]:
    return {"sha256": plain_hash(content), "content": content}
