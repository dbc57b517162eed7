"""The simulated robot: car, camera and obstacles of a scenario on the topics of a robot file, in real time.

Commands go through a multiplexer that stops the car when they stay away, as those of the F1TENTH and the MuSHR do.
"""

from __future__ import annotations

import math
import queue
import time as clock
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kraft.driving.vehicle_model import braking_control
from kraft.planning.workspace import start_state, workspace_of
from kraft.robot.announcement import announce
from kraft.robot.command import CommandCodec
from kraft.robot.display import occupancy_grid
from kraft.robot.messages import (
    BOOL,
    CLOCK,
    EPOCH,
    GRID,
    ODOMETRY,
    POSE,
    TRANSFORM,
    header,
    make,
    pose_fields,
    stamp,
    transform,
)
from kraft.robot.priority import short_collections
from kraft.robot.robot_file import Robot
from kraft.robot.transport import Transport
from kraft.scenario import Scenario
from kraft.simulation.true_world import TrueWorld, world_of
from kraft.simulation.world import Ticks, steps_of
from kraft.text import MessageSink, no_messages
from kraft.trial.closest_approach import ClosestApproach
from kraft.trial.measures import Step
from kraft.trial.plant import camera_of
from kraft.trial.result import Outcome
from ompl_ext.arrays import Floats
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

CHUNK: Final = 2
"""Physics steps between two looks at the clock and the commands."""
RECORD_RATE: Final = 30.0
"""Rate at which the clearance is measured and callbacks are called, 1/s."""
CLOCK_RATE: Final = 50.0
"""Rate of the messages of the simulation's time, 1/s of the machine's clock."""
DEAD_MAN_RATE: Final = 20.0
"""Rate of the messages of the simulated dead man, 1/s."""
MOVES: Final = 0.02
"""Throttle or other control from which on the drive counts as begun."""
STANDS: Final = 0.02
"""Speed below which the car stands, m/s."""
COASTING: Final = 3.0
"""Longest time for which the world goes on after the goal, s."""
LOOK_RATE: Final = 2.0
"""Rate at which the world looks who is connected before the drive begins, 1/s."""
SILENT: Final = 3.0
"""Time without a command after which the world says that it may wait in vain, s."""
BEHIND: Final = 1.0
"""Delay of the simulation behind the clock beyond which it gives up catching up, s."""


@dataclass(frozen=True)
class WorldResult:
    """How a simulated drive ended; `time` is since the first command that moves the car, s.

    `mux_stops` counts the times that the multiplexer stopped the car, `commands` the commands that arrived, `lag` is
    the largest delay of the simulation behind the clock (s), `lost` the time that it did not catch up (s), `standing`
    whether the car stands at the end.
    """

    scenario: str
    seed: int
    outcome: Outcome
    obstacle: str | None
    time: float
    min_clearance: float
    commands: int
    mux_stops: int
    lag: float
    lost: float
    standing: bool


