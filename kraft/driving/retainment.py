"""Retainment of the plan that is being executed (Alg. 1, ll. 1-8), and the reason why a part of it is lost."""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.messages import PlanLoss
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.query import remaining_edges
from ompl_ext.solver import DirtSolver

TOLERANCE: Final = 0.1
"""Cost by which a retained plan may exceed what was left of it, s: the roundings of its edges."""


def retain(dirt: DirtSolver, root: Floats, plan: Plan, elapsed: float) -> PlanLoss:
    """Retain the rest of a plan after `elapsed` s in a query that begins at `root` (nx,).

    Returns the reason of a loss: of an edge that was not retained or, if all were, of a cost that is higher from the
    new root.  Obstacles do not move, so an edge is in collision from the state that the plan predicted only if more
    distance is required now than when it was planned.
    """
    _, controls, durations = remaining_edges(plan.controls, plan.durations, elapsed)
    retained = dirt.retain(plan, elapsed)
    if retained == len(durations):
        now, left = dirt.best_cost, plan.cost + plan.cost_to_go - elapsed
        return PlanLoss.ESTIMATE if now > left + TOLERANCE else PlanLoss.NONE
    first = int(plan.durations.cumsum().searchsorted(elapsed + 1e-9, side="right"))
    begun = elapsed - float(plan.durations[:first].sum())
    planned = dirt.edge(plan.states[first], plan.controls[first], max(begun, 0.0))[0][-1]
    from_root, from_planned = (_first_loss(dirt, state, controls, durations) for state in (root, planned))
    if PlanLoss.NONE in (from_planned, from_root):
        return PlanLoss.ESTIMATE
    return from_root


def _first_loss(dirt: DirtSolver, state: Floats, controls: Floats, durations: Floats) -> PlanLoss:
    """Reason for which an edge of a path from `state` cannot be executed; none if all can."""
    safety, time = dirt.safety, 0.0
    for control, duration in zip(controls, durations, strict=True):
        samples, slack = dirt.edge(state, control, float(duration))
        if slack < 0.0:
            return PlanLoss.COLLISION
        ends = time + float(duration)
        if safety.enabled and time < safety.cycle:
            if dirt.edge(state, control, float(duration), time)[1] < 0.0:
                return PlanLoss.UNSAFE
            if ends >= safety.cycle:
                leaves, _ = dirt.edge(state, control, min(safety.cycle - time, float(duration)))
                if dirt.contingency(leaves[-1]) is None:
                    return PlanLoss.UNSAFE
        state, time = samples[-1], ends
    if safety.enabled and time < safety.cycle and not math.isclose(time, safety.cycle):
        return PlanLoss.NONE if dirt.contingency(state) is not None else PlanLoss.UNSAFE
    return PlanLoss.NONE
