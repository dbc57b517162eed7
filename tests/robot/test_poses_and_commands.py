"""Units and signs of commands, limits of the model, and poses that are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kraft.driving import control
from kraft.driving.car_model import CarModel
from kraft.driving.control import Controller
from kraft.driving.control_settings import ControllerSettings
from kraft.driving.messages import Commitment, Estimate
from kraft.driving.method import load_method
from kraft.driving.references import manoeuvre_reference
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, Defect, InputError
from kraft.robot import tracker as tracker_module
from kraft.robot.command import CommandCodec, limited, unit_problem, unit_warnings
from kraft.robot.drive import check_method, on_the_clock
from kraft.robot.drive_tables import DriveTables
from kraft.robot.inputs import Inputs
from kraft.robot.loopback import LoopbackBus
from kraft.robot.maps import occupancy_map
from kraft.robot.messages import BOOL, GRID, make, pose_fields
from kraft.robot.planner import changed
from kraft.robot.poses import Clocks, PoseGuard, Received, units_hint
from kraft.robot.protocol import BeginOrder, DriveSpec
from kraft.robot.robot_file import Robot
from kraft.robot.timebase import TopicClock
from kraft.robot.tracker import Tracker
from kraft.robot.world import clock_message
from kraft.scenario import OccupancyMap, load_scenario
from kraft.vehicles.identification_record import CommandScale
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Vehicle

LATENCY = 0.01
HERE = (1.0, 2.0, 0.5)


def robot(**changed: Any) -> Robot:
    content: dict[str, Any] = {
        "name": "r", "transport": {"kind": "loopback"},
        "pose": {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped"}, "command": {"topic": "/drive"},
    }  # fmt: skip
    return Robot.model_validate({**content, **changed}, strict=False)


def command(**changed: Any) -> dict[str, Any]:
    return {"topic": "/drive", **changed}


@pytest.mark.parametrize("name", ["mushr", "mushr-drive", "f1tenth", "mushr-lag"])
@pytest.mark.parametrize("unit", ["throttle", "m/s"])
@pytest.mark.parametrize("sign", [1.0, -2.0])
def test_a_command_comes_back_from_its_message(name: str, unit: str, sign: float) -> None:
    vehicle = load_vehicle(name)
    settings = command(speed={"unit": unit, "scale": sign}, steering={"scale": sign, "offset_deg": 3.0})
    codec = CommandCodec(robot(command=settings), vehicle)
    model = CarModel(vehicle)
    for throttle in (0.3, 0.6, 1.0):
        control = model.command(throttle, -0.2)
        back = codec.control(codec.message(7, control))
        assert back is not None
        np.testing.assert_allclose(back, control, atol=1e-3)


def test_a_speed_in_metres_per_second_is_the_one_that_the_model_reaches() -> None:
    vehicle = load_vehicle("f1tenth")
    codec = CommandCodec(robot(command=command(speed={"unit": "m/s"})), vehicle)
    message = codec.message(7, np.array([0.5, 0.1]))
    assert message.drive.speed == pytest.approx(0.5 * vehicle.parameters["v_delta"], rel=1e-3)
    assert message.drive.steering_angle == pytest.approx(0.1)


@pytest.mark.parametrize("unit", ["throttle", "m/s"])
@pytest.mark.parametrize("drive", [{"speed": math.nan}, {"speed": math.inf}, {"steering_angle": math.nan}])
def test_commands_that_are_no_numbers_are_none(unit: str, drive: dict[str, float]) -> None:
    codec = CommandCodec(robot(command=command(speed={"unit": unit})), load_vehicle("mushr"))
    assert codec.control(make("ackermann_msgs/msg/AckermannDriveStamped", drive=drive)) is None


def test_a_command_that_is_no_number_is_not_sent() -> None:
    """In metres per second it would be the top speed, in which the table of the speeds ends."""
    described = robot(command=command(speed={"unit": "m/s"}))
    spec = DriveSpec(
        load_scenario("boxes").task(), load_method("adaptive-kraft"), load_vehicle("mushr"), described, 60.0
    )
    at = spec.at_rest((1.0, 2.0, 0.5))
    stop = manoeuvre_reference(spec.vehicle, 0, np.array([0.0]), at[np.newaxis])
    bus, sent = LoopbackBus(), list[float]()
    node = bus.node("kraft")
    bus.node("robot").subscribe("/drive", described.command.type, lambda message, _: sent.append(message.drive.speed))
    tracker = Tracker(spec, BeginOrder(at, Commitment(stop)), node, Inputs(described, node))
    with pytest.raises(Defect, match=r"the command at t = 1\.000 s is not finite: nan, 0\.1"):
        tracker.publish(1.0, np.array([math.nan, 0.1]))
    tracker.publish(1.0, np.array([0.0, 0.1]))
    assert sent == [0.0]


@pytest.mark.parametrize(("rate", "expected"), [(None, 30.0), (12.0, 12.0)])
def test_the_controller_computes_with_the_rate_of_the_robots_commands(
    rate: float | None, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The geometric one integrates over at most two periods, and more of its own pass between commands of 12 Hz."""
    described, used = robot(**({} if rate is None else {"rate_hz": rate})), list[float]()

    def make_controller(settings: ControllerSettings, model: VehicleModel) -> Controller:
        used.append(settings.rate_hz)
        return control.make_controller(settings, model)

    monkeypatch.setattr(tracker_module, "make_controller", make_controller)
    vehicle = load_vehicle("mushr")
    spec = DriveSpec(load_scenario("boxes").task(), load_method("oneshot-geometric"), vehicle, described, 60.0)
    at = spec.at_rest((1.0, 2.0, 0.5))
    stop = manoeuvre_reference(vehicle, 0, np.array([0.0]), at[np.newaxis])
    node = LoopbackBus().node("kraft")
    Tracker(spec, BeginOrder(at, Commitment(stop)), node, Inputs(described, node))
    assert used == [expected]
    assert spec.period == pytest.approx(1.0 / expected)
    assert spec.method.controller.rate_hz == 30.0


