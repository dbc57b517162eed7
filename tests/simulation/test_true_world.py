"""What is true in a trial: a car by its dimensions, a robot of an MJCF file, or a vehicle's own equations."""

from __future__ import annotations

import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.diagnostics import located, raised
from support.paths import ROOT

from kraft.driving.car_model import model_of
from kraft.errors import Code, InputError
from kraft.planning.workspace import workspace_of
from kraft.scenario import Scenario, Start, load_scenario, parse_scenario
from kraft.simulation.car import F1TENTH, MUSHR, design_of
from kraft.simulation.model_world import ModelWorld
from kraft.simulation.true_world import TrueWorld, check_world, world_of
from kraft.simulation.world import World
from kraft.trial.planning_vehicle import check_robot
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.true_robot import CarDimensions, Drive, Servo, Wheels
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

JACKAL = ROOT / "configs" / "vehicles" / "jackal.xml"
HALL = """name: hall
bounds: {{x: [-20, 20], y: [-20, 20]}}
start: {{x: 1, y: 2, heading_deg: 30, speed: {speed}}}
goal: {{center: [15, 0], radius: 1}}
obstacles: [{obstacles}]
truth: {{{truth}}}
"""
BOX = "{name: crate, box: {center: [4, 2.5], size: [0.5, 3], yaw_deg: 20}}"
MJCF = f"mjcf: {JACKAL}, body: base"


@cache
def vehicle(name: str) -> Vehicle:
    return load_vehicle(name)


def hall(truth: str = "", obstacles: str = "", speed: float = 0.0) -> Scenario:
    return parse_scenario(HALL.format(truth=truth, obstacles=obstacles, speed=speed))


def drive(world: TrueWorld, control: tuple[float, ...], seconds: float) -> TrueWorld:
    world.apply(np.array(control))
    world.step(round(seconds / world.dt))
    return world


def kind(scenario: Scenario, name: str) -> str:
    world = world_of(scenario, vehicle(name), 0)
    return type(world).__name__ + " " + " ".join(world.controls)


def test_the_scenario_says_what_is_true_and_else_the_vehicle() -> None:
    car, sides, accelerations = "World throttle steering", "World left right", "acceleration angular_acceleration"
    assert [kind(hall(), name) for name in ("mushr", "jackal")] == [car, sides]
    assert kind(hall(), "unicycle2") == f"ModelWorld {accelerations}"
    assert kind(hall("model: jackal"), "jackal") == "ModelWorld left right"
    assert kind(hall("parameters: {tau: 1.0}"), "mushr-drive") == "ModelWorld throttle steering"
    assert kind(hall("car: {preset: f1tenth}"), "mushr-drive") == car


# a vehicle's own model


def test_without_noise_the_truth_is_the_model_with_the_true_parameters() -> None:
    world = drive(world_of(hall("parameters: {a_max: 0.4}"), vehicle("unicycle2"), 3), (0.8, 0.1), 2.0)
    assert isinstance(world, ModelWorld)
    model = model_of(vehicle("unicycle2").with_parameters({"a_max": 0.4}))
    state = np.array([1.0, 2.0, math.radians(30.0), 0.0, 0.0])
    for _ in range(1000):
        state = model.advance(state, np.array([0.8, 0.1]), world.dt)
    assert np.allclose([*world.pose, world.speed], state[:4], atol=1e-12)
    assert world.components == pytest.approx(dict(zip(vehicle("unicycle2").state, state, strict=True)))


