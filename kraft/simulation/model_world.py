"""World in which a vehicle's own model is true, with other parameters and process noise, without a physics engine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import Defect
from kraft.planning.workspace import planar_obstacle
from kraft.scenario import Scenario, Start
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.truth import VehicleGap
from kraft.simulation import contacts
from kraft.simulation.car import CAR
from kraft.simulation.contacts import Collision
from kraft.simulation.floor_frame import FloorFrame, quaternion, yaw_rotation
from kraft.simulation.scene import build
from kraft.simulation.world import TIMESTEP
from kraft.vehicles import felt_gravity
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels.specialise import kernels
from ompl_ext.names import FORCE
from ompl_ext.obstacles import Workspace
from ompl_ext.vehicle import Vehicle

STANDSTILL: Final = 0.01
"""Velocities below which the vehicle stands, and no noise moves it, m/s or rad/s."""
ROUNDING: Final = 1e-5
"""Largest error of a measured distance, m."""


class ModelWorld:
    """Simulated world of a scenario; the same commands and seed give the same bytes, in a new world or after `reset`.

    `dt` is the integration step, s.
    """

    dt: Final = TIMESTEP

    def __init__(self, scenario: Scenario, vehicle: Vehicle, process_noise: Mapping[str, float], seed: int) -> None:
        """Put the vehicle at the start.

        Args:
            scenario: obstacles, start and goal.
            vehicle: the true model, with its true parameters; its footprint is that of the true robot.
            process_noise: standard deviation that a component of the state gains in one second of motion, in its unit.
            seed: of the noise.
        """
        self.truth, self.controls = vehicle, tuple(vehicle.controls)
        self.gap: Final = VehicleGap()
        self.frame: Final = _floor_of(vehicle, scenario.start)
        self.movable_poses: Final[Matrix] = np.zeros((0, 3))
        self._scenario, self._seed = scenario, seed
        self._advance, self._parameters = kernels(vehicle).advance, vehicle.parameter_array
        self._pose = [vehicle.index(name) for name in ("x", "y", "theta")]
        self._velocities = list(vehicle.rest_indices)
        self._sigma = np.array([process_noise.get(name, 0.0) for name in vehicle.state]) * math.sqrt(self.dt)
        self._low, self._high = vehicle.control_bounds.T
        self._obstacles = _Obstacles(scenario, vehicle)
        self.reset()

    def reset(self, start: Start | None = None, run: int | None = None) -> None:
        """Return to time 0 and to `start` (the scenario's if None), with zero controls and the noise of a run."""
        start = self._scenario.start if start is None else start
        self._state = np.zeros(len(self.truth.state))
        self._state[self._pose] = start.x, start.y, start.heading
        self._state[self._velocities[0]] = start.speed
        numbers = [self._seed, 0x4015E] if run is None else [self._seed, run, 0x4015E]
        self._generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(numbers)))
        self._steps = 0
        self.apply(np.zeros(len(self.controls)))
        self._obstacles.forget()
        self._collision = self._obstacles.hit(self.pose, 0.0)

    def apply(self, control: Floats | Sequence[float]) -> None:
        """Hold a control (nu,) from now on, clamped to the bounds of the model."""
        self._control = np.ascontiguousarray(np.clip(control, self._low, self._high), dtype=np.float64)

    def step(self, steps: int) -> None:
        """Advance by `steps` of `dt`, or to the first collision; after that nothing moves.

        Raises:
            Defect: the model diverged.
        """
        state, noisy = self._state, bool(self._sigma.any())
        for _ in range(steps):
            if self._collision is not None:
                return
            self._advance(state, self._control, self._parameters, self.dt, state)
            if noisy and np.abs(state[self._velocities]).max() > STANDSTILL:
                state += self._sigma * self._generator.standard_normal(len(state))
            self._steps += 1
            self._collision = self._obstacles.hit(self.pose, self.time)
        if not np.isfinite(state).all():
            raise Defect(f"the model of {self.truth.name} diverged before t = {self.time:.3f} s")

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * self.dt

    @property
    def steps(self) -> int:
        """Integration steps since the start."""
        return self._steps

    @property
    def pose(self) -> Floats:
        """Position (m) and heading (rad), (3,)."""
        x, y, theta = self._state[self._pose].tolist()
        return np.array([x, y, math.remainder(theta, math.tau)])

    @property
    def speed(self) -> float:
        """Speed, m/s."""
        return float(self._state[self._velocities[0]])

    @property
    def components(self) -> dict[str, float]:
        """True components of the state, by name."""
        return dict(zip(self.truth.state, self._state.tolist(), strict=True))

    @property
    def marker(self) -> tuple[Floats, Matrix]:
        """Position (3,), m, and rotation (3, 3) of the marker on the roof."""
        x, y, theta = self._state[self._pose].tolist()
        frame = self.frame
        return frame.to_world(np.array([x, y, MARKER_HEIGHT])), frame.rotation @ yaw_rotation(theta)

    @property
    def collision(self) -> Collision | None:
        """First contact with an obstacle, at which the world stopped; None without one."""
        return self._collision

    @property
    def in_goal(self) -> bool:
        """Whether the true state is in the goal region."""
        x, y, theta = self._state[self._pose].tolist()
        return self._scenario.goal.contains(x, y, theta, self.components)

    @cached_property
    def model(self) -> Any:
        """MuJoCo's model of the scene with a block as the vehicle, compiled when it is first drawn."""
        return build(self._scenario, self.frame, self.dt, self._add_body, self._add_block)

    @property
    def data(self) -> Any:
        """MuJoCo's data of the present pose, for drawing."""
        x, y, theta = self._state[self._pose].tolist()
        rotation = self.frame.rotation @ yaw_rotation(theta)
        self._drawn.qpos[:] = *self.frame.to_world(np.array([x, y, 0.0])), *quaternion(rotation)
        mujoco.mj_forward(self.model, self._drawn)
        return self._drawn

    @cached_property
    def _drawn(self) -> Any:
        return mujoco.MjData(self.model)

    def _add_body(self, spec: Any) -> None:
        """Add a body for the vehicle."""
        body = spec.worldbody.add_body(name=CAR)
        body.add_freejoint()
        body.explicitinertial, body.mass, body.inertia = True, 1.0, [1.0, 1.0, 1.0]

    def _add_block(self, spec: Any) -> None:
        """Add the footprint as a block, with a stripe at its front."""
        shape, body = self.truth.footprint, spec.body(CAR)
        back, front = shape.ends
        parts = (("paint", back, 0.0), ("lamp", front - 0.1 * shape.length, 0.001))
        for material, rear, inset in parts:  # the stripe is a little larger, so that it is in front
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[(front + rear) / 2, 0.0, MARKER_HEIGHT / 2],
                size=[(front - rear) / 2 + inset, shape.width / 2 + inset, MARKER_HEIGHT / 2 + inset],
                material=material,
                **contacts.VISUAL,
            )