class RobotWorld:
    """The simulated robot of a scenario on the topics of a robot."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle, robot: Robot, transport: Transport, seed: int) -> None:
        """Announce the topics.

        Args:
            scenario: the scene, and what is true in it.
            vehicle: model by which commands are understood.
            robot: topics, units and the multiplexer's timeout.
            transport: the robot's end of the transport.
            seed: of the camera's errors.

        Raises:
            InputError: if the true robot cannot be simulated there or takes other controls.
            MissingDependency: if frames are rendered and OpenCV or OpenGL is missing.
        """
        self._scenario, self._vehicle, self._robot, self._transport = scenario, vehicle, robot, transport
        self.world: TrueWorld = world_of(scenario, vehicle, seed)
        self._seed, self._camera = seed, camera_of(self.world, scenario, seed)
        self._codec = CommandCodec(robot, vehicle)
        self._order = [list(vehicle.controls).index(name) for name in self.world.controls]
        self._arrived: queue.SimpleQueue[tuple[Floats, int]] = queue.SimpleQueue()
        self._future: deque[tuple[Floats, int]] = deque()  # arrived later than the time that is simulated
        self._delayed: deque[tuple[int, Floats]] = deque()
        self._outgoing: deque[tuple[int, str, Any]] = deque()
        exact = ExactClearance(workspace_of(scenario, vehicle), vehicle.footprint)
        self._approach = ClosestApproach(exact.distance, vehicle.footprint.reach)
        self._held = np.zeros(len(vehicle.controls))
        self._last_command: int | None = None
        self._stopped, self._waits = True, False
        self._commands = self.mux_stops = 0
        self._behind = self._lag = self._lost = 0.0
        self._began = self._connected = False
        self.cancelled = False
        transport.subscribe(robot.command.topic, robot.command.type, self._take)
        announce(transport, scenario.task(), vehicle)
        transport.advertise(robot.pose.topic, robot.pose.type)
        if robot.dead_man is not None:
            transport.advertise(robot.dead_man.topic, robot.dead_man.type)
        if robot.clock is not None:
            transport.advertise(robot.clock.topic, CLOCK)
        if robot.map is not None:
            transport.advertise(robot.map.topic, GRID, latched=True)
            grid = occupancy_grid(scenario.task(), clock.time_ns(), robot.pose.frame)
            transport.publish(robot.map.topic, grid)

    def _take(self, message: Any, arrival: int) -> None:
        control = self._codec.control(message)
        if control is not None:
            self._arrived.put((control, arrival))

    def run(
        self,
        on_step: Callable[[TrueWorld, Step], None] | None = None,
        patience: float = math.inf,
        speed: float = 1.0,
        *,
        stays: bool = False,
        report: MessageSink = no_messages,
    ) -> WorldResult:
        """Simulate in real time until the goal, a collision or the time limit of the scenario.

        The world stands still until the first command that moves the car; its camera does not.

        Args:
            on_step: called with the world 30 times a second.
            patience: time to wait for that command, s.
            speed: seconds of the simulation in a second of the clock; others than 1 take a robot with a `clock`.
            stays: go on after the goal or the time limit until `cancelled` is set.
            report: receives a message when somebody connects, when the drive begins, when commands stay away, and when
                they are back.
        """
        assert speed == 1.0 or self._robot.clock is not None, "others must know the time"
        self._speed, self._report = speed, report
        with short_collections():
            return self._run(on_step, patience, stays)

    def _run(self, on_step: Callable[[TrueWorld, Step], None] | None, patience: float, stays: bool) -> WorldResult:
        world, dt = self.world, self.world.dt
        rates = self._scenario.sensing.rate_hz, RECORD_RATE, DEAD_MAN_RATE, CLOCK_RATE / self._speed, LOOK_RATE
        self._frames, records, self._switch, self._times, looks = (Ticks(rate, dt) for rate in rates)
        self._opened = clock.monotonic_ns()
        steps, ended, outcome = 0, None, None
        while True:
            self._wait(steps * dt)
            self._exchange(steps)
            if self._began and steps >= records.due:
                records.number = int(steps * dt * RECORD_RATE) + 1
                self._record(on_step)
            found = self._outcome()
            if outcome is None or (found is Outcome.COLLISION and outcome is not found):  # also after the goal
                outcome, ended = found, None if found is None else world.time
            if not self._began and steps >= looks.due:
                looks.number += 1
                self._look()
            steps += CHUNK
            if not self._began:
                if self.cancelled or steps * dt > patience:
                    break
            elif world.collision is None:
                world.step(CHUNK)
            coasted = abs(world.speed) < STANDS or world.time > (ended or 0.0) + COASTING
            over = outcome is Outcome.COLLISION or (coasted and not stays)
            if self.cancelled or (outcome is not None and over):
                break
        return self._result(outcome or Outcome.TIMEOUT, world.time if ended is None else ended)

    def _exchange(self, steps: int) -> None:
        """Apply the commands and send the messages that are due after some physics steps."""
        if self._robot.clock is None:  # the time that is simulated, also by a simulation that is behind the clock
            self._stamp = clock.time_ns() - round(1e9 * self._behind)
        else:
            self._stamp = EPOCH + round(1e9 * steps * self.world.dt)
            if steps >= self._times.due:
                self._times.number += 1
                self._transport.publish(self._robot.clock.topic, clock_message(self._stamp))
        self._mux(steps)
        if steps >= self._frames.due:
            self._frames.number += 1
            self._expose(steps)
        if steps >= self._switch.due:
            self._switch.number += 1
            self._hold_dead_man()
        while self._outgoing and self._outgoing[0][0] <= steps:
            _, topic, message = self._outgoing.popleft()
            self._transport.publish(topic, message)

    def _result(self, outcome: Outcome, time: float) -> WorldResult:
        """Result of a simulation with an outcome at a time (s)."""
        world = self.world
        obstacle = world.collision.obstacle if world.collision and outcome is Outcome.COLLISION else None
        return WorldResult(
            self._scenario.name, self._seed, outcome, obstacle, time,
            self._approach.least(), self._commands, self.mux_stops, self._lag, self._lost, abs(world.speed) < STANDS,
        )  # fmt: skip

    def _wait(self, due: float) -> None:
        """Sleep until a time of the simulation (s); one that is behind catches up, one that is far behind does not."""
        left = due / self._speed - 1e-9 * (clock.monotonic_ns() - self._opened)
        self._behind = max(0.0, -left)
        if left > 0.0:
            clock.sleep(left)
            return
        self._lag = max(self._lag, self._behind)
        if self._behind > BEHIND:
            self._lost += self._behind
            self._opened += round(1e9 * self._behind)
            self._behind = 0.0

    def _outcome(self) -> Outcome | None:
        if self.world.collision is not None:
            return Outcome.COLLISION
        if self.world.in_goal:
            return Outcome.SUCCESS
        return Outcome.TIMEOUT if self.world.time >= self._scenario.trial.timeout else None

    def _mux(self, steps: int) -> None:
        """Apply the commands whose delay is over; without a recent one brake with the wheels as they are."""
        delay = steps_of(self._scenario.sensing.command_delay, self.world.dt)
        while not self._arrived.empty():
            self._future.append(self._arrived.get())
        simulated = clock.monotonic_ns() - round(1e9 * self._behind)
        while self._future and self._future[0][1] <= simulated:
            control, _ = self._future.popleft()
            self._commands += 1
            self._last_command, self._stopped = steps, False
            if self._waits:
                self._waits = False
                self._report(f"{self.world.time:6.2f} s  commands arrive again")
            self._delayed.append((steps + delay, control))
            if not self._began and np.abs(control[self._driving]).max(initial=0.0) > MOVES:
                self._began = True
                self._report("the first command that moves the car has arrived: the drive begins")
        while self._delayed and self._delayed[0][0] <= steps:
            self._held = self._delayed.popleft()[1]
            self.world.apply(self._held[self._order])
        silence = math.inf if self._last_command is None else (steps - self._last_command) * self.world.dt
        if silence > self._robot.command.timeout and self._began:
            if not self._stopped:
                self._stopped = True
                self.mux_stops += 1
            self.world.apply(self._braking()[self._order])
            if silence > SILENT and not self._waits:
                self._waits = True
                self._report(self._why_it_waits())

    def _why_it_waits(self) -> str:
        """What to say when commands stay away: the drive may have ended by its estimate, which is not known here."""
        now = self.world.time
        left = max(0.0, self._scenario.trial.timeout - now) / self._speed
        return (
            f"{now:6.2f} s  no command for {SILENT:g} s, and the car is not in the goal: if the drive has ended, the "
            f"standing car is simulated until the time limit all the same, {left:.0f} s from now"
        )

    @property
    def _driving(self) -> list[int]:
        """Indices of the controls that move the car."""
        return [k for k, name in enumerate(self._vehicle.controls) if name != "steering"]

    def _braking(self) -> Floats:
        """Control with which the motor's controller holds the speed 0, with the steering that is held."""
        state = start_state(self._scenario.task(), self._vehicle)
        state[self._vehicle.rest_indices[0]] = self.world.speed if abs(self.world.speed) > STANDS else 0.0
        return braking_control(self._vehicle, state, self._held)

    def _expose(self, steps: int) -> None:
        """Take a frame; its pose is sent after the camera's latency."""
        observation = self._camera.expose(steps * self.world.dt, *self.world.marker)
        if observation is None:
            return
        settings, now = self._robot.pose, self._stamp
        pose = settings.tracked_point.tracked_pose(observation.x, observation.y, observation.theta)
        after = steps_of(self._scenario.sensing.latency, self.world.dt)
        self._outgoing.append((steps + after, settings.topic, pose_message(settings.type, now, settings.frame, pose)))

    def _look(self) -> None:
        """Tell when somebody who may send commands connects or leaves, where the transport can tell."""
        topic = self._robot.command.topic
        connected = bool(self._transport.peers(topic).publishers)
        if connected and not self._connected:
            self._report(f"connected: waiting for the first command on {topic} that moves the car")
        elif self._connected and not connected:
            self._report("nobody is connected any more: waiting for another one")
        self._connected = connected

    def _hold_dead_man(self) -> None:
        switch = self._robot.dead_man
        if switch is None:
            return
        if switch.type == BOOL:
            message = make(BOOL, data=True)
        else:
            buttons = [0] * ((switch.button or 0) + 1)
            buttons[-1] = 1
            message = make(switch.type, header=header(self._stamp, ""), buttons=buttons)
        self._transport.publish(switch.topic, message)

    def _record(self, on_step: Callable[[TrueWorld, Step], None] | None) -> None:
        x, y, theta = map(float, self.world.pose)
        self._approach.add(x, y, theta)
        if on_step is not None:
            state = start_state(self._scenario.task(), self._vehicle)
            for name, value in zip(("x", "y", "theta"), (x, y, theta), strict=True):
                state[self._vehicle.index(name)] = value
            on_step(self.world, Step(self.world.time, (x, y, theta), self.world.speed, state, self._held, 0))


def clock_message(time: int) -> Any:
    """Time of a simulation (ns) as a message."""
    return make(CLOCK, clock=stamp(time))


def pose_message(kind: str, time: int, frame: str, pose: tuple[float, float, float]) -> Any:
    """Pose as a message of one of the types that robots send."""
    if kind == TRANSFORM:
        return make(TRANSFORM, **transform(time, frame, "base_link", pose))
    if kind == POSE:
        return make(POSE, header=header(time, frame), pose=pose_fields(*pose))
    child = {"child_frame_id": "base_link"} if kind == ODOMETRY else {}
    return make(kind, header=header(time, frame), pose={"pose": pose_fields(*pose)}, **child)