def test_noise_has_its_size_depends_on_the_seed_and_does_not_move_a_vehicle_that_stands() -> None:
    scene = hall("process_noise: {y: 0.1}", speed=0.3)
    ends = [drive(world_of(scene, vehicle("unicycle2"), seed), (0.0, 0.0), 1.0).pose for seed in range(120)]
    still = drive(world_of(hall(speed=0.3), vehicle("unicycle2"), 0), (0.0, 0.0), 1.0).pose
    assert np.std([end[1] for end in ends]) == pytest.approx(0.1, rel=0.2)
    assert {end[0] for end in ends} == {still[0]}
    again = drive(world_of(scene, vehicle("unicycle2"), 7), (0.0, 0.0), 1.0)
    assert np.array_equal(again.pose, ends[7])
    again.reset()
    assert np.array_equal(drive(again, (0.0, 0.0), 1.0).pose, ends[7])
    runs = []
    for run in (1, 2, 1):
        again.reset(run=run)
        runs.append(drive(again, (0.0, 0.0), 1.0).pose.copy())
    assert np.array_equal(runs[0], runs[2])
    assert not np.array_equal(runs[0], runs[1])
    standing = drive(world_of(hall("process_noise: {y: 0.1}"), vehicle("unicycle2"), 0), (0.0, 0.0), 1.0)
    assert standing.pose[1] == 2.0


def test_a_model_collides_where_its_footprint_touches_an_obstacle_for_the_first_time() -> None:
    scene = hall(obstacles=BOX)
    world = world_of(scene, vehicle("unicycle2"), 0)
    exact = ExactClearance(workspace_of(scene, vehicle("unicycle2")), vehicle("unicycle2").footprint)
    world.apply(np.array([1.0, 0.0]))
    while world.collision is None and world.time < 20.0:
        assert not exact.collides(*world.pose)
        world.step(1)
    assert world.collision is not None
    assert exact.collides(*world.pose)
    assert world.collision.obstacle == "crate"
    assert world.collision.time == world.time
    at = world.pose
    world.step(100)
    assert np.array_equal(world.pose, at)


def test_a_turn_in_place_collides_too() -> None:
    scene = hall(obstacles="{box: {center: [1.0, 2.27], size: [2, 0.1], yaw_deg: 30}}")
    world = drive(world_of(scene, vehicle("unicycle2"), 0), (0.0, 1.0), 3.0)
    assert world.collision is not None
    assert world.collision.obstacle == "obstacles[0]"
    assert world.pose[:2].tolist() == [1.0, 2.0]


def test_a_model_can_be_drawn() -> None:
    world = drive(world_of(hall(), vehicle("unicycle2"), 0), (1.0, 0.0), 1.0)
    place = world.data.body("car").xpos
    assert place[:2] == pytest.approx(world.pose[:2])


def test_the_force_of_a_model_that_states_its_share_of_gravity_is_that_of_a_floor_with_a_slope() -> None:
    """The camera sees such a vehicle higher or lower than at the start, and the slope drives it as gravity does."""
    force, share = (-0.3, -0.2), 0.25
    scene = hall("model: mushr-force, parameters: {a_x: -0.3, a_y: -0.2, u_0: 0.0}")
    world = world_of(scene, vehicle("mushr-force"), 0)
    height = world.marker[0][2]
    drive(world, (1.0, 0.0), 4.0)
    x, y, _ = world.pose
    place = world.frame.to_world(np.array([x, y, 0.0]))
    assert place[2] == pytest.approx(-(force[0] * (x - 1.0) + force[1] * (y - 2.0)) / (share * 9.81))
    assert world.marker[0] - place == pytest.approx(height * world.frame.normal, abs=0.01)
    assert world.data.body("car").xpos == pytest.approx(place, abs=1e-6)
    pulls = share * np.array(world.frame.along_floor(np.array([0.0, 0.0, -9.81])))
    assert pulls == pytest.approx(force)
    level = world_of(hall("parameters: {a_max: 0.4}"), vehicle("unicycle2"), 0)
    assert level.frame.normal.tolist() == [0.0, 0.0, 1.0]


def test_a_force_that_no_floor_causes_is_refused() -> None:
    scene = hall("model: mushr-force, parameters: {a_x: 1.7}")
    (problem,) = raised(lambda: world_of(scene, vehicle("mushr-force"), 0))
    assert (problem.code, problem.path) == (Code.VALUE, "truth.parameters")


