"""What the planner is not told acts as physics says: friction, bumps, slopes, boxes that give way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.world import drive, open_world

from kraft.errors import Code, InputError
from kraft.scenario import load_scenario
from kraft.simulation import World

GRAVITY = 9.81
UPHILL = "tilt: {angle: 0.125, uphill_deg: 0}"


def sideways_deceleration(truth: str) -> float:
    """Of a car that slides sideways at 0.6 m/s, m/s^2."""
    world = open_world(truth)
    world.step(100)
    world.data.joint("car").qvel[1] = 0.6
    world.step(25)
    before = world.data.joint("car").qvel[1]
    world.step(100)
    return float(before - world.data.joint("car").qvel[1]) / (100 * world.dt)


@pytest.mark.parametrize("friction", [0.08, 0.2])
def test_a_slide_on_a_patch_is_stopped_by_its_friction_alone(friction: float) -> None:
    patch = f"floor_friction: 1.0, friction_patches: [{{x: [-3, 3], y: [-3, 3], friction: {friction}}}]"
    assert sideways_deceleration(patch) == pytest.approx(friction * GRAVITY, rel=0.05)


def test_a_slide_beside_the_patch_is_stopped_by_the_floor() -> None:
    truth = "floor_friction: 0.15, friction_patches: [{x: [3, 4], y: [-3, 3], friction: 0.08}]"
    assert sideways_deceleration(truth) == pytest.approx(0.15 * GRAVITY, rel=0.05)


def test_a_patch_may_grip_better_than_the_floor() -> None:
    truth = "floor_friction: 0.05, friction_patches: [{x: [-3, 3], y: [-3, 3], friction: 0.2}]"
    assert sideways_deceleration(truth) == pytest.approx(0.2 * GRAVITY, rel=0.05)


def test_wheels_spin_where_the_floor_does_not_carry_the_drive() -> None:
    run = drive(open_world("floor_friction: 0.04"), 1.0, 0.0, 1.0)
    gained = (run["v"][60] - run["v"][20]) / (run["t"][60] - run["t"][20])
    assert gained == pytest.approx(0.04 * GRAVITY, rel=0.1)
    grip = drive(open_world(), 1.0, 0.0, 1.0)
    assert grip["v"][60] > 1.4 * run["v"][60]


def test_the_car_climbs_the_slope_more_slowly_than_it_drives_on_the_flat() -> None:
    run = drive(open_world(UPHILL), 1.0, 0.0, 8.0)
    assert 0.25 < run["v"][-1] < 0.55
    assert run["x"][-1] > 2.0


def test_gravity_pulls_a_resting_car_downhill() -> None:
    assert drive(open_world(UPHILL), 0.0, 0.0, 3.0)["v"][-1] < -0.05
    assert abs(drive(open_world(), 0.0, 0.0, 3.0)["x"][-1]) < 1e-4


def test_a_tilted_floor_turns_about_the_origin_of_the_map() -> None:
    world = World(load_scenario("slope"))
    assert world.pose == pytest.approx((1.0, -0.5, math.pi / 2))
    position, rotation = world.marker
    level, _ = World(load_scenario("turns")).marker
    height = -0.5 * math.sin(0.125) + level[2] * math.cos(0.125)
    assert position == pytest.approx((1.0, -0.5 * math.cos(0.125) - level[2] * math.sin(0.125), height))
    assert rotation[:, 2] == pytest.approx((0.0, -math.sin(0.125), math.cos(0.125)))
    assert world.frame.to_floor(position) == pytest.approx((1.0, -0.5, level[2]))


def test_the_marker_is_level_above_the_reference_point_on_a_flat_floor() -> None:
    world = open_world(heading=30.0)
    position, rotation = world.marker
    assert position == pytest.approx((0.0, 0.0, 0.2))
    assert rotation[:, 0] == pytest.approx((math.cos(math.pi / 6), math.sin(math.pi / 6), 0.0))


@pytest.mark.parametrize("height", [0.025, 0.05])
def test_the_car_gets_over_a_bump_and_loses_speed(height: float) -> None:
    world = open_world(f"speed_bumps: [{{center: [1.5, 0], size: [0.3, 2], height: {height}}}]")
    world.apply((1.0, 0.0))
    highest, slowest, before = 0.0, math.inf, 0.0
    while world.pose[0] < 2.2:
        world.step(5)
        highest = max(highest, float(world.data.body("car").xpos[2]))
        if world.pose[0] < 1.1:
            before = world.speed
        elif world.pose[0] < 1.9:
            slowest = min(slowest, world.speed)
    assert world.collision is None
    assert highest == pytest.approx(height / 2, abs=0.012)
    assert slowest < before - 0.5 * height


def test_a_bump_has_the_height_and_length_that_it_should() -> None:
    world = World(load_scenario("bump"))
    for bump, height in enumerate((0.03, 0.04, 0.05)):
        geom = world.model.geom(f"bump {bump}")
        radius, top = geom.size[0], geom.pos[2] + geom.size[0]
        assert top == pytest.approx(height)
        assert 2 * math.sqrt(radius**2 - (radius - height) ** 2) == pytest.approx(0.3)


BOX = "movable_boxes: [{{center: [1, {y}], size: [0.4, 0.4, 0.2], mass: {mass}}}]"


def test_a_box_that_is_pushed_moves_and_brakes_the_car() -> None:
    world = open_world(BOX.format(y=0, mass=1))
    run = drive(world, 1.0, 0.0, 6.0)
    assert world.collision is None
    assert world.movable_poses[0, 0] > 1.5
    free = drive(open_world(), 1.0, 0.0, 6.0)
    assert run["v"][-1] < 0.8 * free["v"][-1]


def test_a_box_that_is_pushed_off_its_centre_turns() -> None:
    world = open_world(BOX.format(y=0.15, mass=1))
    drive(world, 1.0, 0.0, 6.0)
    assert abs(world.movable_poses[0, 2]) > 0.2


def test_a_box_stands_still_until_it_is_touched() -> None:
    world = World(load_scenario("movable"))
    before = world.movable_poses
    drive(world, 0.5, 0.0, 1.0)
    assert np.array_equal(world.movable_poses, before)
    assert before == pytest.approx(np.array([[1.75, 2, 0], [1.25, 2, 0], [1.75, 3.5, 0], [1.5, 1, 0]]))


def test_a_box_that_is_too_heavy_stops_the_car_without_a_collision() -> None:
    world = open_world(BOX.format(y=0, mass=100))
    run = drive(world, 1.0, 0.0, 6.0)
    assert world.collision is None
    assert abs(run["v"][-1]) < 0.01
    assert run["x"][-1] == pytest.approx(0.8 - 0.21415, abs=0.01)


@pytest.mark.parametrize(("truth", "friction"), [
    ("", 0.4),
    ("friction_patches: [{x: [-3, 3], y: [-3, 3], friction: 0.1}], ", 0.1),
    ("floor_friction: 0.2, ", 0.2),
])  # fmt: skip
def test_a_box_that_slides_is_stopped_by_its_own_friction_or_less_on_a_slippery_floor(
    truth: str, friction: float
) -> None:
    world = open_world(truth + BOX.format(y=0, mass=1))
    world.step(50)
    world.data.joint("movable 0").qvel[0] = 1.0
    world.step(600)
    assert world.movable_poses[0, 0] - 1.0 == pytest.approx(0.5 / (friction * GRAVITY), rel=0.05)


def test_a_box_where_the_car_starts_is_refused_and_one_that_touches_it_is_not() -> None:
    boxes = "movable_boxes: [{{center: [{x}, 0], size: [0.4, 0.4, 0.2], mass: 1}}]"
    with pytest.raises(InputError) as caught:
        open_world(boxes.format(x=0.1))
    (diagnostic,) = caught.value.diagnostics
    assert (diagnostic.path, diagnostic.code) == ("truth.movable_boxes[0]", Code.GEOMETRY)
    assert open_world(boxes.format(x=0.2 + 0.2145)).collision is None


def test_boxes_in_obstacles_or_each_other_are_refused_and_those_that_touch_are_not() -> None:
    def world(*boxes: tuple[float, float, float]) -> World:
        size = "size: [0.4, 0.4, 0.2], mass: 1"
        each = ", ".join(f"{{center: [{x}, {y}], {size}, yaw_deg: {yaw}}}" for x, y, yaw in boxes)
        wall = "{name: wall, polygon: {vertices: [[3, 2], [6, 2], [6, 5], [5, 3]]}}"
        return open_world(f"movable_boxes: [{each}]", obstacles=wall)

    assert world((3, 0, 0), (3.4, 0, 0), (5, 1.8, 0), (4, 3.3, 0)).collision is None
    with pytest.raises(InputError) as caught:
        world((3, 0, 0), (1.5, 5, 0), (3.3, 0.1, 30), (5, 1.85, 0), (5.8, 3.5, 10))
    found = [(d.path, d.problem, d.code) for d in caught.value.diagnostics]
    assert found == [
        ("truth.movable_boxes[2]", "overlaps movable_boxes[0]", Code.GEOMETRY),
        ("truth.movable_boxes[3]", "overlaps wall", Code.GEOMETRY),
        ("truth.movable_boxes[4]", "overlaps wall", Code.GEOMETRY),
    ]


CHANGED = "floor_friction: 0.2, vehicle: {drive_scale: 0.7, steering_offset_deg: 4, mass_scale: 1.5}"
LATER = "changes: [{{time: 0.5, floor_friction: 0.5}}, {{time: {time}, {changed}}}]"
RIDE = f"speed_bumps: [{{center: [9, 9], size: [1, 0.2], height: 0.02}}], {BOX.format(y=9, mass=1)}"


def test_the_motion_is_that_of_the_unchanged_car_until_the_change_and_another_one_from_its_step_on() -> None:
    for value in ("floor_friction: 0.02", *(f"vehicle: {{{each}}}" for each in (
        "drive_scale: 0.7", "steering_scale: 0.5", "steering_offset_deg: 4", "mass_scale: 1.5"
    ))):  # fmt: skip
        same, changed = open_world(), open_world(f"changes: [{{time: 1.0, {value}}}]")
        for world in (same, changed):
            world.apply((1.0, 0.1))
            world.step(500)
        assert np.array_equal(same.configuration, changed.configuration), value
        for world in (same, changed):
            world.step(50)
        assert np.abs(same.data.qvel - changed.data.qvel).max() > 1e-3, value


def test_a_linkage_that_slips_turns_a_car_that_is_commanded_straight() -> None:
    run = drive(open_world("changes: [{time: 3, vehicle: {steering_offset_deg: 4}}]"), 0.5, 0.0, 5.0)
    assert abs(run["theta"][run["t"] <= 3.0]).max() < 1e-3
    radius = 0.296 / math.tan(0.89 * math.radians(4))
    driven = np.interp([3.5, 5.0], run["t"], np.hypot(run["x"], run["y"]))
    assert np.diff(np.interp([3.5, 5.0], run["t"], run["theta"])) == pytest.approx(np.diff(driven) / radius, rel=0.06)


def test_ice_that_begins_slows_a_slide_less() -> None:
    world = open_world("changes: [{time: 0.2, floor_friction: 0.1}]")
    world.step(100)
    world.data.joint("car").qvel[1] = 0.6
    world.step(25)
    before = world.data.joint("car").qvel[1]
    world.step(100)
    slowed = float(before - world.data.joint("car").qvel[1]) / (100 * world.dt)
    assert slowed == pytest.approx(0.1 * GRAVITY, rel=0.05)


def test_after_a_change_the_model_is_that_of_a_world_which_was_so_from_the_begin() -> None:
    other, plain = open_world(f"{CHANGED}, {RIDE}"), open_world(RIDE)
    world = open_world(f"{LATER.format(time=1.0, changed=CHANGED)}, {RIDE}")
    for reference, steps in ((plain, 0), (other, 501)):
        world.reset()
        world.step(steps)
        for name in ("body_mass", "body_inertia", "body_invweight0", "dof_invweight0", "dof_M0", "geom_friction"):
            assert np.array_equal(getattr(world.model, name), getattr(reference.model, name)), name
        assert world.gap == reference.gap


def test_a_change_does_not_depend_on_how_the_steps_are_counted_and_repeats() -> None:
    at_once, singly = (open_world(LATER.format(time=0.7, changed=CHANGED)) for _ in range(2))
    ends = []
    for world, parts in ((at_once, [600]), (singly, [1] * 600), (at_once, [349, 1, 1, 249])):
        world.reset()
        world.apply((1.0, 0.2))
        for part in parts:
            world.step(part)
        ends.append(world.configuration)
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])
