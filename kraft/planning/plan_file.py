"""Plan file: a plan with everything needed to plan it again, as readable JSON.

The same seed and iterations give the same bytes: nothing in it depends on the clock.  Reading a number gives the double
that was written.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeGuard

import numpy as np
from pydantic import Field
from pydantic_core import PydanticCustomError

from kraft.config.document import Document, frozen
from kraft.config.json_reader import read_json
from kraft.config.schema import NonNegative, Positive, StrictModel, check, describe, refuse
from kraft.errors import Code, InputError
from kraft.files import check_writable, write_whole
from kraft.planning.plan import PlanResult
from kraft.planning.search import Previous
from kraft.provenance import PLANNING, plain_hash, versions
from kraft.scenario import Task
from kraft.text import counted, finite
from ompl_ext.plan import Contingency, Plan
from ompl_ext.vehicle import Vehicle

NAME: Final = "plan.json"
SCHEMA: Final = "kraft.plan-file/1"
SIZE_MAX: Final = 256 * 1024 * 1024
"""Largest size of a plan file that is read, bytes."""
EXPECTED: Final = f"expected a plan file ({SCHEMA})"
TOLERANCE: Final = 1e-6
"""Largest difference between redundant numbers, s."""


Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Times = Annotated[tuple[NonNegative, ...], Field(min_length=1)]
Row = Annotated[tuple[Number, ...], Field(min_length=1)]
Table = Annotated[tuple[Row, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Origin:
    """References to the scenario, the vehicle and the previous plan, as they were given.

    `settings` are the values of the scenario's keys that were set.
    """

    scenario: str
    vehicle: str
    previous: Previous | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


def write_plan(path: Path, task: Task, vehicle: Vehicle, result: PlanResult, origin: Origin) -> None:
    """Write the plan file of a result atomically; it replaces an earlier plan file.

    Raises:
        InputError: if another file is at `path`, or it cannot be written.
    """
    check_plan_target(path)
    write_whole(path, plan_text(task, vehicle, result, origin).encode())


def check_plan_target(path: Path) -> None:
    """Check that a plan file can be written at `path`.

    Raises:
        InputError: if a file that is not a plan file, or a folder, is there, or it cannot be written.
    """
    check_writable(path)
    if path.exists():
        try:
            _read_document(path)
        except InputError:
            problem, expected = (
                "there is a file that is not a plan file",
                "expected a folder without it, or an earlier plan",
            )
            raise InputError.of(str(path), problem, expected, Code.EXISTS) from None


def plan_text(task: Task, vehicle: Vehicle, result: PlanResult, origin: Origin) -> str:
    """Content of the plan file of a result that has a plan."""
    plan = result.plan
    if plan is None:
        raise ValueError("there is no plan to write")
    changed = {"set": dict(origin.settings)} if origin.settings else {}
    content = {
        "schema": SCHEMA,
        "scenario": {"name": task.name, "reference": origin.scenario, "sha256": task_hash(task), **changed},
        "vehicle": vehicle_content(vehicle, origin.vehicle),
        "planner": task.planning.planner,
        "seed": result.seed,
        **({"threads": result.threads} if result.threads > 1 else {}),
        "iterations": result.progress.iterations,
        "settings": {**asdict(result.settings), **_planning(task)},
        "from": _previous(origin.previous),
        "goal": _goal(task, plan),
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
    """Hash of the input of the planner: geometry, start, goal, settings; not names of files or comments."""
    known = {f.name: getattr(task, f.name) for f in fields(Task) if f.name not in ("source", "vehicle")}
    return plain_hash(known)


def vehicle_content(vehicle: Vehicle, reference: str) -> dict[str, Any]:
    """Vehicle as plain data, with Python's numbers for those of numpy; `reference` is how it was named."""
    return {
        "name": vehicle.name,
        "reference": reference,
        "state": list(vehicle.state),
        "controls": {name: list(map(frozen, bounds)) for name, bounds in vehicle.controls.items()},
        "parameters": frozen(vehicle.parameters),
        "footprint": frozen(asdict(vehicle.footprint)),
        "top_speed": frozen(vehicle.top_speed),
    }


def dumps(content: Mapping[str, Any]) -> str:
    """JSON text with one line per entry, per row of a table and per `ON_A_LINE` values of a long list."""
    return _indented(content, "")


def _indented(value: Any, indent: str) -> str:
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = (f"{inner}{json.dumps(key)}: {_indented(item, inner)}" for key, item in value.items())
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n" + ",\n".join(inner + json.dumps(row, allow_nan=False) for row in value) + f"\n{indent}]"
    if isinstance(value, list) and len(value) > ON_A_LINE:
        parts = [json.dumps(value[k : k + ON_A_LINE], allow_nan=False) for k in range(0, len(value), ON_A_LINE)]
        return "[\n" + ",\n".join(inner + part[1:-1] for part in parts) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