def test_obstacles_that_bound_the_room_are_the_scenarios_alone() -> None:
    """As in the physics: leaving the bounds is no contact."""
    world = drive(
        world_of(parse_scenario(HALL.format(truth="", obstacles="", speed=0.5)), vehicle("unicycle2"), 0), (1, 0), 60.0
    )
    assert world.collision is None
    assert world.pose[0] > 20.0


# a car by its dimensions


@pytest.mark.parametrize(
    "car", ["track: 0.4, servo: {angle_max_deg: 60, linkage: 1}", "servo: {angle_max_deg: 50, linkage: 2}"]
)
def test_a_car_that_would_turn_about_a_point_between_its_wheels_is_refused(car: str) -> None:
    scene = hall(f"car: {{{car}}}")
    for check in (
        lambda: world_of(scene, vehicle("mushr-drive"), 0),
        lambda: check_robot(scene, vehicle("mushr-drive")),
    ):
        (problem,) = raised(check)
        assert (problem.code, problem.path) == (Code.GEOMETRY, "truth.car")


def test_a_car_that_cannot_turn_is_refused_also_where_its_vehicle_states_it(tmp_path: Path) -> None:
    text = (ROOT / "configs" / "vehicles" / "f1tenth.yaml").read_text(encoding="utf-8")
    assert "{preset: f1tenth}" in text
    sharp = text.replace("{preset: f1tenth}", "{servo: {angle_max_deg: 60, linkage: 2}}")
    (tmp_path / "car.yaml").write_text(sharp, encoding="utf-8")
    (problem,) = raised(lambda: check_robot(hall(), load_vehicle(str(tmp_path / "car.yaml"))))
    assert (problem.code, problem.path) == (Code.GEOMETRY, "truth.car")
    assert problem.file == str(tmp_path / "car.yaml")


def test_a_box_where_a_bundled_car_starts_is_refused_before_the_drive() -> None:
    scene = hall("movable_boxes: [{center: [1, 2], size: [0.2, 0.2, 0.2], mass: 1}]")
    (problem,) = raised(lambda: check_robot(scene, vehicle("mushr-drive")))
    assert (problem.code, problem.path) == (Code.GEOMETRY, "truth.movable_boxes[0]")


@pytest.mark.parametrize("long", ["car: {length: 3}", "model: van.yaml"])
def test_a_true_robot_that_touches_an_obstacle_at_the_start_is_refused(long: str, tmp_path: Path) -> None:
    """The footprint that plans is free there; a trial would end before its first tick."""
    text = (ROOT / "configs" / "vehicles" / "mushr-drive.yaml").read_text()
    (tmp_path / "van.yaml").write_text(re.sub(r"footprint: .*", "footprint: {length: 3.0, width: 0.28}", text))
    (tmp_path / "scene.yaml").write_text((ROOT / "scenarios" / "turns.yaml").read_text() + f"\ntruth: {{{long}}}\n")
    scene = load_scenario(tmp_path / "scene.yaml")
    (problem,) = raised(lambda: world_of(scene, vehicle("mushr-drive"), 0))
    assert (problem.code, problem.path) == (Code.GEOMETRY, "start")
    assert problem.problem.startswith("the robot touches")


def test_the_lightest_car_and_box_that_may_be_stated_are_simulated() -> None:
    light = "mass: 0.001, width: 0.001, wheels: {mass: 0.0001, radius: 0.001, width: 0.001}"
    boxes = "movable_boxes: [{center: [5, 2], size: [0.001, 0.001, 0.001], mass: 0.001}]"
    scene = hall(f"car: {{{light}}}, vehicle: {{mass_scale: 0.001}}, {boxes}")
    assert raised(lambda: check_world(scene, vehicle("mushr-drive"))) == ()