def test_the_controls_of_any_vehicle_fit_into_joints() -> None:
    vehicle = load_vehicle("jackal")
    codec = CommandCodec(robot(command=command(type="sensor_msgs/msg/JointState")), vehicle)
    np.testing.assert_array_equal(codec.control(codec.message(7, np.array([0.3, -0.4]))), [0.3, -0.4])


def test_a_model_with_other_controls_than_the_robot_takes_is_refused() -> None:
    with pytest.raises(InputError) as error:
        limited(load_vehicle("jackal"), robot())
    (problem,) = error.value.diagnostics
    assert (problem.path, problem.code) == ("command.type", Code.MISMATCH)


def test_limits_of_a_vehicle_that_is_no_car_are_refused() -> None:
    described = robot(command=command(type="sensor_msgs/msg/JointState"), limits={"speed": 0.3})
    with pytest.raises(InputError) as error:
        limited(load_vehicle("jackal"), described)
    (problem,) = error.value.diagnostics
    assert (problem.path, problem.code) == ("limits", Code.CONFLICT)


def test_limits_bound_what_is_planned() -> None:
    slow = limited(load_vehicle("f1tenth"), robot(limits={"speed": 0.3, "steering_deg": 10.0}))
    model = CarModel(slow)
    assert slow.top_speed == 0.3
    assert model.steady_speed(float(model.high[model.throttle])) == pytest.approx(0.3, rel=0.01)
    assert slow.controls["steering"] == pytest.approx((-math.radians(10), math.radians(10)))
    assert slow.controls["throttle"][0] == load_vehicle("f1tenth").controls["throttle"][0], "it brakes as before"


def in_degrees() -> Vehicle:
    """The car with terms, identified from logs whose steering was in degrees."""
    car = load_vehicle("car-lag")
    controls = {"throttle": (-1.0, 1.0), "steering": (-20.0, 20.0)}
    return replace(car, controls=controls, parameters={**car.parameters, "full_steering": 20.0})


