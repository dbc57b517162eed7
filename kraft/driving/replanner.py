"""The safe replanner (Fig. 3 of the paper): each step commits a plan or a contingency, and plans for the next cycle.

Cycle k covers [k, k + 1) cycle durations of the trial; if the communication delay exceeds `lead`, all cycles start
later by the difference.  `step` runs `lead` before cycle k starts.  It checks the plan that `kraft.driving.proposer`
made during cycle k - 1 again, from the latest estimate; commits that plan or a contingency; predicts the state at the
end of cycle k; and plans from this state for cycle k + 1.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

from kraft.driving.blockage import Blockage
from kraft.driving.bound import BoundCalibration, DeviationBound
from kraft.driving.car_model import model_of
from kraft.driving.control import Controller, set_map
from kraft.driving.messages import (  # fmt: skip
    Commitment,
    Cycle,
    Estimate,
    Passage,
    PredictedMotion,
    Reference,
    ReferenceKind,
    Uncertainty,
)
from kraft.driving.plan_search import PlanSearch
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.prediction import ClosedLoopPredictor, least_slack, required_clearance
from kraft.driving.proposal import Proposal
from kraft.driving.proposer import RECOVERY_MARGIN, Proposer
from kraft.driving.references import at_rest, standing_reference
from kraft.driving.room import nearest_free, place_with_room
from kraft.driving.safety_check import CycleStart, Decision, SafetyCheck
from kraft.driving.solvers import Solvers
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Polygon
from ompl_ext.poses import poses_of
from ompl_ext.times import SAME_TIME

SETTLED = 0.3
"""Time after the end of a contingency from which on the vehicle is taken to stand, s.

A plain choice: after less, a vehicle whose drive lags still rolls; after more, the noise of its estimated speed is
taken for motion for longer, and plans that begin at rest wait.
"""
FORGET = 2.0
"""Time without a plan to the goal after which what blocked a vehicle is forgotten, s.