def test_a_car_has_the_dimensions_that_are_given_and_those_of_its_preset() -> None:
    assert design_of(CarDimensions()) == MUSHR
    assert design_of(CarDimensions(preset="f1tenth")) == F1TENTH
    given = CarDimensions(
        preset="f1tenth", wheelbase=0.4, mass=5.0, wheels=Wheels(radius=0.06), servo=Servo(rate_deg=90)
    )
    design = design_of(given)
    assert (design.wheelbase, design.chassis_mass, design.wheel_radius) == (0.4, 5.0, 0.06)
    assert design.steering_rate == pytest.approx(math.pi / 2)
    assert design.stiffness / F1TENTH.stiffness == pytest.approx(5.0 / F1TENTH.chassis_mass / 1.2)
    assert (design.track, design.front) == (F1TENTH.track, F1TENTH.front)


def test_a_car_with_other_wheels_is_a_car_of_that_scale() -> None:
    """Heights as of the default car would tip a car of a tenth over in its first turn."""
    small = CarDimensions(
        length=0.11, width=0.0663, wheelbase=0.0741, track=0.0575, mass=0.0553,
        wheels=Wheels(radius=0.0122, width=0.01025, mass=0.0078), drive=Drive(top_speed=1.2, time_constant=0.4),
    )  # fmt: skip
    design = design_of(small)
    assert design.centre_of_mass / small.track == pytest.approx(MUSHR.centre_of_mass / MUSHR.track)
    assert design.effective_mass / (design.chassis_mass + 4 * design.wheel_mass) == pytest.approx(
        MUSHR.effective_mass / (MUSHR.chassis_mass + 4 * MUSHR.wheel_mass), rel=0.01
    )
    sag = design.chassis_mass / design.stiffness / design.travel
    assert sag == pytest.approx(MUSHR.chassis_mass / MUSHR.stiffness / MUSHR.travel)
    truth = "length: 0.11, width: 0.0663, wheelbase: 0.0741, track: 0.0575, mass: 0.0553"
    wheels, motor = "{radius: 0.0122, width: 0.01025, mass: 0.0078}", "{top_speed: 1.2, time_constant: 0.4}"
    scene = hall(f"car: {{{truth}, wheels: {wheels}, drive: {motor}}}")
    assert scene.truth.car == small
    world = drive(world_of(scene, vehicle("mushr-drive"), 0), (1.0, 0.3), 3.0)
    assert not world.frame.has_turned_over(world.marker[1])
    assert world.speed == pytest.approx(1.2, rel=0.1)


def test_wheels_that_overlap_are_refused_at_their_line() -> None:
    """A car of 16 cm with the wheels of the MuSHR, which nobody states, has axles within its wheels."""
    small = "length: 0.16, width: 0.075, wheelbase: 0.094, track: 0.062, mass: 0.13"
    scene = hall(f"car: {{{small}}}")
    with pytest.raises(InputError) as error:
        world_of(scene, vehicle("mushr-drive"), 0)
    (problem,) = error.value.diagnostics
    assert problem.code == Code.GEOMETRY
    assert "0.0488 m in radius" in problem.problem
    world_of(
        hall(f"car: {{{small}, wheels: {{radius: 0.0105, width: 0.012, mass: 0.006}}}}"), vehicle("mushr-drive"), 0
    )


def test_a_car_with_a_high_chassis_turns_over() -> None:
    scene = hall("car: {preset: f1tenth, track: 0.08, drive: {top_speed: 4.0, time_constant: 0.4}}")
    world = drive(world_of(scene, vehicle("mushr-drive"), 0), (1.0, 0.0), 1.5)
    assert not world.frame.has_turned_over(world.marker[1])
    drive(world, (1.0, 0.38), 1.5)
    assert world.frame.has_turned_over(world.marker[1])


def test_a_drive_reaches_its_speed_with_its_time_constant() -> None:
    dimensions = CarDimensions(preset="f1tenth", drive=Drive(top_speed=2.0, time_constant=0.8))
    scene = hall("car: {preset: f1tenth, drive: {top_speed: 2.0, time_constant: 0.8}}")
    assert scene.truth.car == dimensions
    world = drive(world_of(scene, vehicle("mushr-drive"), 0), (1.0, 0.0), 0.8)
    assert world.speed == pytest.approx(2.0 * (1.0 - math.exp(-1.0)), rel=0.05)
    assert drive(world, (1.0, 0.0), 5.0).speed == pytest.approx(2.0, rel=0.03)