ON_A_LINE = 100
"""Number of values of a list on a line."""


def _goal(task: Task, plan: Plan) -> dict[str, Any]:
    goal = task.goal
    content: dict[str, Any] = {"center": list(goal.center), "radius": goal.radius, "reached": plan.reaches_goal}
    if goal.heading is not None:
        content |= {"heading": goal.heading, "heading_tolerance": goal.heading_tolerance}
    if goal.limits:
        content["limits"] = {name: list(interval) for name, interval in goal.limits.items()}
    return content


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
        "spare": finite(stop.slack),
        "times": stop.times.tolist(),
        "states": stop.states.tolist(),
    }


def read_plan_file(path: Path) -> PlanFile:
    """Read and check a plan file.

    Raises:
        InputError: with every problem of the file.
    """
    content, problems = check(PlanFile, _read_document(path))
    if content is None:
        raise InputError(problems)
    return content


def read_plan(path: Path) -> Plan:
    """Read the plan of a plan file.

    Raises:
        InputError: with every problem of the file.
    """
    return read_plan_file(path).plan()


def _read_document(path: Path) -> Document:
    """Content of a file whose schema is that of a plan file.

    Raises:
        InputError: if it cannot be read, is not JSON, or has another schema.
    """
    document = read_json(path, SIZE_MAX, EXPECTED)
    if not isinstance(document.data, dict):
        raise InputError.of(str(path), f"holds {describe(document.data)}", EXPECTED, Code.MISMATCH)
    schema = document.data.get("schema")
    if schema != SCHEMA:
        problem = f"is {describe(schema)}" if "schema" in document.data else "the key is missing"
        raise InputError([document.source.diagnostic("schema", problem, f"expected {SCHEMA!r}", code=Code.MISMATCH)])
    return document


class PlannedScenario(StrictModel):
    """Scenario that the plan is for."""

    name: str | None = None
    """its name"""
    reference: str | None = None
    """how it was named"""
    set: dict[str, Any] = Field(default_factory=dict)
    """values of its keys that were set"""
    sha256: str | None = None
    """hash of the input of the planner"""


class PlannedVehicle(StrictModel):
    """Vehicle that the plan is for."""

    name: object = None
    """its name"""
    reference: object = None
    """how it was named"""
    state: tuple[str, ...] | None = None
    """names of the components of its state"""
    controls: Mapping[str, object] | None = None
    """names of its controls, with their bounds"""
    parameters: object = None
    """values of its parameters"""
    footprint: object = None
    """{length, width, offset}, m"""
    top_speed: object = None
    """its top speed, m/s"""


class PlannedGoal(StrictModel):
    """Goal region that the plan is for."""

    center: object = None
    """[x, y] of the centre, m"""
    radius: object = None
    """distance from the centre that counts as arrived, m"""
    heading: object = None
    """heading there, rad"""
    heading_tolerance: object = None
    """deviation from the heading that counts as arrived, rad"""
    limits: object = None
    """lowest and highest value there of further components of the state"""
    reached: bool
    """whether the plan ends in the goal region"""


class PlannedContingency(StrictModel):
    """Manoeuvre that stops the vehicle where the plan leaves its first cycle."""

    manoeuvre: str
    """name of the manoeuvre"""
    spare: NonNegative | None
    """clearance beyond the one that is required, m; null without obstacles"""
    times: Times
    """times of the states, s"""
    states: Table
    """states [n, nx]"""


