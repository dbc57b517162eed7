"""MuJoCo model of a scenario: floor, obstacles and all that is hidden from the planner, in the floor's frame."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np

from kraft.scenario import Box, Circle, Obstacle, OccupancyMap, Polygon, Scenario
from kraft.scenario.truth import FrictionPatch, MovableBox, SpeedBump
from kraft.simulation import appearance, contacts
from kraft.simulation.contacts import GROUND
from kraft.simulation.floor_frame import FloorFrame, quaternion, yaw_quaternion, yaw_rotation
from kraft.vehicles import GRAVITY
from ompl_ext.arrays import Matrix
from ompl_ext.triangulate import triangles

BOX, CYLINDER, MESH = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_MESH

PATCH_RISE: Final = 0.001
"""Height of a friction patch above the floor (m), so that a wheel on it does not touch the floor as well."""
PATCH_DEPTH: Final = 0.05
"""Depth to which a friction patch reaches below the floor (m), so that no wheel that sinks in leaves it below."""
MAX_SEPARATE_BODIES: Final = 12
"""Number of obstacles up to which each is a body of its own.  MuJoCo's broad phase is faster with a few bodies than
with the geoms of one body, and slower with more than twenty.  This affects only the computing time."""
WALL_RATIO: Final = 10.0
"""A box this many times longer than wide is painted as a wall."""


def add_scene(spec: Any, scenario: Scenario, frame: FloorFrame, grip: float = 1.0) -> None:
    """Add the floor and all that stands on it.  Obstacle i has geoms "obstacle i part j".

    `grip` is a factor on the friction of floor, bumps and patches, that of the robot's tyres.
    """
    ground = _add_body(spec, GROUND, frame)
    truth = scenario.truth
    friction = contacts.friction(truth.floor_friction * grip)
    ground.add_geom(
        name=GROUND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.05],
        friction=friction,
        group=3,
        **contacts.settings(**contacts.FLOOR),
    )
    for i, patch in enumerate(truth.friction_patches):
        _add_patch(ground, i, patch, grip)
    for i, bump in enumerate(truth.speed_bumps):
        _add_bump(ground, i, bump, friction)
    separate = len(scenario.obstacles) <= MAX_SEPARATE_BODIES
    for i, obstacle in enumerate(scenario.obstacles):
        _add_obstacle(spec, _add_body(spec, f"obstacle {i}", frame) if separate else ground, i, obstacle)
    for i, box in enumerate(truth.movable_boxes):
        _add_movable(spec, i, box, min(box.friction, truth.floor_friction), frame)


def _add_patch(ground: Any, i: int, patch: FrictionPatch, grip: float) -> None:
    (x0, x1), (y0, y1) = patch.x, patch.y
    ground.add_geom(
        name=f"patch {i}",
        type=BOX,
        pos=[(x0 + x1) / 2, (y0 + y1) / 2, PATCH_RISE - PATCH_DEPTH],
        size=[(x1 - x0) / 2, (y1 - y0) / 2, PATCH_DEPTH],
        friction=contacts.friction(patch.friction * grip),
        material="ice",
        **contacts.settings(**contacts.PATCH),
    )


def _add_bump(ground: Any, i: int, bump: SpeedBump, friction: list[float]) -> None:
    """A slice of a cylinder that lies along the longer side, deep enough that the slice has the bump's size."""
    across, along = sorted(bump.size)
    height = min(bump.height, across / 2)  # a half cylinder is as steep as it gets
    radius = ((across / 2) ** 2 + height**2) / (2 * height)
    yaw = bump.yaw + (0.0 if bump.size[0] >= bump.size[1] else math.pi / 2)
    lying = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # the cylinder's axis is its own z
    rotation = yaw_rotation(yaw)
    quat = quaternion(rotation @ lying)
    ground.add_geom(
        name=f"bump {i}",
        type=CYLINDER,
        pos=[*bump.center, height - radius],
        quat=quat,
        size=[radius, along / 2, 0.0],
        friction=friction,
        material="bump",
        **contacts.settings(**contacts.BUMP),
    )


def _add_body(spec: Any, name: str, frame: FloorFrame) -> Any:
    """A body that does not move, in the floor's frame."""
    return spec.worldbody.add_body(name=name, pos=frame.origin, quat=quaternion(frame.rotation))


def is_wall(obstacle: Obstacle) -> bool:
    """Whether an obstacle is so long and thin that it has the look of a wall."""
    return isinstance(obstacle, Box) and max(obstacle.size) > WALL_RATIO * min(obstacle.size)


