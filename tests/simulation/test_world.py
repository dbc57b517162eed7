"""A world stops at the first collision and names it, knows the goal, repeats itself, and agrees with the planner's map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.world import drive, open_world

from kraft.config import bundled
from kraft.planning.workspace import planar_obstacle
from kraft.scenario import Goal, Scenario, Start, load_scenario, parse_scenario
from kraft.simulation import World
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Workspace
from ompl_ext.vehicle import Footprint

FRONT = 0.21415
SCENES = bundled.names("scenario")
SHAPES = """
name: shapes
bounds: {x: [0, 6], y: [0, 6]}
obstacles:
  - box: {center: [1.5, 1.5], size: [1.2, 0.3], yaw_deg: 35}
  - {name: post, circle: {center: [4, 1.5], radius: 0.4}}
  - polygon: {vertices: [[3, 3], [5.5, 3], [5.5, 5.5], [4.5, 4]]}
  - map: {file: map.yaml, outside: free}
start: {x: 0.5, y: 3, heading_deg: 0}
goal: {center: [5, 2.5], radius: 0.25}
"""
MAP = "image: map.pgm\nresolution: 0.1\norigin: [1, 4, 0.3]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


@pytest.fixture
def shapes(tmp_path: Path) -> Scenario:
    pixels = np.full((10, 12), 254)
    pixels[2:5, 1:9] = pixels[5:8, 6:8] = 0
    (tmp_path / "map.pgm").write_text("P2 12 10 255\n" + "\n".join(" ".join(map(str, row)) for row in pixels))
    (tmp_path / "map.yaml").write_text(MAP)
    return parse_scenario(SHAPES, folder=tmp_path)


def test_a_collision_comes_when_the_bumper_reaches_the_box_and_has_its_name() -> None:
    world = World(load_scenario("boxes"))
    drive(world, 1.0, 0.0, 10.0)
    assert world.collision is not None
    assert world.collision.obstacle == "first box"
    assert world.collision.time == world.time
    assert world.collision.time / world.dt == pytest.approx(world.steps)
    depth = world.pose[1] + FRONT - 0.85
    assert -1e-4 < depth < world.speed * world.dt + 1e-4
    assert world.collision.point[1] == pytest.approx(0.85, abs=0.003)
    assert abs(world.collision.point[0] - 1.0) < 0.15


def test_nothing_moves_after_a_collision() -> None:
    world = World(load_scenario("boxes"))
    drive(world, 1.0, 0.0, 10.0)
    before, steps, collision = world.configuration, world.steps, world.collision
    world.step(100)
    assert np.array_equal(world.configuration, before)
    assert (world.steps, world.collision) == (steps, collision)


def test_an_obstacle_without_a_name_is_called_by_its_number(shapes: Scenario) -> None:
    world = World(replace(shapes, start=Start(1.5, 1.5, 0.0)))
    assert world.collision is not None
    assert (world.collision.obstacle, world.collision.time) == ("obstacles[0]", 0.0)
    world.reset(Start(4.0, 1.5, 0.0))
    assert world.collision is not None
    assert world.collision.obstacle == "post"
    world.reset(Start(0.5, 3.0, 0.0))
    assert world.collision is None


def test_a_wheel_that_touches_is_a_collision() -> None:
    world = World(load_scenario("turns"))
    world.reset(Start(2.2 - 0.134, 0.0, math.pi / 2))  # the box would not reach the wall, wheels are a little wider
    assert world.collision is not None
    assert world.collision.obstacle == "right wall"


def test_a_box_that_is_pushed_against_a_wall_is_no_collision() -> None:
    box = "movable_boxes: [{center: [1, 0], size: [0.4, 0.4, 0.2], mass: 1}]"
    world = open_world(box, obstacles="box: {center: [2.1, 0], size: [0.2, 2]}")
    drive(world, 1.0, 0.0, 10.0)
    assert world.movable_poses[0, 0] == pytest.approx(1.8, abs=0.003)
    assert abs(world.speed) < 0.01
    assert world.collision is None


def touches(world: World) -> bool:
    """Whether the car touches an obstacle, by the names of all geoms in contact."""
    car = world.model.body("car").id
    pairs = [[world.model.geom(k) for k in pair] for pair in world.data.contact.geom]
    return any(
        world.model.body_rootid[a.bodyid[0]] == car and b.name.startswith("obstacle")
        for pair in pairs
        for a, b in (pair, pair[::-1])
    )


def test_no_contact_with_an_obstacle_goes_unnoticed_while_boxes_are_pushed_about() -> None:
    world, ends = World(load_scenario("movable")), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        world.reset(Start(1.25, 0.0, math.pi / 2 + rng.uniform(-0.4, 0.1)))
        stood = world.movable_poses
        for step in range(3000):
            if step % 150 == 0:
                world.apply((1.0, rng.uniform(-0.2, 0.2)))
            world.step(1)
            assert touches(world) == (world.collision is not None)
        assert np.any(world.movable_poses != stood)
        ends.append(world.collision is not None)
    assert set(ends) == {False, True}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_loads_and_its_car_starts_and_drives(name: str) -> None:
    scene = load_scenario(name)
    world = World(scene)
    assert world.pose == pytest.approx((scene.start.x, scene.start.y, scene.start.heading))
    assert (world.time, world.steps, world.collision, world.in_goal) == (0.0, 0, None, False)
    drive(world, 1.0, 0.0, 1.0)
    x, y, _ = world.pose
    ahead = np.array([math.cos(scene.start.heading), math.sin(scene.start.heading)])
    assert (np.array([x, y]) - (scene.start.x, scene.start.y)) @ ahead > 0.1
    assert world.time == pytest.approx(1.0)


def agree(scene: Scenario, poses: NDArray[np.float64], margin: float) -> tuple[int, int]:
    """Compare MuJoCo with FCL on the car's own outline; numbers of poses in collision and free."""
    obstacles = tuple(planar_obstacle(obstacle) for obstacle in scene.obstacles)
    workspace = Workspace((scene.bounds.x, scene.bounds.y), obstacles)
    box = ExactClearance(workspace, Footprint(0.4389 - margin, 0.265 - margin, -0.0053))
    hull = ExactClearance(workspace, Footprint(0.4389 + margin, 0.271 + margin, -0.0053))  # wheels reach further
    world, hits, free = World(scene), 0, 0
    for x, y, theta in poses:
        world.reset(Start(x, y, theta))
        if box.collides(x, y, theta):
            assert world.collision is not None, (x, y, theta)
            hits += 1
        elif not hull.collides(x, y, theta):
            assert world.collision is None, (x, y, theta)
            free += 1
    return hits, free


