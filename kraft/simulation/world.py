"""The true world of a scenario: apply commands, step, and see what happened.

Poses are in the floor's frame, which is the planner's map frame; a camera looks from the world's frame, in which
gravity is vertical. Without a tilt the two are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import Defect
from kraft.scenario import Scenario
from kraft.simulation import drivetrain
from kraft.simulation.build import build
from kraft.simulation.car import CAR, DRIVE, MARKER, STEERED, WHEELS, sag
from kraft.simulation.floor_frame import FloorFrame
from kraft.simulation.scene import quaternion, turn
from ompl_ext.arrays import Floats, Matrix

TIMESTEP: Final = 0.002


@dataclass(frozen=True)
class Collision:
    """First contact of the car with a static obstacle.

    Attributes:
        time: s.
        obstacle: its name in the scenario, or ``obstacles[i]``.
        point: (x, y, z) in the floor's frame, m.
    """

    time: float
    obstacle: str
    point: tuple[float, float, float]


class World:
    """A scenario's truth. Deterministic: the same commands give the same bytes, in a new world or after `reset`."""

    dt: Final = TIMESTEP

    def __init__(self, scenario: Scenario) -> None:
        self._frame = FloorFrame.of(scenario.bounds, scenario.truth.tilt)
        self.model: Any = build(scenario, self._frame, TIMESTEP)
        self.data: Any = mujoco.MjData(self.model)
        self._start, self._goal, self._gap = scenario.start, scenario.goal, scenario.truth.vehicle
        self._labels = [obstacle.name or f"obstacles[{i}]" for i, obstacle in enumerate(scenario.obstacles)]
        self._obstacle_of = self._obstacles_by_geom()
        self._solid = self._obstacle_of >= 0
        body = self.model.body(CAR).id
        self._of_car = self.model.body_rootid[self.model.geom_bodyid] == body
        self._body = self.data.body(CAR)
        self._marker = self.data.site(MARKER)
        self._movable = [self.data.body(f"movable {i}") for i in range(len(scenario.truth.movable_boxes))]
        inputs = self.model.actuator_ctrladr
        self._motor = inputs[self.model.actuator(DRIVE).id]
        self._servos = [inputs[self.model.actuator(f"{name} servo").id] for name in STEERED]
        self._collision: Collision | None = None
        self._steps = 0
        self.reset()

    def reset(self) -> None:
        """Back to the start, at time 0, commands and all."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        start, sunk = self._start, sag(self._gap)
        free = data.joint(CAR)
        upright = np.empty(4)
        mujoco.mju_mulQuat(upright, quaternion(self._frame.rotation), np.array(turn(start.heading)))
        free.qpos[:3] = self._frame.to_world(np.array([start.x, start.y, -sunk]))
        free.qpos[3:] = upright
        along = self._frame.rotation @ np.array([math.cos(start.heading), math.sin(start.heading), 0.0])
        free.qvel[:3] = start.speed * along
        for name in WHEELS:
            data.joint(f"{name} suspension").qpos[:] = sunk
            data.joint(f"{name} spin").qvel[:] = start.speed / drivetrain.WHEEL_RADIUS
        self._steps, self._collision = 0, None
        self.apply(0.0, 0.0)
        mujoco.mj_step1(model, data)
        self._look_for_collision()

    def apply(self, throttle: float, steering: float) -> None:
        """Command the car from now on; throttle in [-1, 1] and steering angle in [-0.38, 0.38] rad are clamped."""
        stop = drivetrain.STEERING_MAX
        commanded = min(max(steering, -stop), stop)
        true = commanded * self._gap.steering_scale + self._gap.steering_offset
        left, right = drivetrain.wheel_angles(drivetrain.LINKAGE * min(max(true, -stop), stop))
        control = self.data.ctrl
        control[self._motor] = self._gap.drive_scale * drivetrain.wheel_torque(throttle)
        control[self._servos[0]], control[self._servos[1]] = left, right

    def step(self, steps: int) -> None:
        """Go on by `steps` of `dt`, or to the first collision; after that nothing moves.

        Raises:
            Defect: the physics diverged.
        """
        model, data, solid = self.model, self.data, self._solid
        for _ in range(steps if self._collision is None else 0):
            # in this order positions and contacts are those of the new time
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            self._steps += 1
            if solid[data.contact.geom].any() and self._look_for_collision():
                break
        if not np.isfinite(data.qvel).all():
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
        return self._planar(self._body)

    @property
    def speed(self) -> float:
        """Speed of that point along the car's heading in the floor's frame, m/s."""
        forward = self._frame.rotation.T @ self._body.xmat[0::3]
        velocity = self._frame.rotation.T @ self.data.joint(CAR).qvel[:3]
        return float((forward[0] * velocity[0] + forward[1] * velocity[1]) / math.hypot(forward[0], forward[1]))

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
        """The first contact with an obstacle, at which the world stopped."""
        return self._collision

    @property
    def in_goal(self) -> bool:
        """Whether the car truly is within the goal region, with the heading if the goal has one."""
        x, y, theta = self.pose
        goal = self._goal
        if math.hypot(x - goal.center[0], y - goal.center[1]) > goal.radius:
            return False
        if goal.heading is None or goal.heading_tolerance is None:
            return True
        return abs(math.remainder(theta - goal.heading, 2 * math.pi)) <= goal.heading_tolerance

    @property
    def frame(self) -> FloorFrame:
        """Where the floor is."""
        return self._frame

    def _planar(self, body: Any) -> Floats:
        x, y, _ = self._frame.to_floor(body.xpos)
        forward = self._frame.rotation.T @ body.xmat[0::3]
        return np.array([x, y, math.atan2(forward[1], forward[0])])

    def _obstacles_by_geom(self) -> Any:
        """Index of the obstacle that a geom is part of, or -1, for every geom."""
        found = np.full(self.model.ngeom, -1)
        for geom in range(self.model.ngeom):
            words = self.model.geom(geom).name.split()
            if words[:1] == ["obstacle"]:
                found[geom] = int(words[1])
        return found

    def _look_for_collision(self) -> bool:
        """Keep the first contact between car and obstacle, if there is one."""
        for contact in self.data.contact:
            one, other = contact.geom
            if self._of_car[other]:
                one, other = other, one
            if self._of_car[one] and self._solid[other] and contact.dist <= 0.0:
                x, y, z = self._frame.to_floor(contact.pos).tolist()
                self._collision = Collision(self.time, self._labels[self._obstacle_of[other]], (x, y, z))
                return True
        return False