class _Obstacles:
    """Exact collision test of the footprint with the obstacles, with few distance queries.

    No point of the footprint moves farther than its centre moves plus its reach times the turn.  After a distance is
    measured, no obstacle can therefore be touched before the vehicle has moved that far.
    """

    def __init__(self, scenario: Scenario, vehicle: Vehicle) -> None:
        self._bounds, self._footprint = (scenario.bounds.x, scenario.bounds.y), vehicle.footprint
        self._solid = tuple(planar_obstacle(obstacle) for obstacle in scenario.obstacles)
        self._exact = ExactClearance(Workspace(self._bounds, self._solid), self._footprint)
        self._labels = scenario.obstacle_labels
        self._reach = self._footprint.reach
        self.forget()

    def forget(self) -> None:
        """Forget the measured distance, because the vehicle was moved."""
        self._left, self._last = -1.0, (0.0, 0.0, 0.0)

    def hit(self, pose: Floats, time: float) -> Collision | None:
        """Collision at a pose (3,), None if it is free."""
        x, y, theta = pose.tolist()
        x0, y0, theta0 = self._last
        self._last = x, y, theta
        self._left -= math.hypot(x - x0, y - y0) + self._reach * abs(math.remainder(theta - theta0, math.tau))
        if self._left > 0.0:
            return None
        distance = self._exact.distance(x, y, theta)
        self._left = distance - ROUNDING
        if distance > 0.0:
            return None
        touched = next(k for k in range(len(self._solid)) if self._touches(k, x, y, theta))
        return Collision(time, self._labels[touched], (x, y, 0.0))

    def _touches(self, k: int, x: float, y: float, theta: float) -> bool:
        return ExactClearance(Workspace(self._bounds, (self._solid[k],)), self._footprint).distance(x, y, theta) <= 0.0


def _floor_of(vehicle: Vehicle, start: Start) -> FloorFrame:
    """Floor on which the force of the vehicle's model is that of gravity, if the model states what share it feels.

    The floor has the height 0 at the start.
    """
    if vehicle.gravity_share is None:
        return FloorFrame.of(None)
    return FloorFrame.rising(slope_of(vehicle), np.array([start.x, start.y, 0.0]))


def slope_of(vehicle: Vehicle) -> Floats:
    """Slope (2,), rise per metre along x and y, by which gravity drives the vehicle with the force of its model."""
    return -np.array([vehicle.parameters[name] for name in FORCE]) / felt_gravity(vehicle)