def test_steering_that_is_no_angle_in_radians_is_not_sent_as_one() -> None:
    problem = unit_problem(in_degrees(), robot())
    assert problem is not None
    assert "command.steering.scale" in problem
    in_radians = robot(command=command(steering={"scale": math.radians(1.0)}))
    assert unit_problem(in_degrees(), in_radians) is None
    assert not list(unit_warnings(in_degrees(), in_radians, {}))
    assert unit_problem(in_degrees(), robot(command=command(type="sensor_msgs/msg/JointState"))) is None


@pytest.mark.parametrize("name", ["mushr-force", "f1tenth"])
def test_a_factor_that_makes_degrees_of_radians_is_doubtful_and_not_refused(name: str) -> None:
    in_degrees = robot(command=command(steering={"scale": -math.degrees(1.0)}))
    assert unit_problem(load_vehicle(name), in_degrees) is None
    (warning,) = unit_warnings(load_vehicle(name), in_degrees, {})
    assert "sent in degrees" in warning


def test_a_factor_that_makes_no_angle_is_refused_as_the_factor() -> None:
    problem = unit_problem(load_vehicle("mushr-force"), robot(command=command(steering={"scale": 1000.0})))
    assert problem is not None
    assert "command.steering.scale is 1000" in problem
    assert "another unit" not in problem


def test_an_offset_is_not_added_to_degrees_as_radians() -> None:
    steering = {"scale": math.degrees(1.0), "offset_deg": 2.0}
    problem = unit_problem(load_vehicle("mushr-force"), robot(command=command(steering=steering)))
    assert problem is not None
    assert "offset_deg" in problem


@pytest.mark.parametrize("name", ["mushr", "mushr-lag", "mushr-force", "f1tenth"])
def test_the_units_of_the_bundled_cars_are_not_in_doubt(name: str) -> None:
    assert unit_problem(load_vehicle(name), robot()) is None
    assert not list(unit_warnings(load_vehicle(name), robot(), {}))


def test_a_steering_far_from_the_angle_of_the_wheels_is_doubtful() -> None:
    (warning,) = unit_warnings(load_vehicle("car"), robot(), {})  # a share of the full steering
    assert "1 rad is sent" in warning


def test_commands_that_were_converted_are_doubtful_unless_the_robot_file_has_the_inverse() -> None:
    car = load_vehicle("f1tenth")
    flipped = {"steering": CommandScale(neutral=0.0, scale=-1.0)}
    pulses = {"throttle": CommandScale(neutral=1500.0, scale=0.002)}
    assert len(list(unit_warnings(car, robot(), {**flipped, **pulses}))) == 2
    assert not list(unit_warnings(car, robot(command=command(steering={"scale": -1.0})), flipped))
    assert not list(unit_warnings(car, robot(command=command(speed={"unit": "m/s"})), pulses))


def test_a_limit_of_the_steering_is_one_of_the_wheels_whatever_the_unit_of_the_commands() -> None:
    slow = limited(in_degrees(), robot(limits={"steering_deg": 10.0}))
    low, high = slow.controls["steering"]
    assert 8.0 < high < 12.0
    wheels = [math.atan(slow.parameters["L"] * CarModel(slow).curvature(edge)) for edge in (low, high)]
    assert np.degrees(wheels) == pytest.approx([-10.0, 10.0], rel=0.02)


