"""The plan file: everything about a plan that planning it again would need, as JSON that a person can read.

The same seed and iterations give the same bytes: nothing in it depends on the clock.  Numbers are written so that
reading them gives the same doubles.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from kraft.errors import InputError
from kraft.files import check_writable, write_whole
from kraft.plan_file_reader import SCHEMA, plan_from, read_object
from kraft.planning import PlanResult
from kraft.previous import Previous
from kraft.provenance import PLANNING, plain_hash, versions
from kraft.scenario import Task
from kraft.workspace import settings_of
from ompl_ext.plan import Plan
from ompl_ext.vehicle import Vehicle

NAME: Final = "plan.json"


@dataclass(frozen=True)
class Origin:
    """How the things that were planned with were named: enough to name them again."""

    scenario: str
    vehicle: str
    previous: Previous | None = None


def write_plan(path: Path, task: Task, vehicle: Vehicle, result: PlanResult, origin: Origin) -> None:
    """Write the plan of a result in one step, in place of an earlier plan file at `path`.

    Raises:
        InputError: if something else than a plan file is there, or it cannot be written.
    """
    check_target(path)
    write_whole(path, plan_text(task, vehicle, result, origin).encode())


def check_target(path: Path) -> None:
    """Refuse to replace a file that is not a plan file, and a place that cannot be written.

    Raises:
        InputError: if there is such a file, or a folder, or no permission.
    """
    check_writable(path)
    if path.exists():
        try:
            read_object(path)
        except InputError:
            problem = "there is a file that is not a plan file"
            raise InputError.of(str(path), problem, "expected a folder without it, or an earlier plan") from None


def read_plan(path: Path) -> Plan:
    """Read the plan of a plan file.

    Raises:
        InputError: if it is not a plan file or something in it is missing, misshapen, or not a finite number.
    """
    return plan_from(path)


def planned_scenario(path: Path) -> str | None:
    """Name of the scenario that a plan file says its plan is for; None if it does not say.

    Raises:
        InputError: if it is not a plan file.
    """
    scenario = read_object(path).get("scenario")
    name = scenario.get("name") if isinstance(scenario, dict) else None
    return name if isinstance(name, str) else None


def plan_text(task: Task, vehicle: Vehicle, result: PlanResult, origin: Origin) -> str:
    """Content of the plan file of a result that has a plan."""
    plan = result.plan
    if plan is None:
        raise ValueError("there is no plan to write")
    content = {
        "schema": SCHEMA,
        "scenario": {"name": task.name, "reference": origin.scenario, "sha256": task_hash(task)},
        "vehicle": vehicle_content(vehicle, origin.vehicle),
        "planner": task.planning.planner,
        "seed": result.seed,
        "iterations": result.progress.iterations,
        "settings": {**asdict(settings_of(task)), **_planning(task)},
        "from": _previous(origin.previous),
        "goal": {"center": list(task.goal.center), "radius": task.goal.radius, "reached": plan.reaches_goal},
        "cost": plan.cost,
        "cost_to_go": plan.cost_to_go,
        "durations": plan.durations.tolist(),
        "controls": plan.controls.tolist(),
        "states": plan.states.tolist(),
        "times": plan.times.tolist(),
        "trajectory": plan.trajectory.tolist(),
        "contingency": _contingency(plan),
        "versions": versions(PLANNING),
    }
    return dumps(content) + "\n"


def task_hash(task: Task) -> str:
    """Hash over what the planner is told: geometry, start, goal, settings; not names of files or comments."""
    told = {f.name: getattr(task, f.name) for f in fields(Task) if f.name not in ("source", "vehicle")}
    return plain_hash(told)


def vehicle_content(vehicle: Vehicle, reference: str) -> dict[str, Any]:
    """A vehicle as plain data; `reference` is how it was named."""
    return {
        "name": vehicle.name,
        "reference": reference,
        "state": list(vehicle.state),
        "controls": {name: list(bounds) for name, bounds in vehicle.controls.items()},
        "parameters": dict(vehicle.parameters),
        "footprint": asdict(vehicle.footprint),
        "top_speed": vehicle.top_speed,
    }


def dumps(content: Mapping[str, Any]) -> str:
    """JSON with one line per entry and per row of a table."""
    return _indented(content, "")


def _indented(value: Any, indent: str) -> str:
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = (f"{inner}{json.dumps(key)}: {_indented(item, inner)}" for key, item in value.items())
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n" + ",\n".join(inner + json.dumps(row, allow_nan=False) for row in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _planning(task: Task) -> dict[str, Any]:
    planning = task.planning
    return {
        "cycle": planning.cycle,
        "integration_step": planning.integration_step,
        "safety": planning.safety.model_dump(),
    }


def _previous(previous: Previous | None) -> dict[str, Any] | None:
    if previous is None:
        return None
    content = np.concatenate([previous.plan.controls.ravel(), previous.plan.durations])
    return {"file": previous.origin, "after": previous.elapsed, "sha256": hashlib.sha256(content.tobytes()).hexdigest()}


def _contingency(plan: Plan) -> dict[str, Any] | None:
    stop = plan.contingency
    if stop is None:
        return None
    return {
        "manoeuvre": stop.manoeuvre,
        "spare": _finite(stop.spare),
        "times": stop.times.tolist(),
        "states": stop.states.tolist(),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