@pytest.mark.parametrize("name", SCENES)
def test_mujoco_and_fcl_agree_on_what_is_in_collision(name: str) -> None:
    scene = load_scenario(name)
    low, high = (5.2, 6.0) if name.startswith("training") else (-0.1, 2.1)  # where there is something to hit
    poses = np.random.default_rng(7).uniform((low, -0.9, -math.pi), (high, 5.9, math.pi), (400, 3))
    hits, free = agree(scene, poses, margin=0.001)
    assert min(hits, free) > 50
    assert hits + free > 285


def test_they_agree_on_every_shape(shapes: Scenario) -> None:
    poses = np.random.default_rng(8).uniform((0, 0, -math.pi), (6, 6, math.pi), (600, 3))
    hits, free = agree(shapes, poses, margin=0.001)
    assert min(hits, free) > 100
    assert hits + free > 570


def test_the_planners_footprint_differs_from_the_car_by_less_than_its_own_margin() -> None:
    reach = math.hypot(0.22475 - 0.20, 0.0)
    scene = load_scenario("boxes")
    workspace = Workspace((scene.bounds.x, scene.bounds.y), tuple(map(planar_obstacle, scene.obstacles)))
    clearance, world = ExactClearance(workspace, Footprint(0.40, 0.28)), World(scene)
    for x, y, theta in np.random.default_rng(9).uniform((-0.1, -0.9, -math.pi), (2.1, 5.9, math.pi), (300, 3)):
        if clearance.distance(x, y, theta) > reach + 0.001:
            world.reset(Start(x, y, theta))
            assert world.collision is None


def test_in_the_goal_within_its_radius() -> None:
    world = World(load_scenario("turns"))
    for x, inside in ((1.24, True), (1.26, False)):
        world.reset(Start(x, 5.0, 2.0))
        assert world.in_goal is inside


def test_in_the_goal_with_its_heading() -> None:
    scene = replace(load_scenario("turns"), goal=Goal((1.0, 5.0), 0.25, math.pi, 0.2))
    world = World(scene)
    for heading, inside in ((math.pi - 0.19, True), (-math.pi + 0.19, True), (math.pi - 0.21, False), (0.0, False)):
        world.reset(Start(1.0, 5.0, heading))
        assert world.in_goal is inside


def wiggle(world: World) -> bytes:
    """All states of a drive with many commands, as bytes."""
    trace = []
    for k in range(40):
        world.apply((0.9 if k % 5 else -0.4, 0.38 * math.sin(k)))
        world.step(50)
        trace += [world.configuration.tobytes(), world.data.qvel.tobytes()]
    return b"".join(trace)


@pytest.mark.parametrize("name", ["bump", "slip", "movable", "slope"])
def test_the_same_commands_give_the_same_bytes_in_a_new_world_and_after_reset(name: str) -> None:
    world = World(load_scenario(name))
    first = wiggle(world)
    world.reset()
    assert wiggle(world) == first
    assert wiggle(World(load_scenario(name))) == first


def test_many_small_steps_are_one_large_one() -> None:
    small, large = open_world(), open_world()
    for world in (small, large):
        world.apply((0.7, 0.2))
    for _ in range(500):
        small.step(1)
    large.step(500)
    assert small.configuration.tobytes() == large.configuration.tobytes()


def test_a_recorded_moment_can_be_shown_again() -> None:
    world = World(load_scenario("movable"))
    drive(world, 1.0, -0.05, 7.0)
    pose, boxes, moment = world.pose, world.movable_poses, world.configuration
    assert abs(boxes[0, 2]) > 0.1
    drive(world, -1.0, 0.0, 3.0)
    world.show(moment)
    assert np.array_equal(world.pose, pose)
    assert np.array_equal(world.movable_poses, boxes)


def test_the_pose_is_that_of_the_present_moment() -> None:
    world = open_world()
    start = world.pose
    drive(world, 1.0, 0.0, 1.0)
    driven, moment = world.pose, world.configuration
    assert driven[0] > start[0] + 0.1
    world.reset(Start(2.0, 1.0, 0.5))
    assert world.pose == pytest.approx([2.0, 1.0, 0.5])
    world.show(moment)
    assert world.pose == pytest.approx(driven)
