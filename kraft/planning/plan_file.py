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

from kraft.config.validation import describe
from kraft.errors import Diagnostic, InputError
from kraft.files import check_writable, write_whole
from kraft.planning.plan_task import PlanResult
from kraft.planning.search import Previous
from kraft.planning.workspace import settings_of
from kraft.provenance import PLANNING, plain_hash, versions
from kraft.scenario import Task
from ompl_ext.arrays import Floats
from ompl_ext.plan import Contingency, Plan
from ompl_ext.vehicle import Vehicle

NAME: Final = "plan.json"
SCHEMA: Final = "kraft.plan-file/1"
SIZE_MAX: Final = 256 * 1024 * 1024  # bytes
TOLERANCE: Final = 1e-6  # s, between numbers that say the same thing twice


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
    check_plan_target(path)
    write_whole(path, plan_text(task, vehicle, result, origin).encode())


def check_plan_target(path: Path) -> None:
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


def read_plan(path: Path) -> Plan:
    """Read the plan of a plan file.

    Raises:
        InputError: if it is not a plan file or something in it is missing, misshapen, or not a finite number.
    """
    return plan_from(path)


def plan_from(path: Path) -> Plan:
    """Read and check a plan file.

    Raises:
        InputError: with every problem of the file.
    """
    reader = _Reader(str(path), read_object(path))
    plan = reader.plan()
    if reader.problems or plan is None:
        raise InputError(reader.problems)
    return plan


def planned_scenario(path: Path) -> str | None:
    """Name of the scenario that a plan file says its plan is for; None if it does not say.

    Raises:
        InputError: if it is not a plan file.
    """
    scenario = read_object(path).get("scenario")
    name = scenario.get("name") if isinstance(scenario, dict) else None
    return name if isinstance(name, str) else None


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON object that says it is a plan file.

    Raises:
        InputError: if the file cannot be read or is something else.
    """
    expected = f"expected a plan file ({SCHEMA}), as `kraft plan --out` writes it"
    try:
        if path.stat().st_size > SIZE_MAX:
            raise InputError.of(str(path), f"is larger than {SIZE_MAX >> 20} MiB", expected)
        content = json.loads(path.read_bytes().decode("utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise InputError.of(str(path), "there is no such file", expected) from None
    except OSError as error:
        raise InputError.of(str(path), f"cannot be read: {error.strerror}", expected) from None
    except json.JSONDecodeError as error:
        problem = f"is not JSON: {error.msg}"
        raise InputError([Diagnostic(str(path), problem, expected, error.lineno, error.colno)]) from None
    except (ValueError, RecursionError) as error:  # not UTF-8, a number that is not finite, nested without end
        raise InputError.of(str(path), f"is not JSON: {error}", expected) from None
    if not isinstance(content, dict):
        raise InputError.of(str(path), f"holds {describe(content)}", expected)
    if content.get("schema") != SCHEMA:
        found = describe(content["schema"]) if "schema" in content else "missing"
        raise InputError([Diagnostic(str(path), f"is {found}", f"expected {SCHEMA!r}", path="schema")])
    return content


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a finite number")


class _Reader:
    """Takes arrays out of a plan file and notes every problem on the way."""

    def __init__(self, file: str, content: dict[str, Any]) -> None:
        self.file, self.content = file, content
        self.problems: list[Diagnostic] = []

    def plan(self) -> Plan | None:
        durations = self.array("durations", (None,))
        n = len(durations) if durations is not None else None
        controls = self.array("controls", (n, None))
        states = self.array("states", (n + 1 if n is not None else None, None))
        nx = states.shape[1] if states is not None else None
        times = self.array("times", (None,))
        trajectory = self.array("trajectory", (len(times) if times is not None else None, nx))
        cost, cost_to_go, reached = self.number("cost"), self.number("cost_to_go"), self.flag("goal.reached")
        contingency = self.contingency(nx)
        if durations is None or controls is None or states is None or times is None or trajectory is None:
            return None
        self.check_times(durations, times, cost)
        return Plan(states, controls, durations, times, trajectory, cost, cost_to_go, reached, contingency)

    def contingency(self, nx: int | None) -> Contingency | None:
        if self.find("contingency") is None:
            return None
        times = self.array("contingency.times", (None,))
        states = self.array("contingency.states", (len(times) if times is not None else None, nx))
        name = self.find("contingency.manoeuvre")
        if not isinstance(name, str):
            self.report("contingency.manoeuvre", f"is {describe(name)}", "expected text")
        spare = self.find("contingency.spare")
        clearance = np.inf if spare is None else self.number("contingency.spare")
        return None if times is None or states is None else Contingency(str(name), times, states, clearance)

    def check_times(self, durations: Floats, times: Floats, cost: float) -> None:
        if not np.all(durations > 0):
            k = int(np.argmin(durations))
            self.report(f"durations[{k}]", f"is {durations[k]:g}", "expected a duration greater than 0")
        if len(times) == 0 or times[0] != 0.0 or not np.all(np.diff(times) > 0):
            self.report("times", "do not increase from 0", "expected the times of the trajectory's states")
        elif abs(times[-1] - durations.sum()) > TOLERANCE or abs(cost - durations.sum()) > TOLERANCE:
            problem = f"times end at {times[-1]:g} s, cost is {cost:g} s, durations last {durations.sum():g} s"
            self.report("cost", problem, "expected the same three times")

    def array(self, path: str, shape: tuple[int | None, ...]) -> Any:
        """The numbers at a path as an array of `shape` (None: any length), or None after a report."""
        value = self.find(path)
        wanted = " x ".join("n" if length is None else str(length) for length in shape)
        array = _table(value)
        if array.ndim != len(shape) or 0 in array.shape:
            self.report(path, f"is not a table of numbers of {wanted}", "expected lists of equal length")
        elif any(length not in (None, found) for length, found in zip(shape, array.shape, strict=True)):
            found = " x ".join(str(length) for length in array.shape)
            self.report(path, f"has {found} numbers", f"expected {wanted}")
        elif not np.all(np.isfinite(array)):
            self.report(path, "holds a number that is not finite", "expected finite numbers")
        else:
            return array
        return None

    def number(self, path: str) -> float:
        value = self.find(path)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value) or value < 0:
            self.report(path, f"is {describe(value)}", "expected a number of at least 0")
            return 0.0
        return float(value)

    def flag(self, path: str) -> bool:
        value = self.find(path)
        if not isinstance(value, bool):
            self.report(path, f"is {describe(value)}", "expected true or false")
        return value is True

    def find(self, path: str) -> Any:
        """The value at a dotted path; None, after a report, where there is none."""
        value: Any = self.content
        parts = path.split(".")
        for i, key in enumerate(parts):
            if not isinstance(value, dict) or key not in value:
                self.report(".".join(parts[: i + 1]), "the key is missing", "expected it in a plan file")
                return None
            value = value[key]
        return value

    def report(self, path: str, problem: str, expected: str) -> None:
        if not any(d.path == path for d in self.problems):  # what is missing is not also misshapen
            self.problems.append(Diagnostic(self.file, problem, expected, path=path))


def _table(value: Any) -> Floats:
    """Nested lists of numbers as an array; of no dimension if they are anything else."""
    rows = value if isinstance(value, list) else [None]
    items = [item for row in rows for item in (row if isinstance(row, list) else [row])]
    if any(isinstance(item, bool) or not isinstance(item, int | float) for item in items):
        return np.array(np.nan)
    try:
        return np.array(value, dtype=float)
    except (ValueError, OverflowError):  # rows of different lengths, an integer beyond every double
        return np.array(np.nan)