def _add_obstacle(spec: Any, body: Any, i: int, obstacle: Obstacle) -> None:
    material, bits = "wall" if is_wall(obstacle) else "obstacle", contacts.settings(**contacts.OBSTACLE)
    shapes = obstacle.boxes() if isinstance(obstacle, OccupancyMap) else (obstacle,)
    parts = [geom for shape in shapes for geom in _geoms(spec, f"obstacle {i}", shape)]
    for j, geom in enumerate(parts):
        body.add_geom(name=f"obstacle {i} part {j}", material=material, **geom, **bits)


def _geoms(spec: Any, name: str, shape: Box | Circle | Polygon) -> list[dict[str, Any]]:
    half = shape.height / 2
    match shape:
        case Box():
            size = [shape.size[0] / 2, shape.size[1] / 2, half]
            return [{"type": BOX, "pos": [*shape.center, half], "quat": yaw_quaternion(shape.yaw), "size": size}]
        case Circle():
            return [{"type": CYLINDER, "pos": [*shape.center, half], "size": [shape.radius, half, 0.0]}]
        case Polygon():
            pieces = triangles(np.array(shape.vertices))
            return [_prism(spec, f"{name} piece {k}", corners, shape.height) for k, corners in enumerate(pieces)]


def _prism(spec: Any, name: str, corners: Matrix, height: float) -> dict[str, Any]:
    """An upright prism over convex corners (n, 2); the mesh's own frame is its inertia's, MuJoCo puts it back."""
    low = np.column_stack([corners, np.zeros(len(corners))])
    high = np.column_stack([corners, np.full(len(corners), height)])
    spec.add_mesh(name=name, uservert=np.vstack([low, high]).ravel())
    return {"type": MESH, "meshname": name}


def _add_movable(spec: Any, i: int, box: MovableBox, sliding: float, frame: FloorFrame) -> None:
    length, width, height = box.size
    upright = frame.rotation @ yaw_rotation(box.yaw)
    place = frame.to_world(np.array([*box.center, height / 2]))
    body = spec.worldbody.add_body(name=f"movable {i}", pos=place, quat=quaternion(upright))
    body.add_freejoint(name=f"movable {i}")
    body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_INIT  # it stands still until something touches it
    body.add_geom(
        name=f"movable {i}",
        type=BOX,
        size=[length / 2, width / 2, height / 2],
        mass=box.mass,
        material="cardboard",
        friction=contacts.friction(sliding),
        **contacts.settings(**contacts.MOVABLE),
    )


def set_friction(model: Any, scenario: Scenario, floor_friction: float, grip: float) -> None:
    """Set the friction of the floor, with that of the bumps on it and of the boxes that slide on it."""
    truth = scenario.truth
    for name in (GROUND, *(f"bump {i}" for i in range(len(truth.speed_bumps)))):
        model.geom(name).friction[:] = contacts.friction(floor_friction * grip)
    for i, box in enumerate(truth.movable_boxes):
        model.geom(f"movable {i}").friction[:] = contacts.friction(min(box.friction, floor_friction))


def build(
    scenario: Scenario,
    frame: FloorFrame,
    timestep: float,
    add_robot: Callable[[Any], None],
    add_robot_visuals: Callable[[Any], None] | None,
    grip: float = 1.0,
) -> Any:
    """Compile the world of a scenario with the robot that `add_robot` adds; returns a `mujoco.MjModel`.

    What is only there to be seen is added last, `add_robot_visuals` adding that of the robot; without that function
    nothing is.  `grip` is a factor on the friction of the floor, that of the robot's tyres.
    """
    spec = mujoco.MjSpec()
    spec.modelname = scenario.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep
    option.gravity = [0.0, 0.0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # a world that diverges must be an error, not reset itself silently
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if scenario.truth.movable_boxes:
        option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # boxes that nothing has touched cost no time
        # the car and each box share few rows: while it pushes, steps take up to a quarter less than with full matrices
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    else:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND  # a single body needs no search for islands
    appearance.add_materials(spec)
    add_scene(spec, scenario, frame, grip)
    add_robot(spec)
    if add_robot_visuals is not None:
        appearance.add_visuals(spec, spec.body(GROUND), scenario, frame)
        add_robot_visuals(spec)
    with warnings.catch_warnings():  # a box that touches the car is awake from the start, as it should be
        warnings.filterwarnings("ignore", message=".*could be slept")
        return spec.compile()