def test_tyres_with_less_grip_slide_in_a_turn() -> None:
    radii = []
    for friction in (1.0, 0.2):
        truth = f"car: {{preset: f1tenth, tyres: {{friction: {friction}}}}}"
        world = drive(world_of(hall(truth), vehicle("mushr-drive"), 0), (0.8, 0.3), 3.0)
        radii.append(world.speed / world.components["omega"])
    assert radii[0] < 1.3
    assert radii[1] > 2.0 * radii[0]


@pytest.mark.parametrize("steering", [0.1, 0.2, 0.3, 0.4189])
def test_the_model_of_the_f1tenth_predicts_the_beginning_of_a_turn_at_top_speed(steering: float) -> None:
    model, steps = model_of(vehicle("f1tenth")), 5
    world = drive(world_of(hall("car: {preset: f1tenth}"), vehicle("f1tenth"), 0), (1.0, 0.0), 4.0)
    state = np.array([*world.pose, world.speed, 0.0])
    for _ in range(steps):
        drive(world, (1.0, steering), 0.05)
        state = model.advance(state, np.array([1.0, steering]), 0.05)
    away = math.dist(state[:2], world.pose[:2])
    turned = math.degrees(abs(math.remainder(state[2] - world.pose[2], math.tau)))
    assert away < 0.06  # of 0.75 m
    assert turned < 7.0  # of up to 33 degrees: without its limit of the yaw acceleration it turns 11 degrees too far


# a robot of an MJCF file


def test_an_mjcf_robot_stands_at_the_start_and_moves_from_there() -> None:
    world = world_of(hall(MJCF), vehicle("jackal"), 0)
    assert isinstance(world, World)
    assert world.pose == pytest.approx([1.0, 2.0, math.radians(30.0)], abs=1e-9)
    drive(world, (1.0, 1.0), 3.0)
    assert world.speed == pytest.approx(0.98, abs=0.03)
    x, y, theta = world.pose
    assert theta == pytest.approx(math.radians(30.0), abs=0.01)
    assert math.atan2(y - 2.0, x - 1.0) == pytest.approx(math.radians(30.0), abs=0.01)
    world.reset(Start(-3.0, 1.0, math.pi / 2))
    assert world.pose == pytest.approx([-3.0, 1.0, math.pi / 2], abs=1e-9)
    assert drive(world, (-0.5, 0.5), 3.0).components["omega"] == pytest.approx(1.0 / 0.376, rel=0.06)


def test_the_inputs_of_an_mjcf_robot_are_clamped_and_in_the_order_of_the_controls() -> None:
    reordered = "actuators: {right: right, left: left}"
    world = drive(world_of(hall(f"{MJCF}, {reordered}"), vehicle("jackal"), 0), (0.2, 0.4), 1.0)
    assert world.components["omega"] > 0.0
    assert drive(world_of(hall(MJCF), vehicle("jackal"), 0), (50.0, 50.0), 4.0).speed < 2.1


def test_an_mjcf_robot_on_a_slope_lies_on_it() -> None:
    world = world_of(hall(f"{MJCF}, tilt: {{angle: 0.1, uphill_deg: 0}}"), vehicle("jackal"), 0)
    assert world.pose == pytest.approx([1.0, 2.0, math.radians(30.0)], abs=1e-3)
    drive(world, (0.0, 0.0), 0.2)
    assert world.frame.to_floor(world.marker[0])[2] == pytest.approx(0.2, abs=0.01)


