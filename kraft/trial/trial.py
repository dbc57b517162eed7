"""One trial: a robot with an approximate model of itself drives in the simulated world.

`run_trial` is the main path of the package; read it first, then `kraft.driving.replanner.Replanner.step`, then
`ompl_ext.kernels.dirt`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.control import make_controller
from kraft.driving.control_settings import OpenLoop
from kraft.driving.estimation import Estimator, make_estimator
from kraft.driving.estimator_settings import Oracle
from kraft.driving.messages import Commitment, Cycle, Observation
from kraft.driving.on_board import OnBoard
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from kraft.planning.workspace import start_state
from kraft.simulation.true_world import TrueWorld, world_of
from kraft.trial.cause import Cause, CauseKind, collision_cause, timeout_cause
from kraft.trial.closest_approach import ClosestApproach
from kraft.trial.measures import Measures, Step, measure, normalised_squares
from kraft.trial.oracle import OracleEstimator, true_model
from kraft.trial.plant import Plant, Radio, camera_model
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.times import SAME_TIME

OnCycle = Callable[[Cycle], None]
OnStep = Callable[[TrueWorld, Step], None]


def run_trial(
    spec: TrialSpec,
    on_cycle: OnCycle | None = None,
    on_step: OnStep | None = None,
    keep_trees: bool = False,
    world: TrueWorld | None = None,
) -> TrialResult:
    """Drive until the goal, a collision or the time limit.

    Args:
        spec: scenario, method, model and seed; unless it is `realtime`, the result depends on nothing else.
        on_cycle: called with each cycle when it is committed.
        on_step: called with the world after each tick of the controller.
        keep_trees: keep a copy of the planner's tree in each cycle.
        world: world at time 0 to drive in; that of the scenario is made if None.

    Raises:
        InputError: if the true robot cannot be simulated there or takes other controls, or the camera does not see it.
        MissingDependency: if frames of the camera are rendered and OpenCV or OpenGL is missing.
        Defect: if a plan fails its verification.
        TypeError: if `spec` is no `TrialSpec`.
    """
    if not isinstance(spec, TrialSpec):
        raise TypeError(f"spec: expected a TrialSpec, as by TrialSpec.load, not {type(spec).__name__}")
    # only `on_step` may draw the world
    world = world or world_of(spec.scenario, spec.vehicle, spec.seed, visuals=on_step is not None)
    trial = _Trial(spec, keep_trees, world)
    log = _Log(on_cycle, on_step)
    while (outcome := trial.outcome) is None:
        trial.observe(log)
        trial.receive()
        trial.replan(log)
        trial.control(log)
        trial.advance()
    world = trial.world
    return TrialResult(
        scenario=spec.scenario.name,
        method=spec.method.name,
        seed=spec.seed,
        outcome=outcome,
        time=world.time,
        obstacle=world.collision.obstacle if world.collision else None,
        min_clearance=trial.approach.least(),
        measures=trial.measures(log),
        cause=trial.cause(log, outcome),
        cycles=tuple(log.cycles),
        steps=tuple(log.steps),
        observations=tuple(log.observations),
        command_ms=tuple(log.command_ms),
        late_commands=sum(each > 1000.0 * trial.period for each in log.command_ms),
    )


@dataclass
class _Log:
    """Recorded cycles, steps, observations and times of commands (ms), and the callbacks that receive them."""

    on_cycle: OnCycle | None
    on_step: OnStep | None
    cycles: list[Cycle] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    command_ms: list[float] = field(default_factory=list)


class _Trial:
    """Simulated world and robot of a trial, and the messages on their way between them."""

    def __init__(self, spec: TrialSpec, keep_trees: bool, world: TrueWorld) -> None:
        scenario, method = spec.scenario, spec.method
        self.world = world
        settings, vehicle = method.estimator, spec.vehicle
        self._plant = Plant(self.world, scenario, vehicle.controls, spec.seed, method.controller.rate_hz)
        if isinstance(settings, Oracle):
            # those after a change too: one that has no model is refused before the drive
            models = [true_model(vehicle, world, state.vehicle) for state in scenario.truth.states]
            vehicle = models[0]
        model, start = model_of(vehicle), start_state(scenario.task(), vehicle)
        self._estimator: Estimator = (
            OracleEstimator(self.world, scenario.sensing.command_delay, spec.vehicle, model, start)
            if isinstance(settings, Oracle)
            else make_estimator(settings, model, start, camera_model(scenario))
        )
        self._model, self._realtime, self._goal = model, spec.realtime, scenario.goal
        self._communication_delay = scenario.sensing.communication_delay
        self.period = 1.0 / method.controller.rate_hz
        solvers = Solvers.of(scenario.task(), vehicle, method.planner)
        self._controller = make_controller(method.controller, model, solvers.checking, spec.seed)
        self._replanner = Replanner(
            solvers, method.planner, self._controller, spec.seed,
            period=self.period, delay=self._communication_delay + self._estimator.horizon,
            realtime=spec.realtime, keep_trees=keep_trees,
        )  # fmt: skip
        self._radio = Radio(scenario.sensing.message_loss, spec.seed)
        standing = self._replanner.begin(start, self._estimator.uncertainty(0.0))
        self._on_board = OnBoard(method.planner, solvers.checking.safety, model, standing)
        self._sent: list[tuple[float, Commitment]] = []
        self._in_flight: list[Observation] = []
        self._true_poses: dict[float, tuple[float, float, float]] = {}  # at the time of each observation in flight
        self._errors: list[tuple[Floats, Matrix]] = []  # of poses, with the covariances that the estimator stated
        once = method.planner.mode == "one-shot"
        self._limit = scenario.trial.oneshot_timeout if once else scenario.trial.timeout
        self._feedback = not isinstance(method.controller, OpenLoop)
        self._exact = solvers.checking.exact
        self.approach = ClosestApproach(self._exact.distance, vehicle.footprint.reach)

    @property
    def outcome(self) -> Outcome | None:
        """Outcome by the true state; None while the trial goes on."""
        if self.world.collision is not None:
            return Outcome.COLLISION
        if self.world.in_goal:
            return Outcome.SUCCESS
        return Outcome.TIMEOUT if self.world.time >= self._limit - SAME_TIME else None

    def observe(self, log: _Log) -> None:
        """Take a frame if one is due, and give the observations that have arrived to the estimator."""
        now = self.world.time
        if self._plant.frame_due:
            observation = self._plant.expose()
            if observation is not None:
                self._in_flight.append(observation)
                self._true_poses[observation.time] = self._true_pose
                log.observations.append(observation)
        arrived = [o for o in self._in_flight if o.arrival <= now + SAME_TIME]
        self._in_flight = [o for o in self._in_flight if o.arrival > now + SAME_TIME]
        for observation in arrived:
            self._estimator.observe(observation)
            self._record_error(self._true_poses.pop(observation.time))

    def receive(self) -> None:
        """Take the commitment of the cycle that has begun on board."""
        while self._sent and self._sent[0][0] <= self.world.time + self._estimator.horizon + SAME_TIME:
            self._on_board.receive(self._sent.pop(0)[1], self._estimator.estimate(self.world.time))

    def replan(self, log: _Log) -> None:
        """Replan if a cycle is due; its reference is tracked from the beginning of the cycle on."""
        now = self.world.time
        if now < self._replanner.next_step - SAME_TIME:
            return
        estimate = self._estimator.replanning_estimate(now)
        self._replanner.set_delay(self._communication_delay + self._estimator.horizon)
        cycle = self._replanner.step(estimate, self._on_board.commitment)
        if cycle.held is not None:
            self._estimator.leave_out(*cycle.held)
        cycle = replace(cycle, delivered=self._radio.delivers())
        if cycle.delivered:
            self._sent.append((cycle.time, cycle.commitment))
        self.receive()  # without lead and delay the cycle begins now
        log.cycles.append(cycle)
        if log.on_cycle is not None:
            log.on_cycle(cycle)

    def control(self, log: _Log) -> None:
        """Send a command if one is due, and record the step."""
        now, world = self.world.time, self.world
        if not self._plant.command_due:
            return
        estimate = self._estimator.estimate(now)
        began = time.perf_counter()
        command = self._controller.command(estimate, self._on_board.reference(estimate))
        log.command_ms.append(1000.0 * (time.perf_counter() - began))
        self._plant.send(command)
        self._estimator.commanded(now, command)
        pose = self._true_pose
        self.approach.add(*pose)
        stopping = self._on_board.is_stopping
        boxes = tuple((x, y, theta) for x, y, theta in world.movable_poses.tolist())
        ahead = estimate.time - now
        step = Step(now, pose, world.speed, estimate.state, command, len(log.cycles) - 1, stopping, ahead, boxes)
        log.steps.append(step)
        if log.on_step is not None:
            log.on_step(world, step)

    def measures(self, log: _Log) -> Measures:
        """Measures of what the method promised."""
        model = self._model
        return measure(
            log.cycles, log.steps, model.vehicle.footprint, model.pose,
            self._radio.lost, normalised_squares(self._errors), self._on_board.stops, self.world.time,
        )  # fmt: skip

    def cause(self, log: _Log, outcome: Outcome) -> Cause | None:
        """Cause of a collision or a timeout; None of a success."""
        if outcome is Outcome.SUCCESS:
            return None
        of = log.cycles, log.steps, self._model.vehicle.footprint, self._model.pose
        if outcome is Outcome.COLLISION:
            distance = self._exact.distance(*self._true_pose)
            return collision_cause(*of, distance=distance, feedback=self._feedback, realtime=self._realtime)
        if self.world.frame.has_turned_over(self.world.marker[1]):
            return Cause(kind=CauseKind.STUCK, text="the robot has turned over: it lies on its side or its roof")
        return timeout_cause(*of, self._goal, realtime=self._realtime)

    @property
    def _true_pose(self) -> tuple[float, float, float]:
        x, y, theta = self.world.pose.tolist()
        return x, y, theta

    def _record_error(self, true_pose: tuple[float, float, float]) -> None:
        """Record the error of the pose for which the estimator states a covariance."""
        belief = self._estimator.belief
        if belief is not None:
            error = np.array(true_pose) - belief.mean
            error[2] = math.remainder(error[2], math.tau)
            self._errors.append((error, belief.covariance))

    def advance(self) -> None:
        """Advance the world to the next event."""
        until = min(self._replanner.next_step, self._limit)
        self._plant.advance(math.ceil(until / self.world.dt - 1e-6))