def test_methods_without_a_contingency_on_board_may_not_drive_a_robot() -> None:
    for name, key in (
        ("kraft", "planner.on_board"), ("conservative-kraft", "planner.on_board"),
        ("oneshot-openloop", "planner.on_board"), ("oracle", "estimator.kind"),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            check_method(load_method(name))
        assert key in {problem.path for problem in error.value.diagnostics}
    method = load_method("adaptive-kraft")
    check_method(method)
    assert on_the_clock(method).planner.lead == 0.3


@pytest.mark.parametrize(
    ("timing", "key"),
    [({"clock_cycle": None}, "planner.cycle"), ({"clock_cycle": 0.5}, "planner.clock_cycle")],
    ids=["short cycles alone", "a cycle on the clock that is short too"],
)
def test_a_cycle_on_the_clock_has_its_own_duration_and_leaves_time_to_decide(timing: dict[str, Any], key: str) -> None:
    method = load_method("adaptive-kraft")
    planner = method.planner
    assert (planner.cycle, on_the_clock(method).planner.cycle) == (0.25, planner.clock_cycle)
    changed = method.model_copy(update={"planner": planner.model_copy(update=timing)})
    with pytest.raises(InputError) as error:
        check_method(changed)
    (problem,) = error.value.diagnostics
    assert problem.path == key
    assert problem.expected.startswith("expected at least 0.6 s on the wall clock")


def test_the_least_cycle_on_the_clock_is_the_one_that_the_problem_states() -> None:
    method = load_method("adaptive-kraft")
    for cycle, lead, refused in ((0.6, 0.1, False), (0.7, 0.5, True), (0.8, 0.5, False)):
        timing = {"cycle": cycle, "clock_cycle": cycle, "lead": lead}
        changed = method.model_copy(update={"planner": method.planner.model_copy(update=timing)})
        if refused:
            with pytest.raises(InputError, match=r"at least 0\.8 s"):
                check_method(changed)
        else:
            check_method(changed)


def received(
    time: float, pose: tuple[float, float, float] = HERE, frame: str = "map", arrival: float | None = None
) -> Received:
    at = time + LATENCY if arrival is None else arrival
    return Received(10**18 + round(1e9 * time), 5 * 10**9 + round(1e9 * at), frame, pose)


def guard(**changed: Any) -> PoseGuard:
    return PoseGuard(robot(**changed), Clocks(10**18, 5 * 10**9, LATENCY))


def test_a_good_pose_becomes_an_observation_at_its_stamp() -> None:
    found = guard().observation(received(3.0), HERE, HERE, 0.5, 0.03)
    assert found is not None
    assert (found.time, found.arrival) == pytest.approx((3.0, 3.01))
    assert (found.x, found.y, found.theta) == HERE


def test_a_pose_counts_from_its_arrival_where_the_clocks_cannot_be_set() -> None:
    pose = {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped", "stamp": "arrival"}
    found = guard(pose=pose).observation(received(99.0, arrival=3.0), HERE, HERE, 0.5, 0.03)
    assert found is not None
    assert found.time == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        (received(3.0, (math.nan, 2.0, 0.5)), "the poses are no numbers"),
        (received(3.0, (1.0, 2.0, math.inf)), "the poses are no numbers"),
        (received(3.0, frame="odom"), "the poses are in another frame"),
        (received(3.0, (3.0, 2.0, 0.5)), "the poses jumped"),
        (received(3.0, (1.0, 2.0, 2.5)), "the poses turned"),
        (received(8.0, arrival=3.0), "the clock of the poses jumped"),
        (received(-2.0, arrival=3.0), "the clock of the poses jumped"),
    ],
)
def test_a_pose_that_cannot_be_true_is_refused(pose: Received, why: str) -> None:
    refusing = guard()
    assert refusing.observation(pose, HERE, HERE, 0.5, 0.03) is None
    assert refusing.reason.startswith(why)
    assert refusing.refused == {why: 1}
    assert refusing.observation(received(3.1, (1.01, 2.01, 0.5)), HERE, HERE, 0.5, 0.1) is not None
    assert refusing.reason == ""


def test_a_pose_where_the_commands_lead_is_believed_when_what_was_learned_leads_elsewhere() -> None:
    drifted = (-0.5, 2.0, 0.5)
    assert guard().observation(received(9.0), drifted, HERE, 0.0, 5.0)
    refusing = guard()
    assert refusing.observation(received(9.0, (3.0, 2.0, 0.5)), drifted, HERE, 0.0, 5.0) is None
    assert refusing.reason == "the poses jumped: 3.50 m from the predicted position"
    assert refusing.observation(received(9.1, (1.0, 2.0, 2.5)), drifted, HERE, 0.0, 5.0) is None


