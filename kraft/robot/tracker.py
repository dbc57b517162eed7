"""What drives the vehicle in each tick: poses, the estimate, what is on board, the controller and the command.

The controller has one, and so has the brake guard, which is told what the controller did and continues from there.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.control import make_controller
from kraft.driving.control_settings import UserCode
from kraft.driving.estimation import make_estimator
from kraft.driving.estimation.adaptive import AdaptiveEstimator, Learned
from kraft.driving.estimator_settings import Oracle
from kraft.driving.messages import Commitment, Estimate, Observation, Reference, ReferenceKind
from kraft.driving.on_board import OnBoard
from kraft.driving.references import at_rest, standing_reference
from kraft.errors import Defect
from kraft.robot.command import CommandCodec
from kraft.robot.inputs import Inputs
from kraft.robot.messages import to_cdr
from kraft.robot.poses import Clocks, PoseGuard
from kraft.robot.protocol import BeginOrder, DriveSpec
from kraft.robot.response import Response
from kraft.robot.transport import Transport
from ompl_ext.arrays import Floats
from ompl_ext.poses import pose_of
from ompl_ext.query import Safety

STANDSTILL: Final = 0.1
"""Speed up to which the vehicle is kept where it is after a stop, m/s."""


class Tracker:
    """Estimate, commitment on board and command of a drive, by its clocks.

    `on_board`, `poses`, which refuses poses that cannot be true, and `response`, which compares the turns with the
    commands, are for those who drive with it; `arrived` is the number of poses that the last call of `take_poses`
    found, refused ones included.  `has_own_code` is whether plans are tracked by a controller of the user's own.
    """

    def __init__(self, spec: DriveSpec, begin: BeginOrder, transport: Transport, inputs: Inputs) -> None:
        robot, method = spec.robot, spec.method
        assert not isinstance(method.estimator, Oracle), "no robot has it"
        self._spec, self._transport, self._inputs = spec, transport, inputs
        self._codec = CommandCodec(robot, spec.vehicle)
        self.model = model_of(spec.vehicle)
        self._controller = make_controller(spec.controller, self.model)
        self.has_own_code = isinstance(method.controller, UserCode)
        self._estimator = make_estimator(method.estimator, self.model, begin.state, spec.camera)
        limit = min(robot.watchdog.pose_age, method.planner.watchdog or math.inf)
        self.settings = method.planner.model_copy(update={"watchdog": limit})
        self.on_board = OnBoard(self.settings, Safety(cycle=self.settings.cycle), self.model, begin.commitment)
        self.clocks = Clocks(0, 0)  # until the drive begins
        self.poses = PoseGuard(robot, self.clocks)
        self._open_loop = np.array(begin.state, dtype=float)  # where the commands lead from the newest observation
        self.response = Response()
        self._last_command, self.last_sent = self.model.rest.copy(), 0.0
        self.arrived = self._restarts = 0
        self._stand = self._stands_after = begin.commitment.reference  # the stop after which the vehicle is kept there

    def start(self, clocks: Clocks) -> None:
        """Set time 0, and drop the poses that have arrived before."""
        self.clocks = clocks
        self.poses = PoseGuard(self._spec.robot, clocks)
        self._inputs.take_poses()
        self._restarts = self._inputs.clock.restarts

    @property
    def clock_is_over(self) -> bool:
        """Whether the clock of the drive has gone back since its beginning: another simulation has begun."""
        return self._inputs.clock.restarts != self._restarts

    @property
    def clock_trouble(self) -> str:
        """Why nothing can be timed by the clock of the drive; empty if it goes on."""
        topic = self._spec.robot.clock.topic if self._spec.robot.clock is not None else ""
        if self.clock_is_over:
            return f"the time on {topic} has gone back: another simulation has begun"
        paused = f"the time on {topic} stands: the simulation is paused, or its messages do not arrive any more"
        return paused if self._inputs.clock.stands else ""

    @property
    def now(self) -> float:
        """Time of the drive, s."""
        return self.clocks.of_arrival(self._inputs.clock.now())

    def wall(self, duration: float) -> float:
        """How long a duration (s) takes by the machine's clock at most until another look at the drive's, s."""
        return self._inputs.clock.wall(duration)

    @property
    def horizon(self) -> float:
        """How much later than now the states are that estimates are of, s."""
        return self._estimator.horizon

    def take_poses(self, now: float) -> list[Observation]:
        """Observe the poses that have arrived, except refused ones."""
        found, arrived = [], self._inputs.take_poses()
        self.arrived = len(arrived)
        for pose in arrived:
            estimate = self._estimator.estimate(now)
            predicted = pose_of(estimate.state, self.model.vehicle)
            since = min(estimate.age, max(now, 0.0) + 1.0)
            reckoned = pose_of(self._open_loop, self.model.vehicle)
            speed = float(self._open_loop[self.model.v])
            observation = self.poses.observation(pose, predicted, reckoned, speed, since)
            if observation is not None:
                self.observe(observation)
                found.append(observation)
        return found

    def drop_poses(self) -> None:
        """Forget the poses that have arrived."""
        self._inputs.take_poses()

    def observe(self, observation: Observation) -> None:
        """Observe a pose, which another process may have received."""
        self._estimator.observe(observation)
        pose = observation.x, observation.y, observation.theta
        self._open_loop[self.model.pose] = pose
        self.response.observed(observation.arrival, pose)

    def learn(self, learned: Learned | None) -> bool:
        """Take over what another process has identified; whether it is new."""
        estimator = self._estimator
        if not isinstance(estimator, AdaptiveEstimator) or learned is None or learned is estimator.learned:
            return False
        estimator.learn(learned)
        return True

    def estimate(self, now: float) -> Estimate:
        """Estimate of the state."""
        return self._estimator.estimate(now)

    def command(self, now: float, estimate: Estimate) -> tuple[Floats, Reference]:
        """Command (nu,) for now, and the reference that it tracks."""
        reference = self.on_board.reference(estimate)
        stands = self.on_board.is_stopping and now >= reference.end
        tracked = self._standing(estimate, reference) if stands else reference
        command = self.model.clamped(self._controller.command(estimate, tracked))
        if now < 0.0 or (self.on_board.is_blind(estimate) and now >= reference.end):
            command = self.model.rest.copy()  # what holds a vehicle on a slope is not known any more
        return command, reference

    def _standing(self, estimate: Estimate, stop: Reference) -> Reference:
        """Reference that keeps a vehicle where it stands after a stop; tracking the stop, it would creep to its end."""
        if self._stands_after is not stop:
            if abs(estimate.state[self.model.v]) > STANDSTILL:
                return stop
            vehicle = self.model.present_vehicle
            self._stands_after = stop
            self._stand = standing_reference(vehicle, at_rest(vehicle, estimate.state), estimate.time)
        return self._stand

    @property
    def connections(self) -> int:
        """Number of connections to the robot that were made."""
        return self._transport.connections

    @property
    def halt(self) -> Floats:
        """Command (nu,) to stand, with the wheels as they are, for a time in which nothing can be timed."""
        command = self.model.rest.copy()
        for k, name in enumerate(self.model.vehicle.controls):
            if name == "steering":
                command[k] = self._last_command[k]
        return command

    def publish(self, now: float, command: Floats) -> None:
        """Send a command to the robot.

        Raises:
            Defect: if a number of it is not finite, of which a table of speeds or a motor would make any speed.
        """
        if not np.isfinite(command).all():
            values = ", ".join(f"{value:g}" for value in command)
            raise Defect(f"the command at t = {now:.3f} s is not finite: {values}")
        self._transport.publish(self._spec.robot.command.topic, self._codec.message(self.clocks.stamp(now), command))

    def commanded(self, time: float, command: Floats) -> None:
        """Tell the estimator what the vehicle is commanded from `time` (s) on."""
        before, heading = self._open_loop, self.model.pose[2]
        self._open_loop = self.model.advance(before, self._last_command, time - self.last_sent)
        self.response.commanded(float(self._open_loop[heading] - before[heading]))
        self._last_command, self.last_sent = command, time
        if time >= 0.0:
            self._estimator.commanded(time, command)


def warm_up(spec: DriveSpec) -> None:
    """Do once what a tick does: the first time takes a second, because compiled functions are loaded."""
    assert not isinstance(spec.method.estimator, Oracle), "no robot has it"
    model, settings = model_of(spec.vehicle), spec.method.planner
    start = spec.task.start
    state = spec.at_rest((start.x, start.y, start.heading))
    estimator = make_estimator(spec.method.estimator, model, state, spec.camera)
    controller, codec = make_controller(spec.controller, model), CommandCodec(spec.robot, spec.vehicle)
    times, states, rest = np.array([0.0, 1.0]), np.array([state, state]), model.rest
    reference = Reference(ReferenceKind.PLAN, times, states, rest[np.newaxis], rest)
    for k in range(1, 4):
        estimator.observe(Observation(0.1 * k, 0.1 * k, *pose_of(state, model.vehicle)))
        moving = estimator.estimate(0.1 * k).state
        moving[model.v] = 0.5 * model.vehicle.top_speed
        estimate = Estimate(0.1 * k, moving, 0.0)
        board = OnBoard(settings, Safety(cycle=settings.cycle), model, Commitment(reference))
        board.stop(estimate)
        command = controller.command(estimate, board.reference(estimate))
        estimator.commanded(0.1 * k, command)
        to_cdr(codec.message(0, command))
