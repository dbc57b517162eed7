"""Identification from the inside: every derivative against differences, the elimination against a dense solution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic_logs import synthetic_logs
from benchmarks.sysid import NOISE, TRUTH
from kraft.errors import Defect
from kraft.logs.log import Log, Part
from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.chains import segment_between, whole_segment
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.factor_graph import FastGraph, PaperGraph
from kraft.sysid.initial_values import InitialSearch, smooth_chains
from kraft.sysid.interface import Settings
from kraft.sysid.optimiser import RhoFactors, bounded_step, estimate_uncertainty, held_at_bounds
from kraft.sysid.parameters import parameters_of, vehicle_of
from kraft.sysid.problem import Point, Problem, assemble, noise_model, starting_point, threshold
from kraft.sysid.smoothing import begins_at_rest, measured_noise, smoothed
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR_DRIVE
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.specialise import kernels
from ompl_ext.vehicle import Footprint, Vehicle, derivative

AUXILIARY = ("delay", "delay_steering", "lag_throttle", "lag_steering", "friction", "dead_band_throttle",
          "dead_band_steering", "play_steering", "lever", "side", "yaw_offset")  # fmt: skip
VALUES = {**TRUTH, "delay": 0.07, "delay_steering": 0.03, "lag_throttle": 0.04, "lag_steering": 0.12, "friction": 0.08,
          "dead_band_throttle": 0.1, "dead_band_steering": 0.02, "play_steering": 0.025, "lever": 0.1, "side": -0.05,
          "yaw_offset": 0.03}  # fmt: skip


def small_problem(robust: float | None = None, frozen: tuple[str, ...] = ()) -> tuple[Problem, Point]:
    """Two short logs with every extra, and a point near their explanation."""
    vehicle = load_vehicle_config("mushr-lag")
    logs = synthetic_logs(vehicle, VALUES, range(2), seconds=1.5, outliers=0.05)
    settings = Settings(values=VALUES, robust=robust, frozen=frozen)
    parameters = parameters_of(vehicle, settings, AUXILIARY)
    segments = [whole_segment(log.parts[0], i, settings.step) for i, log in enumerate(logs)]
    problem = assemble(segments, 2, parameters, noise_model(parameters.vehicle, settings, NOISE))
    point = starting_point(problem, smooth_chains(problem.chains), parameters.nominal)
    rng = np.random.default_rng(0)
    controls = point.controls + 0.01 * rng.normal(size=point.controls.shape)
    return problem, replace(point, controls=controls)


@derivative
def point_motion(x, u, p):  # type: ignore[no-untyped-def]
    """A point that two thrusters push along x and y."""
    return x[2], x[3], (p[0] * u[0] - x[2]) / p[1], (p[0] * u[1] - x[3]) / p[1]


POINT = Vehicle(
    name="point",
    derivative=point_motion,
    state=("x", "y", "vx", "vy"),
    controls={"ux": (-1.0, 1.0), "uy": (-1.0, 1.0)},
    parameters={"gain": 0.5, "lag": 0.5},
    footprint=Footprint(0.3, 0.3),
    top_speed=1.0,
    rest=("vx", "vy"),
)


def point_logs(count: int, seconds: float = 10.0, fine: float = 0.005) -> list[Log]:
    """Drives of `POINT` with a gain of 0.9 and a lag of 0.3, seen with a noise of 5 mm."""
    motion, logs = DiscreteModel(POINT), []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        times = np.arange(0.0, seconds, 0.7)
        commands = rng.uniform(-1.0, 1.0, (len(times), 2))
        acting = commands[np.searchsorted(times, fine * (np.arange(round(seconds / fine)) + 0.5), side="right") - 1]
        states = motion.simulate(
            np.zeros((1, 4)), np.ascontiguousarray(acting[:, None]), np.array([[0.9, 0.3]]), np.array([fine])
        )[:, 0]
        seen = np.arange(0.01, seconds - 0.1, 1 / 30)
        grid = fine * np.arange(len(states))
        x, y = (np.interp(seen, grid, states[:, k]) + 0.005 * rng.normal(size=len(seen)) for k in (0, 1))
        poses = np.column_stack([x, y, np.zeros(len(seen))])
        logs.append(Log(f"log-{seed}", (), ("ux", "uy"), (Part(times, commands, seen, poses),)))
    return logs


def changed_yaw(log: Log, yaw: float) -> Log:
    return replace(log, parts=tuple(replace(part, poses=part.poses + np.array([0.0, 0.0, yaw])) for part in log.parts))


def whitened(problem: Problem, point: Point) -> Floats:
    """All residuals in standard deviations."""
    variance = problem.noise.process * np.sqrt(problem.chains.h)[:, None]
    return np.concatenate(
        [
            (problem.dynamics_residuals(point) / variance).ravel(),
            (problem.control_residuals(point) / problem.noise.control).ravel(),
            (problem.pose_residuals(point) / problem.noise.pose_sigmas).ravel(),
            problem.prior_residuals(point.rho),
        ]
    )


def flat(point: Point) -> Floats:
    return np.concatenate([point.states.ravel(), point.controls.ravel(), point.rho])


def shaped(vector: Floats, like: Point) -> Point:
    states, controls, rho = np.split(vector, np.cumsum([like.states.size, like.controls.size]))
    return Point(states.reshape(like.states.shape), controls.reshape(like.controls.shape), rho)


def differences(function: Callable[[Floats], Floats], at: Floats, change: float = 1e-6) -> Matrix:
    columns = []
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = change
        columns.append((function(at + step) - function(at - step)) / (2 * change))
    return np.array(columns).T


def frames_of(problem: Problem) -> Floats:
    """Some frame for the errors of each pose."""
    return np.eye(3) + 0.4 * np.random.default_rng(3).normal(size=(len(problem.chains.poses), 3, 3))


@pytest.mark.parametrize("framed", [False, True])
def test_one_step_of_the_fast_graph_is_that_of_the_dense_problem(framed: bool) -> None:
    """Every derivative that the fast graph uses is checked by this, and all of the elimination."""
    problem, point = small_problem()
    problem = replace(problem, frames=frames_of(problem) if framed else None)
    jacobian = differences(lambda x: whitened(problem, shaped(x, point)), flat(point))
    dense = shaped(np.linalg.lstsq(jacobian, -whitened(problem, point), rcond=None)[0], point)
    graph = FastGraph(problem)
    graph.linearise(point)
    factors = graph.reduce(0.0)
    wide, free = np.full(len(point.rho), 1e9), problem.parameters.free
    change = bounded_step(factors, 0.0, -wide, wide, free)
    assert change == pytest.approx(dense.rho, rel=1e-3, abs=1e-6)
    moved = graph.moved(change)
    assert moved.states - point.states == pytest.approx(dense.states, rel=1e-3, abs=1e-5)
    mean = problem.actuators.mean
    bend = mean(moved.rho)[0] - mean(point.rho)[0] - mean(point.rho)[1] @ change
    assert moved.controls - point.controls - bend == pytest.approx(dense.controls, rel=1e-3, abs=1e-5)
    information = np.linalg.inv(np.linalg.inv(jacobian.T @ jacobian)[-len(change) :, -len(change) :])
    assert factors.total_information == pytest.approx(information, rel=1e-3, abs=1e-3 * np.abs(information).max())


@pytest.mark.parametrize("framed", [False, True])
def test_the_residuals_and_the_cost_of_the_fast_graph_are_those_of_the_problem(framed: bool) -> None:
    problem, point = small_problem(robust=1.345)
    problem = replace(problem, frames=frames_of(problem) if framed else None)
    graph = FastGraph(problem)
    assert graph.linearise(point) == pytest.approx(problem.cost(point), rel=1e-12)
    assert np.array_equal(graph.pose_residuals, problem.pose_residuals(point))


def test_the_paper_graph_weighs_poses_in_the_same_frames() -> None:
    problem, point = small_problem()
    problem = replace(problem, frames=frames_of(problem))
    fast, paper = FastGraph(problem), PaperGraph(problem)
    for graph in (fast, paper):
        graph.linearise(point)
    assert paper.reduce(0.0).total_information == pytest.approx(fast.reduce(0.0).total_information, rel=1e-6, abs=1e-3)


def test_reweighted_gradients_are_those_of_the_robust_cost() -> None:
    problem, point = small_problem(robust=1.345)
    assert problem.noise.weights(problem.noise.distance(problem.pose_residuals(point))).min() < 0.5
    graph = FastGraph(problem)
    for _ in range(40):  # states and controls at their best for this rho
        graph.linearise(point)
        factors = graph.reduce(0.0)
        point = graph.moved(np.zeros(len(point.rho)))

    def best(rho: Floats) -> Floats:
        there = replace(point, rho=rho)
        for _ in range(40):
            graph.linearise(there)
            graph.reduce(0.0)
            there = graph.moved(np.zeros(len(rho)))
        return np.array([problem.cost(there)])

    gradient = differences(best, point.rho, 1e-4)[0]
    assert factors.total_gradient == pytest.approx(gradient, rel=1e-2, abs=1e-2 * np.abs(gradient).max())


@pytest.mark.parametrize("name", ["mushr-lag", "examples/05_vehicle.py:VEHICLE", "unicycle2"])
def test_derivatives_of_steps_are_those_of_any_vehicle(name: str) -> None:
    vehicle = load_vehicle(name)
    motion, rng = DiscreteModel(vehicle), np.random.default_rng(1)
    count, sizes = 40, (motion.nx, motion.nu, motion.np)
    x = rng.uniform(0.1, 0.4, (count, motion.nx))
    u = rng.uniform(0.2, 0.8, (count, motion.nu)) * vehicle.control_bounds[:, 1]
    p, h = vehicle.parameter_array, np.full(count, 0.05)
    after, jacobian = motion.linearise(x, u, p, h)
    assert after == pytest.approx(motion.step(x, u, p, h), abs=1e-14)

    def step(values: Floats) -> Floats:
        a, b, c = np.split(values, np.cumsum(sizes)[:-1])
        return motion.step(a[None].copy(), b[None].copy(), c.copy(), h[:1])[0]

    for i in range(0, count, 7):
        expected = differences(step, np.concatenate([x[i], u[i], p]))
        assert jacobian[i] == pytest.approx(expected, abs=1e-6)


def test_steps_are_the_planners() -> None:
    vehicle = MUSHR_DRIVE
    motion, x, u = DiscreteModel(vehicle), np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.7, 0.1])
    planned = np.empty(4)
    kernels(vehicle).advance(x, u, vehicle.parameter_array, 0.05, planned)
    assert motion.step(x[None], u[None], vehicle.parameter_array, np.array([0.05]))[0] == pytest.approx(planned)


def test_a_simulation_is_one_step_after_the_other() -> None:
    vehicle = vehicle_of(load_vehicle_config("mushr-lag"))
    motion, rng, lanes = DiscreteModel(vehicle), np.random.default_rng(2), 70  # more than are integrated at once
    u, h = rng.uniform(0, 0.3, (5, lanes, 2)), rng.uniform(0.01, 0.05, lanes)
    p = vehicle.parameter_array * rng.uniform(0.8, 1.2, (lanes, 4))
    states = motion.simulate(rng.normal(size=(lanes, 4)), u, p, h)
    for k in range(5):
        for lane in (0, 33, 69):
            one = motion.step(
                states[k, lane : lane + 1].copy(), u[k, lane : lane + 1].copy(), p[lane], h[lane : lane + 1]
            )
            assert states[k + 1, lane] == pytest.approx(one[0], abs=1e-14)


@pytest.mark.parametrize("auxiliary", [(), AUXILIARY])
def test_commands_act_for_as_long_as_they_are_held(auxiliary: tuple[str, ...]) -> None:
    """The mean over all steps is that of the shifted signal, whatever the steps are."""
    problem, _ = small_problem()
    vehicle = load_vehicle_config("mushr-lag")
    parameters = parameters_of(
        vehicle, Settings(values={n: v for n, v in VALUES.items() if n in (*TRUTH, *auxiliary)}), auxiliary
    )
    segment = problem.chains.segments[0]
    commands = ActuatorModel([segment], parameters)
    rho = parameters.nominal.copy()
    for name in auxiliary:
        if name.startswith(("dead_band", "play")):
            rho[parameters.index(name)] = 0.0 if name.startswith("dead_band") else 1e-4  # no play below 0
    means, slopes = commands.mean(rho)
    delays = (0.07, 0.10) if auxiliary else (0.0, 0.0)
    part = segment.part
    fine = np.linspace(segment.times[3], segment.times[-3], 200_001)
    for k in range(2):
        values = np.concatenate([[0.0], part.commands[:, k]])
        signal = values[np.searchsorted(part.command_times, fine - delays[k], side="right")]
        assert means[3:-2, k].mean() == pytest.approx(signal.mean(), abs=0.02)
    expected = differences(lambda r: commands.mean(r)[0].ravel(), rho, 1e-7)
    assert slopes.reshape(-1, len(rho)) == pytest.approx(expected, abs=1e-4 * max(1.0, np.abs(expected).max()))


def test_a_step_stops_at_bounds_and_the_others_follow() -> None:
    information = np.array([[[2.0, 1.0], [1.0, 2.0]]])
    factors = RhoFactors(information, np.array([[-4.0, -2.0]]), np.zeros(2), np.zeros(2))
    free = np.array([True, True])
    wide = np.full(2, 10.0)
    assert bounded_step(factors, 0.0, -wide, wide, free) == pytest.approx([2.0, 0.0])
    held = bounded_step(factors, 0.0, -wide, np.array([1.0, 10.0]), free)
    assert held == pytest.approx([1.0, 0.5])
    assert bounded_step(factors, 0.0, -wide, wide, np.array([False, True])) == pytest.approx([0.0, 1.0])
    assert bounded_step(factors, 0.0, -wide, np.array([0.0, 10.0]), free) == pytest.approx([0.0, 1.0])


def test_the_sandwich_is_the_jackknife_of_the_mean() -> None:
    """One parameter, each log says a number: the variance of the mean, whatever noise was stated."""
    rng = np.random.default_rng(0)
    said = rng.normal(size=20)
    factors = RhoFactors(np.ones((20, 1, 1)), (said.mean() - said)[:, None], np.zeros(1), np.zeros(1))
    found = estimate_uncertainty(factors, np.array([True]), np.array([False]))
    assert found.kind == "sandwich"
    assert found.covariance[0, 0] == pytest.approx(np.var(said, ddof=1) / 20)
    assert found.graph[0, 0] == pytest.approx(1 / 20)
    assert found.quantile == pytest.approx(2.093, abs=1e-3)  # t, 19 degrees of freedom


def test_a_log_left_out_does_not_move_the_others_through_a_parameter_that_its_bound_holds() -> None:
    """Against the minimum within bounds of what is left without each log."""
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(12, 2, 2))
    information = np.einsum("lij,lkj->lik", roots, roots) + np.eye(2)
    gradient = rng.normal(size=(12, 2))
    gradient[:, 1] -= gradient[:, 1].mean()
    gradient[:, 0] += 50.0  # downhill leads below the lower bound of the first
    factors = RhoFactors(information, gradient, np.zeros(2), np.zeros(2))
    low, free = np.array([0.0, -10.0]), np.array([True, True])
    held = held_at_bounds(factors, low, np.full(2, 10.0))
    assert held.tolist() == [True, False]
    found = estimate_uncertainty(factors, free, held)
    left = np.delete(np.arange(12), 5)
    without = RhoFactors(information[left], gradient[left], np.zeros(2), np.zeros(2))
    move = bounded_step(without, 0.0, low, np.full(2, 10.0), free)
    assert move[0] == 0.0
    assert found.shifts[5, 1] == pytest.approx(move[1])
    assert found.std[0] > 0.0
    other = (information[:, 1, 1].sum() - information[:, 1, 1]) ** -1.0 * gradient[:, 1]
    assert found.std[1] == pytest.approx(np.sqrt(11 / 12 * np.sum((other - other.mean()) ** 2)))


@pytest.mark.parametrize("graph", [FastGraph, PaperGraph])
def test_a_step_to_a_bound_ends_on_it_to_the_last_bit(graph: type[FastGraph | PaperGraph]) -> None:
    problem, point = small_problem()
    p, rng = problem.parameters, np.random.default_rng(0)
    rho = next(
        rho for rho in rng.uniform(p.low, p.high, (200, len(p.low))) if ((rho + (p.high - rho)) > p.high).any()
    )  # there are such: the step to the bound is rounded
    point = replace(point, rho=rho)
    at = graph(problem)
    at.linearise(point)
    at.reduce(0.0)
    assert (at.moved(p.high - rho).rho <= p.high).all()
    assert (at.moved(p.low - rho).rho >= p.low).all()


@pytest.mark.parametrize("yaw", [0.0, 1.5, 3.0])
def test_the_search_does_not_look_at_the_yaw_of_a_vehicle_that_has_none(yaw: float) -> None:
    logs = [changed_yaw(log, yaw) for log in point_logs(4)]
    settings = Settings(auxiliary="none")
    parameters = parameters_of(POINT, settings, ())
    segments = [whole_segment(log.parts[0], i, settings.step) for i, log in enumerate(logs)]
    problem = assemble(segments, len(logs), parameters, noise_model(POINT, settings, NOISE))
    mean = problem.actuators.mean(parameters.nominal)[0]
    found = InitialSearch(
        parameters, problem.dynamics.discrete_model, problem.chains, smooth_chains(problem.chains), mean
    ).best()
    assert found == pytest.approx([0.9, 0.3], rel=0.1)


def test_noise_is_measured_in_spite_of_motion_and_outliers() -> None:
    vehicle = load_vehicle_config("mushr-lag")
    parts = [log.parts[0] for log in synthetic_logs(vehicle, TRUTH, range(4), noise=(0.004, 0.03), outliers=0.05)]
    noise = measured_noise([p.pose_times for p in parts], [p.poses for p in parts])
    assert noise.position == pytest.approx(0.004, rel=0.15)
    assert noise.yaw == pytest.approx(0.03, rel=0.1)


def test_smoothing_follows_the_motion_and_not_the_outliers() -> None:
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0.0, 5.0, 150))
    truth = np.column_stack([np.cos(times), np.sin(times), times])
    poses = truth + 0.01 * rng.normal(size=truth.shape)
    poses[::25, :2] += 0.5
    at = np.linspace(0.2, 4.8, 90)
    smooth_poses, rates = smoothed(times, poses, at)
    off = np.abs(smooth_poses - np.column_stack([np.cos(at), np.sin(at), at]))
    assert np.median(off) < 0.005
    assert np.quantile(off, 0.95) < 0.05
    assert np.median(np.abs(rates[:, 2] - 1.0)) < 0.1


def test_the_robust_threshold_leaves_as_many_poses_alone_as_in_one_dimension() -> None:
    rng = np.random.default_rng(0)
    for shown in (2, 3):
        distances = np.linalg.norm(rng.normal(size=(200_000, shown)), axis=1)
        assert np.mean(distances > threshold(1.345, shown)) == pytest.approx(0.1786, abs=0.003)
    assert threshold(None, 3) == np.inf


def test_a_pose_without_yaw_has_two_residuals_for_the_robust_threshold() -> None:
    for vehicle, shown in ((POINT, 2), (vehicle_of(load_vehicle_config("mushr-lag")), 3)):
        assert noise_model(vehicle, Settings(), NOISE).threshold == threshold(1.345, shown)


def test_rest_is_told_from_motion_at_a_parts_beginning() -> None:
    part = synthetic_logs(load_vehicle_config("mushr-lag"), TRUTH, [0])[0].parts[0]
    assert begins_at_rest(part)
    late = replace(part, pose_times=part.pose_times[200:], poses=part.poses[200:])
    assert not begins_at_rest(late)


@pytest.mark.parametrize("noise", [1e-4, 0.002, 0.01])
@pytest.mark.parametrize("delay", [0.0, 0.15])
def test_rest_is_told_from_slow_motion_with_noise_and_outliers(noise: float, delay: float) -> None:
    truth = {**TRUTH, "delay": delay}
    vehicle = load_vehicle_config("mushr-lag")
    slow, fast = [[0.5, 0.1]], [[1.0, -0.1]]
    commands = (np.array([0.0, 0.02, 5.0]), np.array(slow + slow + fast))
    logs = synthetic_logs(
        vehicle, truth, range(20), seconds=10.0, commands=[commands] * 20, noise=(noise, 0.02), outliers=0.02
    )
    parts = [log.parts[0] for log in logs]
    cut = [replace(part, pose_times=part.pose_times[90:], poses=part.poses[90:]) for part in parts]
    assert np.mean([begins_at_rest(part) for part in parts]) >= 0.9
    assert not any(begins_at_rest(part) for part in cut)  # at 0.35 m/s, half of what follows


def test_poses_that_cannot_tell_rest_are_not_taken_for_it() -> None:
    part = synthetic_logs(load_vehicle_config("mushr-lag"), TRUTH, [0], noise=(0.1, 0.02))[0].parts[0]
    assert not begins_at_rest(part)
    for count in (1, 2, 5):
        assert not begins_at_rest(replace(part, pose_times=part.pose_times[:count], poses=part.poses[:count]))


def test_poses_lie_in_the_steps_that_they_were_seen_in() -> None:
    part = synthetic_logs(load_vehicle_config("mushr-lag"), TRUTH, [0], seconds=3.0)[0].parts[0]
    problem, _ = small_problem()
    segment = segment_between(part, 0, 0.05, 10, 60, False)
    chains = assemble([segment], 1, problem.parameters, problem.noise).chains
    seen = segment.times[chains.step] + chains.share * segment.h
    assert seen == pytest.approx(part.pose_times[10:60])
    assert (chains.seen[1:] - chains.seen[:-1]).sum() == 50
    assert segment.h <= 0.05


def test_a_factor_that_is_not_finite_stops_the_paper_graph() -> None:
    problem, point = small_problem()
    broken = replace(point, states=np.full_like(point.states, np.nan))
    with pytest.raises(Defect, match="not finite"):
        PaperGraph(problem).linearise(broken)
