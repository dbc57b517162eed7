"""True world of a scenario: apply commands, step, and read poses and collisions.

Poses are in the floor's frame, which is the planner's map frame.  The camera is in the world's frame, in which gravity
is vertical.  Without a tilt the two are the same.
"""

from __future__ import annotations

import copy
import math
from functools import lru_cache
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import Code, Defect, InputError
from kraft.scenario import Scenario, Start
from kraft.simulation import car as drivetrain
from kraft.simulation.car import CAR, DRIVE, MARKER, STEERED, WHEELS, sag
from kraft.simulation.collision import Collision, CollisionDetector
from kraft.simulation.floor_frame import FloorFrame
from kraft.simulation.scene import build, quaternion, yaw_quaternion
from ompl_ext.arrays import Floats, Matrix

TIMESTEP: Final = 0.002


class World:
    """Simulated world of a scenario.  The same commands give the same bytes, in a new world or after `reset`.

    Attributes:
        dt: physics step, s.
        model: the compiled `mujoco.MjModel`, for drawing.
        data: its `mujoco.MjData`, for drawing and recording.
        frame: pose of the floor in the world.
    """

    dt: Final = TIMESTEP

    def __init__(self, scenario: Scenario) -> None:
        """Build the world with the car at the start.

        Raises:
            InputError: if a movable box overlaps the car at the start.
        """
        truth = scenario.truth
        self.frame: Final = FloorFrame.of(truth.tilt)
        self.model: Final[Any] = copy.copy(_compiled(scenario))
        self.data: Final[Any] = mujoco.MjData(self.model)
        self._start, self._goal, self._truth_vehicle = scenario.start, scenario.goal, truth.vehicle
        self._contacts = CollisionDetector(self.model, self.data, scenario, self.frame)
        self._body, self._marker = self.data.body(CAR), self.data.site(MARKER)
        self._joint = self.data.joint(CAR)
        self._velocity = self._joint.qvel[:3]  # a view, as all that MuJoCo's objects hand out
        self._movable = [self.data.body(f"movable {i}") for i in range(len(truth.movable_boxes))]
        inputs = self.model.actuator_ctrladr
        self._motor = inputs[self.model.actuator(DRIVE).id]
        self._servos = [inputs[self.model.actuator(f"{name} servo").id] for name in STEERED]
        self._collision: Collision | None = None
        self._steps = 0
        self.reset()
        self._check_start(scenario)

    def reset(self, start: Start | None = None) -> None:
        """Return to time 0 and to `start` (the scenario's if None), with zero throttle and straight wheels."""
        mujoco.mj_resetData(self.model, self.data)
        self._place(self._start if start is None else start)
        self.apply(0.0, 0.0)
        mujoco.mj_step1(self.model, self.data)
        self._steps = 0
        self._collision = self._contacts.first(0.0)

    def apply(self, throttle: float, steering: float) -> None:
        """Hold a command from now on; it is clamped to throttle in [-1, 1] and steering angle in [-0.38, 0.38] rad."""
        stop = drivetrain.STEERING_MAX
        commanded = min(max(steering, -stop), stop)
        true = commanded * self._truth_vehicle.steering_scale + self._truth_vehicle.steering_offset
        left, right = drivetrain.wheel_angles(drivetrain.LINKAGE * min(max(true, -stop), stop))
        control = self.data.ctrl
        control[self._motor] = self._truth_vehicle.drive_scale * drivetrain.wheel_torque(throttle)
        control[self._servos[0]], control[self._servos[1]] = left, right

    def step(self, steps: int) -> None:
        """Advance by `steps` of `dt`, or to the first collision; after that nothing moves.

        Raises:
            Defect: the physics diverged.
        """
        if self._collision is not None:
            return
        model, data, contacts = self.model, self.data, self._contacts
        for _ in range(steps):
            # in this order positions and contacts are those of the new time
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            self._steps += 1
            if contacts.may_have_collision:
                self._collision = contacts.first(self.time)
                if self._collision is not None:
                    break
        if not math.isfinite(sum(data.qvel.tolist())):
            raise Defect(f"the simulated world diverged before t = {self.time:.3f} s")

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * TIMESTEP

    @property
    def steps(self) -> int:
        """Physics steps since the start."""
        return self._steps

    @property
    def pose(self) -> Floats:
        """Position (m) midway between the axles and heading (rad) in the floor's frame, (3,)."""
        return np.array(self._planar(self._body))

    @property
    def speed(self) -> float:
        """Speed of the point midway between the axles along the car's heading in the floor's frame, m/s."""
        forward = self.frame.along_floor(self._body.xmat[0::3])
        velocity = self.frame.along_floor(self._velocity)
        return (forward[0] * velocity[0] + forward[1] * velocity[1]) / math.hypot(*forward)

    @property
    def marker(self) -> tuple[Floats, Matrix]:
        """Position (3,), m, and rotation (3, 3) of the marker on the roof in the world's frame."""
        return self._marker.xpos.copy(), self._marker.xmat.reshape(3, 3).copy()

    @property
    def movable_poses(self) -> Matrix:
        """Centre (m) and heading (rad) of each movable box in the floor's frame, (n, 3)."""
        return np.array([self._planar(box) for box in self._movable]).reshape(-1, 3)

    @property
    def collision(self) -> Collision | None:
        """First contact with an obstacle, at which the world stopped; None without one."""
        return self._collision

    @property
    def in_goal(self) -> bool:
        """Whether the car is in the goal region: position, and heading and speed `v` if the goal bounds them."""
        (x, y, theta), goal = self._planar(self._body), self._goal
        if math.hypot(x - goal.center[0], y - goal.center[1]) > goal.radius:
            return False
        low, high = goal.limits.get("v", (-math.inf, math.inf))
        if not low <= self.speed <= high:
            return False
        if goal.heading is None or goal.heading_tolerance is None:
            return True
        return abs(math.remainder(theta - goal.heading, 2 * math.pi)) <= goal.heading_tolerance

    @property
    def configuration(self) -> Floats:
        """Configuration (nq,) from which `show` restores the present state for pictures."""
        copy: Floats = self.data.qpos.copy()
        return copy

    def show(self, configuration: Floats) -> None:
        """Restore a recorded configuration for pictures, at rest and at time 0; call `reset` before driving again."""
        self.reset()
        self.data.qpos[:] = configuration
        mujoco.mj_step1(self.model, self.data)

    def _check_start(self, scenario: Scenario) -> None:
        """Check that no movable box overlaps the car at the start, because contact forces would throw them apart."""
        problem, expected = "stands where the car starts", "expected a box beside the start"
        keys = [("truth", "movable_boxes", i) for i in self._contacts.boxes_in_car()]
        if keys:
            diagnostic = scenario.source.diagnostic
            raise InputError(diagnostic(key, problem, expected, code=Code.GEOMETRY) for key in keys)

    def _place(self, start: Start) -> None:
        """Place the car on the floor, with its speed and the spin of its wheels."""
        rotation, sunk = self.frame.rotation, sag(self._truth_vehicle)
        upright = np.empty(4)
        mujoco.mju_mulQuat(upright, quaternion(rotation), np.array(yaw_quaternion(start.heading)))
        self._joint.qpos[:3] = self.frame.to_world(np.array([start.x, start.y, -sunk]))
        self._joint.qpos[3:] = upright
        direction = np.array([math.cos(start.heading), math.sin(start.heading), 0.0])
        self._joint.qvel[:3] = start.speed * rotation @ direction
        for name in WHEELS:
            self.data.joint(f"{name} suspension").qpos[:] = sunk
            self.data.joint(f"{name} spin").qvel[:] = start.speed / drivetrain.WHEEL_RADIUS

    def _planar(self, body: Any) -> tuple[float, float, float]:
        x, y = self.frame.along_floor(body.xpos - self.frame.origin)
        ahead, left = self.frame.along_floor(body.xmat[0::3])
        return x, y, math.atan2(left, ahead)


@lru_cache(4)
def _compiled(scenario: Scenario) -> Any:
    """Compiled model of a scenario, kept because compiling takes as long as a second of a drive; copy it before use."""
    return build(scenario, FloorFrame.of(scenario.truth.tilt), TIMESTEP)


def steps_of(duration: float, dt: float) -> int:
    """Number of physics steps of `dt` s nearest to a duration (s)."""
    return round(duration / dt)


class Ticks:
    """Periodic events at a rate (1/s), each at the nearest physics step of `dt` s; `number` of them are over."""

    def __init__(self, rate: float, dt: float) -> None:
        self._period, self.number = 1.0 / (rate * dt), 0

    @property
    def due(self) -> int:
        """Physics step of the next event."""
        return round(self.number * self._period)
