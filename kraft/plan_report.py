"""What is said about a plan: the JSON object of `kraft plan --json`, the table, the notes in a picture."""

from __future__ import annotations

import math
from typing import Any

from kraft.plan_request import Planned
from kraft.planning.plan_task import PlanResult
from kraft.text import counted, grouped


def json_content(planned: Planned) -> dict[str, Any]:
    """Content of the ``kraft.plan/1`` object; what does not exist is null, as is a clearance without obstacles."""
    result, plan, progress = planned.result, planned.result.plan, planned.result.progress
    first = progress.first_solution
    verification = result.verification
    return {
        "scenario": planned.task.name,
        "vehicle": planned.vehicle.name,
        "planner": planned.task.planning.planner,
        "seed": result.seed,
        "solved": result.solved,
        "reason": result.reason or None,
        "cost_s": plan.cost if plan else None,
        "cost_to_go_s": plan.cost_to_go if plan else None,
        "first_solution_ms": 1000 * first[0] if first else None,
        "first_cost_s": first[1] if first else None,
        "planning_ms": 1000 * progress.seconds,
        "setup_ms": 1000 * result.setup_seconds,
        "verify_ms": 1000 * result.verify_seconds,
        "iterations": progress.iterations,
        "edges": progress.edges or None,
        "edges_per_s": _rate(result),
        "nodes": progress.nodes,
        "retained": progress.retained,
        "unsafe": progress.unsafe,
        "min_clearance_m": _finite(verification.min_clearance) if verification else None,
        "contingency": plan.contingency.manoeuvre if plan and plan.contingency else None,
        "contingency_clearance_m": _finite(verification.contingency_clearance) if verification else None,
        "safe": result.safe,
        "problems": list(verification.problems) if verification else [],
        "plan_file": str(planned.plan_file) if planned.plan_file else None,
    }


def table_rows(planned: Planned) -> list[tuple[str, str]]:
    """Label and value of each line of the table that a person reads."""
    result, plan, progress = planned.result, planned.result.plan, planned.result.progress
    rows = [("scenario", planned.task.name), ("vehicle", _vehicle_text(planned))]
    rows.append(("result", _outcome(result)))
    if plan is not None:
        rows.append(("plan", f"{plan.cost:.2f} s in {counted(len(plan.durations), 'edge')}"))
    if progress.first_solution is not None:
        seconds, cost = progress.first_solution
        rows.append(("first solution", f"{cost:.2f} s, found after {1000 * seconds:.2f} ms"))
    if result.verification is not None:
        rows.append(("clearance", f"{_metres(result.verification.min_clearance)} at least, verified with FCL"))
    if plan is not None and plan.contingency is not None:
        stop = plan.contingency
        clearance = _metres(result.verification.contingency_clearance) if result.verification else "-"
        stands = stop.times[-1] - stop.times[0]
        rows.append(
            ("contingency", f"{stop.manoeuvre} at {stop.times[0]:.2f} s, stands {stands:.1f} s later, {clearance}")
        )
    if result.verification is not None and result.verification.problems:
        rows.append(("not safe", "\n".join(result.verification.problems)))
    if progress.retained:
        rows.append(("retained", f"{counted(progress.retained, 'edge')} of the earlier plan"))
    if progress.iterations:
        rows.append(("search", _search(result)))
    if planned.plan_file is not None:
        rows.append(("plan file", str(planned.plan_file)))
    if planned.request.plot is not None:
        rows.append(("picture", str(planned.request.plot)))
    return rows


def notes(result: PlanResult) -> dict[str, str]:
    """Key numbers for the picture; none depends on the clock, so that the same plan gives the same picture."""
    plan, verification = result.plan, result.verification
    if plan is None or verification is None:
        return {}
    found = {"duration": f"{plan.cost:.2f} s", "clearance": _metres(verification.min_clearance)}
    if plan.contingency is not None:
        found["contingency"] = f"{plan.contingency.manoeuvre}, {_metres(verification.contingency_clearance)}"
    return {**found, "iterations": f"{result.progress.iterations:,}", "nodes": f"{result.progress.nodes:,}"}


def _vehicle_text(planned: Planned) -> str:
    values = ", ".join(f"{name} {value:g}" for name, value in planned.vehicle.parameters.items())
    return f"{planned.vehicle.name} ({values})" if values else planned.vehicle.name


def _outcome(result: PlanResult) -> str:
    if result.solved:
        return "solved"
    return "no plan" if result.plan is None else "not solved; the plan ends nearest to the goal"


def _search(result: PlanResult) -> str:
    progress = result.progress
    rate = _rate(result)
    speed = f", {rate / 1e6:.2f} M edges/s" if rate is not None else ""
    work = f"{grouped(progress.iterations, 'iteration')}, {grouped(progress.nodes, 'node')}"
    return f"{work}, {1000 * progress.seconds:.0f} ms{speed}"


def _rate(result: PlanResult) -> float | None:
    progress = result.progress
    return progress.edges / progress.seconds if progress.edges and progress.seconds > 0 else None


def _metres(value: float | None) -> str:
    return "no obstacle" if value is None or math.isinf(value) else f"{value:.3f} m"


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