@pytest.mark.parametrize("expected", [(math.nan, 2.0, 0.5), (1.0, 2.0, math.nan)])
def test_a_pose_is_not_believed_because_what_is_expected_is_no_number(expected: tuple[float, float, float]) -> None:
    assert guard().observation(received(3.0, (50.0, 2.0, 0.5)), expected, expected, 0.5, 0.03) is None
    assert guard().observation(received(3.0, (1.0, 2.0, 3.0)), expected, expected, 0.5, 0.03) is None
    assert guard().observation(received(3.0), expected, HERE, 0.5, 0.03)


def test_a_heading_across_the_seam_is_no_turn() -> None:
    expected = (1.0, 2.0, -math.pi + 0.1)
    assert guard().observation(received(3.0, (1.0, 2.0, math.pi - 0.1)), expected, expected, 0.5, 0.03)


def test_frozen_poses_are_refused_until_they_change_even_when_the_car_stands() -> None:
    refusing = guard()
    assert refusing.observation(received(3.0), HERE, HERE, 0.5, 0.03)
    assert refusing.observation(received(3.1), HERE, HERE, 0.5, 0.1) is None
    assert refusing.observation(received(3.2), HERE, HERE, 0.0, 0.2) is None
    assert refusing.observation(received(3.3, (1.001, 2.0, 0.5)), HERE, HERE, 0.0, 0.3)


def test_equal_poses_of_a_car_that_stands_are_believed() -> None:
    believing = guard()
    assert all(believing.observation(received(0.1 * k), HERE, HERE, 0.0, 0.1) for k in range(10))


def test_millimetres_are_recognised() -> None:
    assert "millimetres" in units_hint((1003.0, 1990.0, 0.0), HERE, 0.5)
    assert units_hint((5.0, 5.0, 0.0), HERE, 0.5) == ""
    assert units_hint((1.9, -0.4, 0.0), (0.0, 0.0, 0.0), 0.5) == "", "near the origin a position is so in all units"
    assert "millimetres" in units_hint((120.0, -40.0, 0.0), (0.0, 0.0, 0.0), 0.5)


def test_a_map_with_a_turned_origin_and_unknown_cells_is_an_obstacle() -> None:
    info = {"resolution": 0.5, "width": 2, "height": 1, "origin": pose_fields(1.0, 2.0, 0.3)}
    found = occupancy_map(make(GRID, info=info, data=[0, -1]))
    np.testing.assert_array_equal(found.occupied, [[False, True]])
    assert found.origin == pytest.approx((1.0, 2.0, 0.3))
    with pytest.raises(ValueError, match="its data are 2 cells"):
        occupancy_map(make(GRID, info={**info, "width": 3}, data=[0, -1]))


