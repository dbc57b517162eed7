"""The safety check right before a cycle (Fig. 3 of the paper): commit the plan for it, or a contingency."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kraft.driving.contingencies import ContingencyRanking, TrackedContingency, emergency_reference
from kraft.driving.contingency_candidates import Begin
from kraft.driving.messages import Commitment, ContingencyOrigin, PredictedMotion, Reference, ReferenceKind
from kraft.driving.plan_search import PlanSearch
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.prediction import ClosedLoopPredictor, least_slack, required_clearance
from kraft.driving.proposal import Proposal
from kraft.driving.references import at_rest, contingency_reference, plan_reference, standing_reference
from kraft.driving.room import refusal
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.poses import displacement


@dataclass(frozen=True)
class Decision:
    """Reference committed for a cycle, and the reason if it is a contingency; `plan` is None then.

    `predicted` is the predicted motion over the cycle and `contingency` the manoeuvre that stops the vehicle after it;
    `origin` is that of a committed contingency.  `stopping` is the predicted motion of the contingency until
    standstill, if it is known.
    """

    reference: Reference
    predicted: PredictedMotion
    reason: str
    plan: Plan | None = None
    contingency: Reference | None = None
    origin: ContingencyOrigin | None = None
    stopping: PredictedMotion | None = None


@dataclass(frozen=True)
class Refused:
    """Why a plan may not be committed, and whether driving it more slowly may help."""

    reason: str
    may_be_slowed: bool = False


@dataclass(frozen=True)
class CycleStart:
    """Start of a cycle, as far as it is known right before it.

    Attributes:
        number: index of the cycle.
        time: when the cycle starts, s of the trial.
        root: predicted state (nx,).
        moved_from: state (nx,) that was predicted, if `root` is another one near it that has room; else None.
        current: what the vehicle has on board until then.
        stored: contingency of the last decision.
        age: age of the newest observation, s.
    """

    number: int
    time: float
    root: Floats
    moved_from: Floats | None
    current: Commitment
    stored: Reference | None
    age: float


class SafetyCheck:
    """Checks what was proposed for a cycle from the latest estimate, and decides what is committed.

    Args:
        search: what found the plans; its solver without margin states the clearance that is checked.
        settings: planner settings of the method.
        predict: predicts the motion of the vehicle with its controller.
        model: model with which contingencies are ranked as the controller tracks them; None to verify them as the
            equations of the planner drive them.
    """

    def __init__(
        self, search: PlanSearch, settings: PlannerSettings, predict: ClosedLoopPredictor, model: VehicleModel | None
    ) -> None:
        self._search, self._settings, self._predict = search, settings, predict
        self._switches = settings.car_switches
        self._dirt = search.solvers.checking
        self._ranking = None if model is None else ContingencyRanking(self._dirt, predict, model)

    def decide(self, proposal: Proposal, start: CycleStart) -> Decision:
        """The decision for the cycle: the proposed plan, one like it that is slower, or a contingency."""
        plan = proposal.plan
        if plan is None:
            return self._choose_contingency(start, None, proposal.reason)
        if start.number > 0 and start.age > self._settings.patience:
            old = math.isfinite(start.age)
            reason = f"the newest observation is {start.age:.2f} s old" if old else "no observation has arrived"
            return self._choose_contingency(start, plan, reason)
        decision = self._checked(plan, start)
        if isinstance(decision, Refused) and decision.may_be_slowed:
            plans = self._search.slower(start.number, plan, start.root)
            slower = (self._checked(each, start) for each in plans)
            decision = next((each for each in slower if isinstance(each, Decision)), decision)
        if isinstance(decision, Decision):
            return decision
        return self._choose_contingency(start, plan, f"from the latest estimate {decision.reason}")

    def _checked(self, plan: Plan, start: CycleStart) -> Decision | Refused:
        """The decision for a plan, as the controller will track it, or why it may not be committed."""
        followed = self._settings.cycle if self._switches else 0.0  # else the law drives on to the end of the plan
        reference = plan_reference(self._dirt.vehicle, plan, start.time, followed)
        predicted = self._predict(start.root, start.time, start.time + self._settings.cycle, Commitment(reference))
        if self._settings.mode == "one-shot":
            return Decision(reference, predicted, "", plan)
        if predicted.slack < 0.0 and not self._dirt.safety.enabled:
            return Refused("the motion along the plan may touch an obstacle")
        if predicted.slack < 0.0:
            return Refused(f"the plan lacks {-predicted.slack:.3f} m of clearance")
        if not self._dirt.safety.enabled:
            return Decision(reference, predicted, "", plan)
        if self._search.loss is not None and self._search.loss.slack(predicted) < 0.0:
            return Refused("the plan leaves no room for a stop without commands", may_be_slowed=True)
        if start.moved_from is not None:
            refused = refusal(self._dirt, start.moved_from, start.root, plan, predicted.states)
            if refused is not None:
                return Refused(refused)
        stop, stopping = self._contingency_after(reference, predicted.final_state, start.time)
        if stop is None:
            return Refused("no manoeuvre stops safely after the plan")
        return Decision(reference, predicted, "", plan, stop, stopping=stopping)

    def _contingency_after(
        self, plan: Reference, state: Floats, cycle_start: float
    ) -> tuple[Reference | None, PredictedMotion | None]:
        """Contingency from `state` (nx,) at the cycle's end, and its motion if predicted; None if none is safe."""
        time = cycle_start + self._settings.cycle
        if self._ranking is not None:
            best = self._ranking.best(Begin(state, time, cycle_start), None, [plan])
            return (best.reference, best.predicted) if best.is_verified else (None, None)
        safe = self._dirt.contingency(state, time)  # Alg. 2
        if safe is None:
            return None, None
        contingency = contingency_reference(self._dirt.vehicle, safe)
        return contingency, self._predict.until_rest(state, time, contingency, cycle_start) if self._switches else None

    def _choose_contingency(self, start: CycleStart, refused: Plan | None, reason: str) -> Decision:
        """Commit a contingency: one verified from the root, else the stored one, else the unverified emergency.

        Tracked contingencies have one ranking instead.
        """
        root, cycle_start = start.root, start.time
        cycle_end = cycle_start + self._settings.cycle
        if self._switches and self._dirt.safety.is_resting(self._dirt.vehicle, root):
            return self._stand(start, reason)
        tracked = start.current.reference_at(cycle_start)
        stored = tracked if tracked.kind is ReferenceKind.CONTINGENCY else start.stored
        if self._ranking is not None:
            best = self._best_contingency(self._ranking, start, stored, refused)
            predicted = self._predict(root, cycle_start, cycle_end, Commitment(best.reference))
            return Decision(best.reference, predicted, reason, None, best.reference, best.origin, best.predicted)
        safe = self._dirt.contingency(root, cycle_start)
        if safe is not None:
            reference, origin = contingency_reference(self._dirt.vehicle, safe), ContingencyOrigin.SAFE
        elif stored is not None and self._is_near(root, stored.state_at(cycle_start)):
            reference, origin = stored, ContingencyOrigin.IN_HAND
        else:
            reference, origin = emergency_reference(self._dirt, root, cycle_start), ContingencyOrigin.EMERGENCY
        predicted = self._predict(root, cycle_start, cycle_end, Commitment(reference))
        stopping = self._predict.until_rest(root, cycle_start, reference, cycle_start) if self._switches else None
        return Decision(reference, predicted, reason, None, reference, origin, stopping)

    def _stand(self, start: CycleStart, reason: str) -> Decision:
        """Commit that the vehicle stays where it stands: at the end of the contingency that stopped it, if one did.

        That was verified for this place; a new estimate of the place is not.
        """
        root, cycle_start = at_rest(self._dirt.vehicle, start.root), start.time
        tracked = start.current.reference_at(cycle_start)
        over = tracked.kind is ReferenceKind.CONTINGENCY and cycle_start >= tracked.end
        standing = tracked if over else standing_reference(self._dirt.vehicle, root, cycle_start)
        times = cycle_start + np.array([0.0, self._settings.cycle])
        predicted = PredictedMotion(times, np.vstack([root, root]), least_slack(self._dirt, root[None, :], 0.0))
        return Decision(standing, predicted, reason, None, standing, ContingencyOrigin.STANDING, predicted)

    def _best_contingency(
        self, ranking: ContingencyRanking, start: CycleStart, stored: Reference | None, refused: Plan | None
    ) -> TrackedContingency:
        """Best tracked contingency, with the plan on board and the refused one as paths to follow."""
        plans = [start.current.reference] if start.current.reference.kind is ReferenceKind.PLAN else []
        if refused is not None:
            plans.append(plan_reference(self._dirt.vehicle, refused, start.time))
        return ranking.best(Begin(start.root, start.time, start.time), stored, plans)

    def _is_near(self, root: Floats, expected: Floats) -> bool:
        """Whether no point of the vehicle is farther than 2 delta(v) from the state that a manoeuvre was verified for.

        Any point of the vehicle may deviate from its prediction by delta(v), and the estimate from the vehicle by as
        much (Theorem 1).
        """
        return displacement(root, expected, self._dirt.vehicle) <= 2.0 * float(
            required_clearance(self._dirt, expected[None, :], 0.0)[0]
        )