A plain choice: after less, a few searches in a row that fail by chance forget an obstacle that is there; for all of it
a vehicle stands where the obstacle closes the only way.
"""
NOISE = 0.1
"""Largest estimated speed of a vehicle that stands, m/s."""


class Replanner:
    """Decides once per cycle which reference the controller tracks.  See `step`.

    Args:
        solvers: solvers of the task, see `Solvers.of`.
        settings: planner settings of the method.
        controller: the controller of the vehicle; predictions use copies of it.
        seed: seed of all plans.
        period: period of the controller, s.
        delay: communication delay from the replanner to the controller, s.
        realtime: limit planning by wall-clock time instead of iterations.
        keep_trees: keep a copy of the tree in each cycle.
        command_timeout: time after the last command when the robot stops itself (s); plans leave room for that.  None
            for a robot that loses no commands.
    """

    def __init__(
        self,
        solvers: Solvers,
        settings: PlannerSettings,
        controller: Controller,
        seed: int,
        *,
        period: float,
        delay: float = 0.0,
        realtime: bool = False,
        keep_trees: bool = False,
        command_timeout: float | None = None,
    ) -> None:
        self._settings, self._solvers, self.dirt = settings, solvers, solvers.checking
        self._search_with = partial(
            PlanSearch, settings=settings, seed=seed, realtime=realtime, keep_trees=keep_trees,
            command_timeout=command_timeout,
        )  # fmt: skip
        self.proposer = Proposer(self._search_with(solvers))
        """what searches for the plans"""
        self._blockage = None if settings.blocked is None else Blockage(settings.blocked, self.dirt.vehicle)
        self._blocked: tuple[Polygon, ...] = ()
        self._has_maps = True  # whether the solvers in use know them
        self._fruitless = 0  # number of the latest cycles without a plan to the goal
        self._predict = ClosedLoopPredictor(self.dirt, controller, period)
        self._model = model_of(self.dirt.vehicle) if settings.contingencies == "tracked" else None
        self._check = SafetyCheck(self.proposer.search, settings, self._predict, self._model)
        self._calibration = BoundCalibration(settings.bound, self.dirt.vehicle) if settings.bound else None
        self._calibrated = math.nan  # time at which the motion was decided that the bound is calibrated with (s)
        self._bound: DeviationBound | None = None
        self._delta = self.dirt.safety.delta
        self._one_shot = settings.mode == "one-shot"
        self._switches = settings.car_switches
        self.set_delay(delay)
        self._number = 0
        self.proposal = Proposal(None, "no plan has been made yet")
        """plan for the next cycle, or why there is none; `decide` checks it before it is committed"""
        self._contingency: Reference | None = None
        self._decision: Decision | None = None
        self._in_transit: list[tuple[float, Commitment]] = []

    def set_delay(self, delay: float) -> None:
        """Set the delay from the replanner to the effect of a command (s), as far as it is known now."""
        self._cycle_offset = max(0.0, delay - self._settings.lead)

    def begin(self, state: Floats, uncertainty: Uncertainty | None = None) -> Commitment:
        """Plan the first cycle from the start (nx,), before the clock runs; the result keeps the vehicle at rest.

        With a bound, the first plan keeps the one of this uncertainty, or only the margin if none is stated.
        """
        self.proposer.set_settings(self._settings.for_first_plan)
        if self._calibration is not None and uncertainty is not None:
            self._set_bound(self._calibration.bound(uncertainty))
        self.proposal = self.proposer.propose(0, state, None)
        self.proposer.set_settings(self._settings)
        return Commitment(standing_reference(self.dirt.vehicle, state, 0.0))

    @property
    def next_step(self) -> float:
        """Time at which `step` is due, s of the trial: `lead` before the next cycle; infinite after one shot."""
        if self._one_shot and self._number > 0:
            return math.inf
        return max(0.0, self._number * self._settings.cycle - self._settings.lead)

    @property
    def number(self) -> int:
        """Number of the next cycle."""
        return self._number

    def skip_to(self, number: int) -> None:
        """Leave out the cycles before `number`, for which nothing was decided in time; there is no plan for it then."""
        if number > self._number:
            self._number, self.proposal = number, Proposal(None, "planning was held up")

    @property
    def blocked(self) -> tuple[Polygon, ...]:
        """What has blocked the vehicle, beside the obstacles of the task."""
        return self._blocked

    def set_solvers(self, solvers: Solvers, blocked: tuple[Polygon, ...] = ()) -> None:
        """Decide and plan with other solvers from now on, of a task with another map or goal.

        The plan for the next cycle stays.  It is checked with them at the share of the bound for which it was made.
        `blocked` are those of their obstacles that are not the task's.
        """
        self._blocked = blocked
        self.proposer.set_solvers(solvers)
        self._use(solvers)

    def _use(self, solvers: Solvers) -> None:
        """Use the solvers of the proposer for everything else."""
        self._solvers, self.dirt, self._has_maps = solvers, solvers.checking, True
        self._predict = replace(self._predict, dirt=self.dirt)
        set_map(self._predict.controller, self.dirt)
        self._check = SafetyCheck(self.proposer.search, self._settings, self._predict, self._model)
        self._delta = self.dirt.safety.delta
        if self._bound is not None:
            self._set_bound(self._bound)

    def step(self, estimate: Estimate, current: Commitment) -> Cycle:
        """Commit a plan or a contingency for the next cycle, and plan for the cycle after it.

        `current` is what the car has on board now: after a lost message, an older one.  The controller has to track the
        commitment of the result from the start of the cycle on, which is when it has arrived.
        """
        cycle = self.decide(estimate, current)
        self.prepare()
        return cycle

    def decide(self, estimate: Estimate, current: Commitment) -> Cycle:
        """First part of `step`: commit a plan or a contingency for the next cycle."""
        if estimate.parameters is not None:
            self._solvers.set_parameters(estimate.parameters)
            if self._model is not None:
                self._model.set_parameters(estimate.parameters)
                if self._calibration is not None:
                    self._calibration.fastest = self._model.fastest
        self._calibrate(estimate, current)
        held = self._look_for_blockage(estimate, current)
        cycle_start = self._number * self._settings.cycle + self._cycle_offset
        if self._stands(estimate, current):
            estimate = replace(estimate, state=at_rest(self.dirt.vehicle, estimate.state))
        start = self._cycle_start(estimate, cycle_start, current)
        self._relax(start.root)
        decision = self._check.decide(self.proposal, start)
        self._contingency = decision.contingency
        cycle = replace(self._record(decision, cycle_start, estimate), held=held)
        if self._calibration is not None and estimate.uncertainty is not None:
            self._calibration.committed(cycle.predicted, estimate.uncertainty)
            self._calibrated = estimate.time
        self._in_transit.append((cycle_start, cycle.commitment))
        self._number += 1
        self._decision = decision
        return cycle

    def prepare(self, taken: float = 0.0) -> None:
        """Second part of `step`: plan for the cycle after the one that was decided.

        By the clock, the search is shorter by the time of the cycle that something else takes (`taken`, s).
        """
        assert self._decision is not None, "a cycle was decided"
        if not self._has_maps:
            self._make_maps()
        if not self._one_shot:
            decision = self._decision
            root = self._with_room(decision.predicted.final_state)
            self.proposal = self.proposer.propose(self._number, root, decision.plan, taken)

    def _look_for_blockage(self, estimate: Estimate, current: Commitment) -> tuple[float, float] | None:
        """Plan round what blocks the vehicle, which the map does not have; forget it all where that leaves no way.

        Returns the time (begin, end; s) in which something held the vehicle, if this cycle found it.
        """
        if self._blockage is None:
            return None
        leads = self.proposal.plan is not None and self.proposal.plan.reaches_goal
        self._fruitless = 0 if leads else self._fruitless + 1
        tracked, uncertainty = current.reference_at(estimate.time), estimate.uncertainty
        acceleration = 0.0 if uncertainty is None else uncertainty.acceleration
        found = self._blockage.observe(estimate.time, estimate.state, tracked, acceleration)
        if found is not None:
            self._block((*self._blocked, found.obstacle), "the vehicle does not move: something is in the way")
            return found.begin, estimate.time
        if self._blocked and self._fruitless * self._settings.cycle > FORGET:
            self._block((), "no way leads round what blocked the vehicle")
            self._blockage.doubt()
        return None

    def _block(self, obstacles: tuple[Polygon, ...], reason: str) -> None:
        """Plan with these obstacles beside those of the task; the plan for this cycle does not know them.

        Their maps take up to the time of a decision: `prepare` makes them.
        """
        self._blocked, self._fruitless, self._has_maps = obstacles, 0, False
        self.proposal = Proposal(None, reason)

    def _make_maps(self) -> None:
        """Make the solvers for what blocks the vehicle."""
        solvers = self._solvers.with_obstacles(self._blocked, self._settings)
        self.proposer = Proposer(self._search_with(solvers))
        self._use(solvers)

    def _calibrate(self, estimate: Estimate, current: Commitment) -> None:
        """Compare the last prediction with the estimate, and set the bound for this cycle.

        The car drives something else than predicted if the message was lost or the watchdog stopped it.
        """
        if self._calibration is not None and estimate.uncertainty is not None:
            if abs(current.decided - self._calibrated) < SAME_TIME:
                self._calibration.observe(estimate.time, estimate.state)
            self._set_bound(self._calibration.bound(estimate.uncertainty))

    def _set_bound(self, bound: DeviationBound) -> None:
        self._bound = bound
        self.proposer.set_bound(bound)
        self._delta = self.dirt.safety.delta

    def _stands(self, estimate: Estimate, current: Commitment) -> bool:
        """Whether the contingency on board has stopped the vehicle; its estimated speed is noise then."""
        tracked = current.reference_at(estimate.time)
        over = tracked.kind is ReferenceKind.CONTINGENCY and estimate.time >= tracked.end + SETTLED
        return self._switches and over and abs(float(estimate.state[self.dirt.vehicle.rest_indices[0]])) < NOISE

    def _is_resting(self, state: Floats) -> bool:
        return bool(self.dirt.safety.is_resting(self.dirt.vehicle, state))

    def _relax(self, root: Floats) -> None:
        """Lower the clearance for a vehicle with `recover` that stands with less, or is about to leave such a place.

        The clearance for which the plan was made rests on an older estimate.
        """
        dirt, recovers = self.dirt, self.proposer.recovers
        if self._switches and self._settings.recover and (recovers or self._is_resting(root)):
            slack = least_slack(dirt, root[None, :], 0.0)
            if slack < 0.0 or recovers:
                dirt.set_delta(min(self._delta, max(0.0, dirt.safety.delta + slack - RECOVERY_MARGIN)))

    def _cycle_start(self, estimate: Estimate, cycle_start: float, current: Commitment) -> CycleStart:
        """Predicted start of the cycle, with the commitment that is on board until then."""
        state, time = nearest_free(self.dirt, estimate.state), estimate.time
        self._in_transit = [sent for sent in self._in_transit if sent[0] > time + SAME_TIME]
        for arrives, following in self._in_transit:
            state, time, current = self._predict(state, time, arrives, current).final_state, arrives, following
        predicted = self._predict(state, time, cycle_start, current).final_state
        root = self._with_room(predicted)
        moved_from = None if root is predicted else predicted
        return CycleStart(self._number, cycle_start, root, moved_from, current, self._contingency, estimate.age)

    def _with_room(self, root: Floats) -> Floats:
        """Predicted start of a cycle; that of a vehicle at rest has a little room, or as much as there is nearby."""
        return place_with_room(self.dirt, root) if self._switches and self._is_resting(root) else root

    def _with_delta(self, motion: PredictedMotion, cycle_start: float) -> PredictedMotion:
        """A motion with its bound, or with the clearance that SAFETY asks of it, if it asks for any."""
        if self._bound is not None:
            speeds = motion.states[:, self.dirt.vehicle.rest_indices[0]]
            return replace(motion, delta=self._bound.at(speeds, motion.times - cycle_start))
        if not self.dirt.safety.enabled:
            return motion
        return replace(motion, delta=required_clearance(self.dirt, motion.states))

    def _record(self, decision: Decision, cycle_start: float, estimate: Estimate) -> Cycle:
        vehicle, plan, proposal, stopping = self.dirt.vehicle, decision.plan, self.proposal, decision.stopping
        return Cycle(
            number=self._number,
            time=cycle_start,
            speed=float(estimate.state[vehicle.rest_indices[0]]),
            reason=decision.reason,
            cost_to_goal=plan.total_cost if plan else math.inf,
            passage=Passage(self.dirt.workspace, vehicle.footprint, poses_of(decision.predicted.states, vehicle)),
            iterations=proposal.iterations,
            nodes=proposal.nodes,
            retained=proposal.retained,
            planning_ms=1000 * proposal.seconds,
            missed=proposal.missed,
            reference=decision.reference,
            contingency=decision.contingency,
            predicted=self._with_delta(decision.predicted, cycle_start),
            lost=proposal.lost,
            switch_refused=proposal.switch_refused,
            contingency_origin=decision.origin,
            tree=proposal.tree,
            switch=cycle_start + self._settings.cycle if plan is not None and self._switches else math.inf,
            decided=estimate.time,
            stopping=self._with_delta(stopping, cycle_start) if self._switches and stopping is not None else None,
            parameters=estimate.parameters,
            proposed=proposal.plan is not None,
            blocked=self._blocked,
        )
