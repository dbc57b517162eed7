"""True world of a scenario: apply commands, step, and read poses and collisions.

Poses are in the floor's frame, which is the planner's map frame.  The camera is in the world's frame, in which gravity
is vertical.  Without a tilt the two are the same.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import Code, Defect, InputError
from kraft.scenario import Scenario, Start
from kraft.scenario.truth import VehicleGap
from kraft.simulation.car import MARKER, design_of
from kraft.simulation.contacts import Collision, CollisionDetector
from kraft.simulation.floor_frame import FloorFrame
from kraft.simulation.robots import SimulatedCar, SimulatedRobot
from kraft.simulation.scene import build, set_friction
from kraft.vehicles.true_robot import CarDimensions
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

    def __init__(self, scenario: Scenario, robot: SimulatedRobot | None = None, visuals: bool = True) -> None:
        """Build the world with a robot at the start, by default the scenario's car.

        Without `visuals` it lacks what is only there to be seen, and steps take a tenth less time.

        Raises:
            InputError: if a movable box overlaps the robot, an obstacle or another one at the start.
        """
        robot = robot or SimulatedCar(design_of(scenario.truth.car or CarDimensions()))
        self.controls: Final = robot.controls
        truth, self._scenario = scenario.truth, scenario
        self._states = truth.states
        self.frame: Final = FloorFrame.of(truth.tilt)
        self.model: Final[Any] = copy.copy(_compiled(scenario, robot, visuals))
        self.data: Final[Any] = mujoco.MjData(self.model)
        self._start, self._goal = scenario.start, scenario.goal
        self._state, self._following = self._states[0], 1
        self._contacts = CollisionDetector(
            self.model, self.data, scenario, self.frame, robot.root, robot.has_plain_contacts
        )
        self._body, self._marker = self.data.body(robot.body), self.data.site(MARKER)
        self._robot, self._grip = robot.bind(self.model, self.data), robot.grip
        self._movable = [self.data.body(f"movable {i}") for i in range(len(truth.movable_boxes))]
        self._collision: Collision | None = None
        self._steps = 0
        self._place: tuple[float, float, float] | None = None  # pose of the robot, once it was asked for
        self.reset()
        self._check_boxes(scenario)

    def reset(self, start: Start | None = None, run: int | None = None) -> None:
        """Return to time 0 and to `start` (the scenario's if None), with zero controls; runs have no noise."""
        if self._following > 1:
            self._set_state(0)
        mujoco.mj_resetData(self.model, self.data)
        self._robot.place(self._start if start is None else start, self.frame, self._state.vehicle)
        self.apply([0.0] * len(self.controls))
        mujoco.mj_step1(self.model, self.data)
        self._steps, self._place = 0, None
        self._collision = self._contacts.first(0.0)

    def apply(self, control: Floats | Sequence[float]) -> None:
        """Hold a control from now on, in the order of `controls`, clamped to what the robot can do."""
        self._command = [float(value) for value in control]
        self._robot.apply(self._command, self._state.vehicle)

    def step(self, steps: int) -> None:
        """Advance by `steps` of `dt`, or to the first collision; after that nothing moves.

        Raises:
            Defect: the physics diverged.
        """
        end = self._steps + steps
        while self._steps < end and self._collision is None:
            if self._steps == self._next_change:
                self._change()
            after = self._next_change
            self._advance((end if after is None else min(end, after)) - self._steps)

    def _advance(self, steps: int) -> None:
        """Advance by `steps` or to the first collision, without changes of the world."""
        model, data, contacts = self.model, self.data, self._contacts
        self._place = None
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
    def _next_change(self) -> int | None:
        """Physics step of the next change of the world; None without one."""
        if self._following >= len(self._states):
            return None
        return steps_of(self._states[self._following].time, TIMESTEP)

    def _change(self) -> None:
        """Apply the next change of the world; the held command acts on the changed car."""
        self._set_state(self._following)
        self.apply(self._command)
        mujoco.mj_step1(self.model, self.data)  # contacts and inertia of the present time are those after the change

    def _set_state(self, number: int) -> None:
        """Set what can change during the drive to state `number` of the scenario's truth."""
        self._state, self._following = self._states[number], number + 1
        set_friction(self.model, self._scenario, self._state.floor_friction, self._grip)
        self._robot.change(self._state.vehicle)
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * TIMESTEP

    @property
    def gap(self) -> VehicleGap:
        """How the true car differs from its model now."""
        return self._state.vehicle

    @property
    def steps(self) -> int:
        """Physics steps since the start."""
        return self._steps

    @property
    def pose(self) -> Floats:
        """Position (m) of the robot's body and heading (rad) in the floor's frame, (3,)."""
        return np.array(self._planar_pose)

    @property
    def speed(self) -> float:
        """Speed of the robot's body along its heading in the floor's frame, m/s."""
        forward = self.frame.along_floor(self._body.xmat[0::3])
        velocity = self.frame.along_floor(self._robot.velocity)
        return (forward[0] * velocity[0] + forward[1] * velocity[1]) / math.hypot(*forward)

    @property
    def components(self) -> dict[str, float]:
        """True components of a vehicle's state beside pose and speed, by name: the turning rate, rad/s."""
        return {"omega": float(self.frame.normal @ self._body.cvel[:3])}

    @property
    def marker(self) -> tuple[Floats, Matrix]:
        """Position (3,), m, and rotation (3, 3) of the marker on the roof in the world's frame."""
        return self._marker.xpos.copy(), self._marker.xmat.reshape(3, 3).copy()

    @property
    def movable_poses(self) -> Matrix:
        """Centre (m) and heading (rad) of each movable box in the floor's frame, (n, 3)."""
        poses = np.empty((len(self._movable), 3))
        for k, box in enumerate(self._movable):
            poses[k] = self._planar(box)
        return poses

    @property
    def collision(self) -> Collision | None:
        """First contact with an obstacle, at which the world stopped; None without one."""
        return self._collision

    @property
    def in_goal(self) -> bool:
        """Whether the robot is in the goal region: position, and what else the goal bounds."""
        components = {"v": self.speed, **self.components} if self._goal.limits else {}
        return self._goal.contains(*self._planar_pose, components)

    @property
    def depth_in_floor(self) -> float:
        """Largest depth to which the robot is in the floor, m."""
        return self._contacts.depth_in_floor

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
        self._place = None

    def _check_boxes(self, scenario: Scenario) -> None:
        """Check that no movable box overlaps anything at the start, because contact forces would throw it away."""
        in_car = self._contacts.boxes_in_car()
        found = [(i, "stands where the car starts", "expected a box beside the start") for i in in_car]
        for i, other in self._contacts.overlapping_boxes():
            found.append((i, f"overlaps {other}", "expected a box that stands free or only touches"))
        if found:
            diagnostic = partial(scenario.source.diagnostic, code=Code.GEOMETRY)
            raise InputError(diagnostic(("truth", "movable_boxes", i), *texts) for i, *texts in found)

    @property
    def _planar_pose(self) -> tuple[float, float, float]:
        """Pose of the robot's body, computed once after each step: several ask for it."""
        if self._place is None:
            self._place = self._planar(self._body)
        return self._place

    def _planar(self, body: Any) -> tuple[float, float, float]:
        x, y = self.frame.along_floor(body.xpos - self.frame.origin)
        ahead, left = self.frame.along_floor(body.xmat[0::3])
        return x, y, math.atan2(left, ahead)


@lru_cache(4)
def _compiled(scenario: Scenario, robot: SimulatedRobot, visuals: bool) -> Any:
    """Compiled model of a scenario, kept because compiling takes as long as a second of a drive; copy it before use."""
    truth = scenario.truth
    add, add_visuals = partial(robot.add, gap=truth.vehicle), robot.add_visuals if visuals else None
    return build(scenario, FloorFrame.of(truth.tilt), TIMESTEP, add, add_visuals, grip=robot.grip)


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
