"""What is said about one trial: the JSON object of `kraft run --json`, the table, and a line for each cycle."""

from __future__ import annotations

import math
from typing import Any

from kraft.driving.messages import Cycle
from kraft.evaluation.statistics import percentile
from kraft.run_request import Run
from kraft.trial.result import Outcome, TrialResult


def json_content(run: Run) -> dict[str, Any]:
    """Content of the ``kraft.run/1`` object; `t_ex_s` is when the trial ended, however it did."""
    spec, result = run.spec, run.result
    planning = _planning(result)
    return {
        "scenario": result.scenario,
        "method": result.method,
        "vehicle": spec.vehicle.name,
        "seed": result.seed,
        "outcome": result.outcome.value,
        "obstacle": result.obstacle,
        "t_ex_s": float(result.time),
        "cycles": len(result.cycles),
        "contingencies": result.contingencies,
        "min_clearance_m": float(result.min_clearance) if math.isfinite(result.min_clearance) else None,
        "planning_ms_p50": percentile(planning, 0.5),
        "planning_ms_p99": percentile(planning, 0.99),
        "missed_deadlines": result.missed,
        "folder": str(run.request.out) if run.request.out else None,
    }


def table_rows(run: Run) -> list[tuple[str, str]]:
    """Label and value of each line of the table that a person reads."""
    result, planning = run.result, _planning(run.result)
    rows = [
        ("scenario", result.scenario),
        ("method", run.spec.method.title),
        ("vehicle", run.spec.vehicle.name),
        ("result", outcome_text(result)),
        ("clearance", f"{_metres(result.min_clearance)} at least"),
        ("cycles", f"{len(result.cycles)}, {result.contingencies} of them with the contingency"),
    ]
    if planning:
        slow = f", {result.missed} took too long" if result.missed else ""
        rows.append(("planning", f"{percentile(planning, 0.5):.1f} ms median, {max(planning):.1f} ms worst{slow}"))
    wanted = run.request.wanted
    made = (("film", wanted.video), ("picture", wanted.plot), ("written to", run.request.out))
    return rows + [(name, str(path)) for name, path in made if path is not None]


def outcome_text(result: TrialResult) -> str:
    """How a trial ended, for a sentence."""
    match result.outcome:
        case Outcome.SUCCESS:
            return f"reached the goal after {result.time:.2f} s"
        case Outcome.COLLISION:
            return f"collision with {result.obstacle} after {result.time:.2f} s"
        case Outcome.TIMEOUT:
            return f"not at the goal after {result.time:.2f} s"


def cycle_line(cycle: Cycle) -> str:
    """Time, speed, cost to goal, clearance, and what was committed and why."""
    to_goal = f"{cycle.cost_to_goal:5.2f} s" if math.isfinite(cycle.cost_to_goal) else "  -    "
    reason = f": {cycle.reason}" if cycle.reason else ""
    return (
        f"{cycle.time:6.2f} s  {cycle.speed:5.2f} m/s  to goal {to_goal}  clearance {_metres(cycle.clearance)}  "
        f"{cycle.kind}{reason}"
    )


def _planning(result: TrialResult) -> list[float]:
    return [cycle.planning_ms for cycle in result.cycles]


def _metres(value: float) -> str:
    return f"{value:.3f} m" if math.isfinite(value) else "-"