@pytest.mark.parametrize("speed", [0.2, 1.0, 3.0])
def test_the_time_of_a_simulation_is_known_between_late_messages(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, generator = LoopbackBus(), np.random.default_rng(1)
    followed, simulation = TopicClock(bus.node("kraft"), "/clock"), bus.node("world")
    monotonic = [10**12]
    monkeypatch.setattr("kraft.robot.loopback.time.monotonic_ns", lambda: monotonic[0])
    monkeypatch.setattr("kraft.robot.timebase.time.monotonic_ns", lambda: monotonic[0])
    assert not followed.is_running
    errors, times = [], []
    for k in range(400):
        sent = 10**12 + k * 20_000_000
        monotonic[0] = sent + round(abs(generator.normal(0.0, 3e6)))
        simulation.publish("/clock", clock_message(5 * 10**17 + round(speed * (sent - 10**12))))
        if k > 100:
            errors.append(followed.now() - 5 * 10**17 - speed * (monotonic[0] - 10**12))
            times.append(followed.now())
    assert followed.is_running
    assert np.abs(errors).max() < 2e6 * speed
    assert times == sorted(times)
    assert followed.wall(0.01) == pytest.approx(0.01 / speed, rel=1e-3)


def test_after_a_stop_the_car_is_kept_where_it_stands() -> None:
    """A stop that ends elsewhere than planned is not corrected at a creep."""
    described = robot()
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr")
    spec = DriveSpec(task, load_method("adaptive-kraft"), vehicle, described, 60.0)
    at = np.array(spec.at_rest((task.start.x, task.start.y, task.start.heading)))
    ahead = at.copy()
    ahead[vehicle.index("y")] += 0.2
    stop = manoeuvre_reference(vehicle, 0, np.array([0.9, 1.0]), np.array([ahead, ahead]))
    node = LoopbackBus().node("kraft")
    tracker = Tracker(spec, BeginOrder(at, Commitment(stop)), node, Inputs(described, node))
    tracker.on_board.stop(Estimate(1.0, at, 0.0))
    tracker.on_board.commitment = Commitment(stop := replace(stop))
    rolling = at.copy()
    rolling[tracker.model.v] = 0.3
    corrected, _ = tracker.command(1.2, Estimate(1.2, rolling, 0.0))
    kept, reference = tracker.command(1.3, Estimate(1.3, at, 0.0))
    assert reference is stop
    assert np.array_equal(kept, tracker.model.rest)
    assert not np.array_equal(corrected, tracker.model.rest)


def test_a_simulation_whose_time_is_less_than_the_machines_runs_and_its_dead_man_is_heard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before the time is known, the clock is asked for already: a dead man is held before the first poses come."""
    described = robot(clock={"topic": "/clock"}, dead_man={"topic": "/dead", "type": "std_msgs/msg/Bool"})
    bus = LoopbackBus()
    inputs, simulation = Inputs(described, bus.node("kraft")), bus.node("world")
    monotonic = [10**14]
    for place in ("loopback", "timebase", "inputs"):
        monkeypatch.setattr(f"kraft.robot.{place}.time.monotonic_ns", lambda: monotonic[0])

    def simulate(begin: float, seconds: float, is_held: bool = True) -> None:
        for k in range(round(seconds / 0.02)):
            monotonic[0] += 20_000_000
            simulation.publish("/clock", clock_message(round(1e9 * (begin + 0.02 * k))))
            if is_held:
                simulation.publish("/dead", make(BOOL, data=True))
                assert inputs.trouble == ""
            inputs.clock.now()

    simulate(5.0, 3.0)
    assert 1e-9 * inputs.clock.now() == pytest.approx(8.0, abs=0.05)
    simulate(1.0, 3.0)  # another simulation
    assert 1e-9 * inputs.clock.now() == pytest.approx(4.0, abs=0.05)
    simulate(4.0, 0.6, is_held=False)
    assert "is silent" in inputs.trouble


def test_of_a_large_map_only_what_is_near_the_bounds_is_planned_with() -> None:
    task = load_scenario("turns").task()
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    generator = np.random.default_rng(0)
    whole = OccupancyMap(generator.random((900, 1100)) < 0.05, 0.05, (x0 - 20.0, y0 - 15.0, 0.3), name="map")
    *_, used = changed(task, None, whole).obstacles
    assert isinstance(used, OccupancyMap)
    assert used.occupied.size < 0.1 * whole.occupied.size

    def occupied(grid: OccupancyMap, x: float, y: float) -> bool:
        c, s = math.cos(grid.origin[2]), math.sin(grid.origin[2])
        dx, dy = x - grid.origin[0], y - grid.origin[1]
        return bool(grid.occupied[int((c * dy - s * dx) / grid.resolution), int((c * dx + s * dy) / grid.resolution)])

    for x, y in generator.uniform((x0, y0), (x1, y1), (300, 2)).tolist():
        assert occupied(used, x, y) == occupied(whole, x, y)
    elsewhere = OccupancyMap(np.ones((4, 5), bool), 0.1, (x1 + 50.0, y0, 0.0), name="map")
    *_, used = changed(task, None, elsewhere).obstacles
    assert isinstance(used, OccupancyMap)
    assert used.occupied.shape == (4, 1)


def test_a_drive_goes_on_when_its_tables_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "steps.csv").symlink_to("/dev/full")
    with DriveTables(tmp_path, {"steps": ["a"], "events": ["time", "event"]}) as tables:
        for k in range(3):
            tables.row("steps", k)
        tables.row("events", 1.0, "later")
    assert tables.problem.startswith(f"{tmp_path / 'steps.csv'}: cannot be written: ")
    assert not (tmp_path / "events.csv").exists()