class PlanFile(StrictModel):
    """Content of a plan file; fields of type `object` are recorded for people and not read."""

    schema_: Annotated[Literal["kraft.plan-file/1"], Field(alias="schema")]
    """kind and version of the file"""
    scenario: PlannedScenario = PlannedScenario()
    """scenario {name, reference, sha256}"""
    vehicle: PlannedVehicle = PlannedVehicle()
    """the vehicle {name, reference, state, controls, parameters, footprint, top_speed}"""
    planner: object = None
    """name of the planner"""
    seed: object = None
    """seed of the random generator"""
    threads: object = None
    """number of trees grown at the same time"""
    iterations: object = None
    """iterations of the search"""
    settings: object = None
    """settings of the planner"""
    from_: Annotated[object, Field(alias="from")] = None
    """the previous plan"""
    goal: PlannedGoal
    """goal region {center, radius, reached}"""
    cost: NonNegative
    """duration of the plan, s"""
    cost_to_go: NonNegative
    """estimated time from the end of the plan to the goal, s"""
    durations: tuple[Positive, ...]
    """duration of each edge [n], s; none if the start is in the goal"""
    controls: tuple[Row, ...]
    """control of each edge [n, nu]"""
    states: Table
    """states between the edges [n + 1, nx]"""
    times: Times
    """times of the trajectory [m], s"""
    trajectory: Table
    """states at these times [m, nx]"""
    contingency: PlannedContingency | None
    """manoeuvre that stops the vehicle {manoeuvre, spare, times, states}"""
    versions: object = None
    """versions of the software"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the tables have the sizes that their keys require of each other, and that the times agree."""
        durations, samples = content.get("durations"), _length(content.get("times"))
        edges = len(durations) if isinstance(durations, tuple) else None
        if edges and content.get("controls") == ():
            yield refuse("is empty", f"expected {counted(edges, 'row')}, as many as durations", ("controls",))
        yield from _wrong_rows(content, ("controls",), edges, "durations")
        yield from _wrong_rows(content, ("states",), None if edges is None else edges + 1, "durations, and one more")
        yield from _wrong_rows(content, ("trajectory",), samples, "times")
        width = _width(content.get("states"))
        yield from _wrong_width(content, ("trajectory",), width)
        stop = content.get("contingency")
        if isinstance(stop, Mapping):
            yield from _wrong_rows(content, ("contingency", "states"), _length(stop.get("times")), "contingency.times")
            yield from _wrong_width(content, ("contingency", "states"), width)
        yield from _wrong_times(content.get("durations"), content.get("times"), content.get("cost"))

    def plan(self) -> Plan:
        """The plan as arrays."""
        return Plan(
            np.array(self.states),
            np.array(self.controls, dtype=float).reshape(len(self.controls), _width(self.controls) or 0),
            np.array(self.durations, dtype=float),
            np.array(self.times),
            np.array(self.trajectory),
            self.cost,
            self.cost_to_go,
            self.goal.reached,
            self._contingency(),
        )

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
        """Names of the components of the state and of the controls; None if the file lacks either."""
        state, controls = self.vehicle.state, self.vehicle.controls
        return None if state is None or controls is None else (state, tuple(controls))

    def _contingency(self) -> Contingency | None:
        stop = self.contingency
        if stop is None:
            return None
        slack = np.inf if stop.spare is None else stop.spare
        return Contingency(stop.manoeuvre, np.array(stop.times), np.array(stop.states), slack)


def _at(content: Mapping[str, object], path: tuple[str, ...]) -> object:
    value: object = content
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _length(value: object) -> int | None:
    """Length of a list that is not empty; None for anything else."""
    return len(value) if isinstance(value, tuple) and value else None


def _width(value: object) -> int | None:
    """Length of the first row of a table; None for anything else."""
    return _length(value[0]) if isinstance(value, tuple) and value else None


def _wrong_rows(
    content: Mapping[str, object], path: tuple[str, ...], rows: int | None, equal_to: str
) -> Iterator[PydanticCustomError]:
    """Check the number of rows of a table, unless `rows` is None, and that they are equally long."""
    table = _at(content, path)
    if not isinstance(table, tuple) or not table:
        return
    if rows is not None and len(table) != rows:
        expected = f"expected {rows}, as many as {equal_to}"
        yield refuse(f"has {counted(len(table), 'row')}", expected, path, Code.MISMATCH)
    width = _width(table)
    for i, row in enumerate(table):
        if width is not None and _length(row) not in (None, width):
            problem = f"has {counted(_length(row) or 0, 'number')}"
            yield refuse(problem, f"expected {width}, as in the first row", (*path, i), Code.MISMATCH)


def _wrong_width(
    content: Mapping[str, object], path: tuple[str, ...], width: int | None
) -> Iterator[PydanticCustomError]:
    """Check that the rows of a table are as long as a state, unless that is None."""
    found = _width(_at(content, path))
    if width is not None and found is not None and found != width:
        problem = f"has rows of {counted(found, 'number')}"
        yield refuse(problem, f"expected {width}, as in states", path, Code.MISMATCH)


def _wrong_times(durations: object, times: object, cost: object) -> Iterator[PydanticCustomError]:
    """Check that the times increase from 0 and end with the durations and the cost."""
    if not (_numbers(durations) and _numbers(times) and times):
        return
    if times[0] != 0.0 or not all(a < b for a, b in pairwise(times)):
        yield refuse("do not increase from 0", "expected the times of the trajectory's states", ("times",))
        return
    end, total = times[-1], sum(durations)  # math.fsum raises an exception where numbers are too large
    if abs(end - total) > TOLERANCE:
        problem = f"end at {end:g} s, but the durations last {total:g} s"
        yield refuse(problem, "expected the same time", ("times",), Code.MISMATCH)
    if isinstance(cost, int | float) and not isinstance(cost, bool) and abs(cost - total) > TOLERANCE:
        problem = f"is {cost:g} s, but the durations last {total:g} s"
        yield refuse(problem, "expected the same time", ("cost",), Code.MISMATCH)


def _numbers(values: object) -> TypeGuard[tuple[float, ...]]:
    """Whether a value is a list of numbers."""
    return isinstance(values, tuple) and all(type(value) in (int, float) for value in values)