def test_only_geoms_that_count_collide() -> None:
    found = []
    for geoms in ("", ", geoms: [rear caster]"):
        world = world_of(hall(MJCF + geoms, obstacles=BOX), vehicle("jackal"), 0)
        world.apply(np.array([1.0, 1.0]))
        while world.collision is None and world.time < 20.0:
            world.step(10)
        found.append(world.time)
        assert world.collision is not None
        assert world.collision.obstacle == "crate"
    assert found[1] > found[0] + 0.3


def without(tmp_path: Path, text: str, instead: str) -> str:
    """Truth with the file of the jackal in which a text is replaced."""
    content = JACKAL.read_text(encoding="utf-8")
    assert text in content
    (tmp_path / "robot.xml").write_text(content.replace(text, instead))
    return f"mjcf: {tmp_path / 'robot.xml'}"


def problems(truth: str, name: str = "jackal", obstacles: str = "") -> list[str]:
    scene = hall(truth, obstacles)
    return located(raised(lambda: check_world(scene, vehicle(name))))


def test_an_mjcf_file_that_cannot_be_used_is_refused_at_its_line(tmp_path: Path) -> None:
    assert problems(without(tmp_path, "</worldbody>", "</world>")) == ["6:15 truth.mjcf code"]
    assert problems(without(tmp_path, "<freejoint/>", "")) == ["6:15 truth.mjcf missing"]
    assert problems(without(tmp_path, 'pos="0 0 0.098"', 'pos="0 0 0.05"')) == ["6:15 truth.mjcf geometry"]
    assert problems(without(tmp_path, 'name="left" joint', 'name="port" joint')) == ["6:15 truth.mjcf unknown"]
    assert problems(MJCF, obstacles="{box: {center: [1, 2], size: [1, 1]}}") == ["3:8 start geometry"]


def test_names_that_a_robot_does_not_have_are_refused_together() -> None:
    found = problems(f"mjcf: {JACKAL}, body: base, actuators: {{left: lft, rigt: right}}, geoms: [hul, hull]")
    assert [entry.split(" ", 1)[1] for entry in found] == [
        "truth.actuators missing", "truth.actuators.left unknown", "truth.actuators.rigt unknown",
        "truth.geoms[0] unknown",
    ]  # fmt: skip
    assert [entry.split(" ", 1)[1] for entry in problems(f"mjcf: {JACKAL}, body: bse")] == ["truth.body unknown"]


def test_a_robot_that_takes_other_controls_is_refused_at_the_line_of_the_truth() -> None:
    assert problems("car: {preset: mushr}", "unicycle2") == ["6:8 truth mismatch"]
    assert problems("model: jackal", "unicycle2") == ["6:8 truth mismatch"]


def test_a_model_without_a_heading_or_a_speed_is_refused_at_the_line_of_the_truth() -> None:
    """The pose and the speed of the true robot are those of the model."""
    found = problems("model: kraft.vehicles.dynobench:UNICYCLE1_V0, parameters: {v_max: 1}", "unicycle2")
    assert [entry.split(" ", 1)[1] for entry in found] == ["truth.model mismatch", "truth.parameters.v_max unknown"]


def test_what_a_model_does_not_feel_or_have_is_refused() -> None:
    found = problems(
        "parameters: {v_mx: 1}, process_noise: {w: 1}, tilt: {angle: 0.1}, vehicle: {mass_scale: 2}", "unicycle2"
    )
    assert [entry.split(" ", 1)[1] for entry in found] == [
        "truth.parameters.v_mx unknown", "truth.process_noise.w unknown", "truth.tilt conflict",
        "truth.vehicle conflict",
    ]  # fmt: skip
    assert problems("vehicle: {mass_scale: 2}") == ["6:18 truth.vehicle conflict"]


def test_a_bundled_scene_with_features_of_the_floor_drives_an_mjcf_robot_but_no_model() -> None:
    assert raised(lambda: check_world(load_scenario("slope"), vehicle("jackal"))) == ()
    (problem,) = raised(lambda: check_world(load_scenario("slope"), vehicle("unicycle2")))
    assert problem.path == "truth.tilt"
