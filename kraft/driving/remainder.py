"""Remainder of the plan that is being executed, and what the next query retains of it (Alg. 1, ll. 1-8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kraft.driving.messages import PlanLoss
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Plan
from ompl_ext.retainment import RetainableEdges, remaining_edges
from ompl_ext.solver import DirtSolver
from ompl_ext.times import SAME_TIME

RETAINED_TOLERANCE = 0.1
"""Most that a retained plan costs beyond what was left of it, s, for the rounding of edges."""
ATTEMPT_TOLERANCE = 0.03
"""What a whole remainder may cost more after each attempt at a cheaper one, s."""
FRUITLESS_ATTEMPTS = 6
"""Attempts in a row that neither retain more nor save `ATTEMPT_TOLERANCE`, after which they end."""
ATTEMPT_SEEDS = 1_000_000_007
"""Difference between the seeds of two attempts."""


@dataclass(frozen=True)
class Remainder:
    """Remainder of a plan after `elapsed` s, with the edges of its tree that are retained too, if any."""

    plan: Plan
    elapsed: float
    edges: RetainableEdges | None = None

    @property
    def left(self) -> float:
        """Cost that is left of the plan, s."""
        return self.plan.total_cost - self.elapsed


def has_remainder(plan: Plan, elapsed: float) -> bool:
    """Whether an edge of a plan is left after `elapsed` s."""
    return len(remaining_edges(plan.controls, plan.durations, elapsed)[2]) > 0


def retained_plan(dirt: DirtSolver, remainder: Remainder) -> Plan | None:
    """Plan of what was retained of a remainder; None if an edge is missing or a plan may not end there."""
    _, durations = _edges(dirt, remainder)
    last = int(dirt.retained_nodes[len(durations) - 1])
    if last < 0:
        return None
    plan = dirt.plan_to(last)
    return plan if plan.reaches_goal or not dirt.safety.enabled or plan.cost >= dirt.safety.cycle else None


def start_with_best_corrections(dirt: DirtSolver, root: Floats, remainder: Remainder, seed: int, attempts: int) -> bool:
    """Start a query at `root` (nx,) with the seed, of several, that retains most of a remainder; the cheapest if all.

    The query was started with the first `seed`.  Returns whether the remainder is in the tree already, as it is if the
    last attempt is the best one.

    Corrections are random, and each of them is the best one for its own edge only: others pass where one fails.  A
    cheaper whole remainder is worth ever fewer attempts, and where none helps, the cause is not the correction.
    """
    assert remainder.edges is not None
    edges, best, chosen, fruitless = remainder.edges, (-1, -math.inf, seed), seed, 0
    part = slice(0, edges.remaining)
    for attempt in range(attempts):
        chosen = seed + attempt * ATTEMPT_SEEDS
        if attempt > 0:
            dirt.start(root, chosen)
        retained = dirt.retain_edges(edges.parents[part], edges.controls[part], edges.durations[part], edges.targets)
        gains = retained > best[0] or (retained == best[0] and -dirt.best_cost > best[1] + ATTEMPT_TOLERANCE)
        fruitless = 0 if gains else fruitless + 1
        best = max(best, (retained, -dirt.best_cost, chosen))
        enough = remainder.left + RETAINED_TOLERANCE + attempt * ATTEMPT_TOLERANCE
        suffices = best[0] == edges.remaining and -best[1] <= enough
        if suffices or fruitless == FRUITLESS_ATTEMPTS:
            break
    if best[2] == chosen:
        return True
    dirt.start(root, best[2])
    return False


def retain(dirt: DirtSolver, root: Floats, remainder: Remainder, continued: bool = False) -> PlanLoss:
    """Retain the remainder of a plan, and edges of its tree if there are any, in a query that begins at `root` (nx,).

    If that is `continued`, the remainder is in the tree already.  Returns the reason of a loss: of an edge that was not
    retained or, if all were, of a cost that is higher from the new root.  Obstacles do not move, so an edge is in
    collision from the state that the plan predicted only if more distance is required now than when it was planned.
    """
    plan, elapsed, edges = remainder.plan, remainder.elapsed, remainder.edges
    controls, durations = _edges(dirt, remainder)
    if edges is None:
        dirt.retain(plan, elapsed, optimised=True)
    else:
        dirt.retain_edges(
            edges.parents, edges.controls, edges.durations, edges.targets, continued=continued, optimised=True
        )
    if dirt.retained_nodes[len(durations) - 1] >= 0:
        return PlanLoss.ESTIMATE if dirt.best_cost > remainder.left + RETAINED_TOLERANCE else PlanLoss.NONE
    first = int(plan.durations.cumsum().searchsorted(elapsed + SAME_TIME, side="right"))
    begun = elapsed - float(plan.durations[:first].sum())
    planned = dirt.edge(plan.states[first], plan.controls[first], max(begun, 0.0))[0][-1]
    from_root, from_planned = (_first_loss(dirt, state, controls, durations) for state in (root, planned))
    if PlanLoss.NONE in (from_planned, from_root):
        return PlanLoss.ESTIMATE
    return from_root


def _edges(dirt: DirtSolver, remainder: Remainder) -> tuple[Matrix, Floats]:
    """Controls (n, nu) and durations (n,) of the edges as which a remainder is retained.

    Those that come with edges of their tree stay as they are; `DirtSolver.retain` divides longer ones than the tree's.
    """
    plan, longest = remainder.plan, dirt.settings.longest if remainder.edges is None else math.inf
    _, controls, durations = remaining_edges(plan.controls, plan.durations, remainder.elapsed, longest)
    return controls, durations


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
