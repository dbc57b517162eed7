"""Online identification over a sliding window: what the data tell is found, what they do not tell stays at its prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.adaptive import (
    BEGIN,
    HEADING,
    OTHER,
    POSITION,
    SETTINGS,
    exciting,
    pose_at,
    recorded,
    standing,
    straight,
    vehicle,
    window,
)  # fmt: skip
from support.driving import RATE

from kraft.driving.car_model import CarModel
from kraft.driving.estimation.drive_history import DriveHistory, RecordedDrive
from kraft.driving.estimation.pose_noise import NoiseEstimate
from kraft.driving.estimation.sliding_window import Identified
from kraft.sysid.interface import Noise

INTERVAL = 2.5  # standard deviations, 99 %


def independent(length: float) -> Noise:
    """Noise of poses with independent errors, whatever the `length` of the motion."""
    return Noise(POSITION, HEADING)


def deviations(found: Identified) -> dict[str, float]:
    """Standard deviation of each parameter."""
    return dict(zip(window().parameters.names, np.sqrt(np.diag(found.covariance)), strict=True))


def values(found: Identified) -> dict[str, float]:
    return dict(zip(window().parameters.names, found.rho, strict=True))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2])
def test_the_window_finds_delay_wheelbase_and_steering_offset(seed: int, delay: float) -> None:
    found = window().update(recorded(exciting, 7.0, OTHER, delay, seed), [(0.1, 7.0)], independent)
    assert found is not None
    value, deviation = values(found), deviations(found)
    assert value["delay"] == pytest.approx(delay, abs=0.03)
    for name in ("L", "phi_diff"):
        assert value[name] == pytest.approx(OTHER[name], abs=INTERVAL * deviation[name])
    assert deviation["L"] < 0.4 * window().parameters.std[0]  # so the interval says something
    assert deviation["phi_diff"] < 0.3 * window().parameters.std[1]
    assert deviation["delay"] < 0.2 * window().parameters.std[-1]


def until(drive: RecordedDrive, time: float) -> RecordedDrive:
    """The drive until `time` (s)."""
    poses, commands = drive.times <= time, drive.command_times <= time
    return RecordedDrive(
        drive.times[poses], drive.poses[poses], drive.states[poses], drive.command_times[commands],
        drive.commands[commands],
    )  # fmt: skip


def test_a_car_that_stands_tells_nothing() -> None:
    assert window().update(recorded(standing, 7.0, OTHER, 0.1), [], independent) is None


def test_a_car_that_stands_but_is_taken_to_move_leaves_wheelbase_and_delay_at_their_priors() -> None:
    subject = window()
    found = subject.update(recorded(standing, 7.0, OTHER, 0.1), [(0.5, 6.0)], independent)
    assert found is not None
    names, priors = subject.parameters.names, subject.parameters
    for name in ("L", "phi_diff", "delay"):
        k = names.index(name)
        assert found.rho[k] == pytest.approx(priors.nominal[k], abs=0.05 * priors.std[k])
        assert deviations(found)[name] == pytest.approx(priors.std[k], rel=0.05)


def test_driving_straight_tells_the_steering_offset_but_not_the_wheelbase() -> None:
    subject = window()
    found = subject.update(recorded(straight, 7.0, {"phi_diff": 0.06}, 0.0), [(0.1, 7.0)], independent)
    assert found is not None
    deviation, priors = deviations(found), subject.parameters
    assert values(found)["phi_diff"] == pytest.approx(0.06, abs=INTERVAL * deviation["phi_diff"])
    assert deviation["phi_diff"] < 0.3 * priors.std[1]
    assert deviation["L"] > 0.8 * priors.std[0]


def test_standing_does_not_make_the_window_forget() -> None:
    moved = [(0.1, 7.5)]
    soon, late = (
        window().update(recorded(exciting, 7.0, OTHER, 0.1, rest=rest), moved, independent) for rest in (1.5, 20.0)
    )
    assert soon is not None
    assert late is not None
    assert late.rho == pytest.approx(soon.rho, abs=1e-9)
    assert late.covariance == pytest.approx(soon.covariance, rel=1e-6, abs=1e-12)


def test_motion_before_the_window_does_not_count() -> None:
    """The last 6 s of motion are those after 1 s, so where it began does not matter."""
    drive = recorded(exciting, 7.0, OTHER, 0.1)
    whole, cut = (window().update(drive, [(begin, 7.0)], independent) for begin in (0.1, 1.0))
    assert whole is not None
    assert cut is not None
    assert np.array_equal(whole.rho, cut.rho)


def test_an_update_begins_where_the_last_one_ended() -> None:
    subject = window()
    drive = recorded(exciting, 7.0, OTHER, 0.1)
    first, second = (subject.update(drive, [(0.1, 7.0)], independent) for _ in range(2))
    assert first is not None
    assert second is not None
    assert np.array_equal(subject.rho, second.rho)
    assert second.rho == pytest.approx(first.rho, abs=0.2 * np.sqrt(np.diag(first.covariance)).min())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("name", "value"), [("phi_diff", 0.07), ("phi_diff", -0.07)])
def test_a_parameter_that_changes_is_followed_while_most_of_the_window_is_older(
    seed: int, name: str, value: float
) -> None:
    """Two of the six seconds are those of the changed car; updates come in cycles, and the camera is a good one."""
    drive = recorded(exciting, 9.0, {}, 0.1, seed, change=(7.0, {name: value}))
    subject, constant = window(), window()
    for time in np.arange(7.0, 9.1, 0.25):
        found = subject.update(until(drive, float(time)), [(0.1, float(time))], independent)
    before = constant.update(recorded(exciting, 7.0, {}, 0.1, seed), [(0.1, 7.0)], independent)
    assert found is not None
    assert before is not None
    k = subject.parameters.names.index(name)
    own, change = vehicle().parameters[name], value - vehicle().parameters[name]
    assert before.rho[k] == pytest.approx(own, abs=0.15 * abs(change))
    assert abs(subject.rho[k] - value) > 0.4 * abs(change)  # rho of the whole window
    assert abs(found.rho[k] - value) < 0.25 * abs(change)
    assert abs(found.before.mean[k] - own) < 0.25 * abs(change)
    assert found.covariance[k, k] > before.covariance[k, k]


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_that_grows_weak_is_followed_in_what_it_does(seed: int) -> None:
    """A force explains two seconds as well as a weaker drive does; both predict the acceleration."""
    drive = recorded(exciting, 9.0, {}, 0.1, seed, change=(7.0, {"v_delta": 0.4}))
    subject, k = window(), vehicle().index("v")
    for time in np.arange(7.0, 9.1, 0.25):
        found = subject.update(until(drive, float(time)), [(0.1, float(time))], independent)
    assert found is not None
    own = np.array(list(vehicle().parameters.values()))
    true = np.array(list(vehicle().with_parameters({"v_delta": 0.4}).parameters.values()))
    tried = np.array([true, own, found.rho[: len(own)]])
    acceleration = CarModel(vehicle()).rates(drive.states[-1], drive.commands[-1], tried)[:, k]
    wrong = np.abs(acceleration[1:] - acceleration[0])
    assert wrong[0] > 0.1
    assert wrong[1] < 0.3 * wrong[0]


def test_a_wheelbase_does_not_change_while_the_car_drives() -> None:
    """A score of the wheelbase has another cause, so rho keeps the one of the whole window."""
    drive = recorded(exciting, 9.0, {}, 0.1, 0, change=(7.0, {"L": 0.45}))
    subject = window()
    for time in np.arange(7.0, 9.1, 0.25):
        found = subject.update(until(drive, float(time)), [(0.1, float(time))], independent)
        assert found is not None
        spread = 0.5 * np.sqrt(found.covariance[0, 0])
        assert found.rho[0] == pytest.approx(subject.rho[0], abs=max(spread, 0.01))


def test_noise_that_varies_slowly_matters_less_for_a_short_motion() -> None:
    noise = replace(NoiseEstimate.of(SETTINGS), share=np.full(3, 0.5), time=1.0)
    long, short, shortest = (noise.of_one_pose(1.0 / 30.0, length).yaw for length in (np.inf, 1.0, 0.1))
    sigma = np.sqrt(noise.variance[2])
    assert long == pytest.approx(np.sqrt(0.5 + 0.5 * 60.0) * sigma, rel=0.01)  # as many poses as two time constants
    assert np.sqrt(0.5) * sigma < shortest < short < 0.35 * long  # half of the variance is independent
    independent_errors = replace(noise, share=np.zeros(3))
    assert independent_errors.of_one_pose(1.0 / 30.0, 1.0).yaw == pytest.approx(sigma)


def test_a_car_that_does_not_change_is_hardly_taken_for_one_that_did() -> None:
    moved = []
    for seed in range(12):
        subject = window()
        found = subject.update(recorded(exciting, 7.0, OTHER, 0.1, seed), [(0.1, 7.0)], independent)
        assert found is not None
        moved.append(np.abs(found.rho - subject.rho) / subject.parameters.std)
        assert found.rho[-1] == pytest.approx(subject.rho[-1], abs=0.02)
    assert np.sqrt(np.mean(np.square(moved))) < 0.15


def test_residuals_are_as_large_as_the_noise() -> None:
    found = window().update(recorded(exciting, 7.0, OTHER, 0.1), [(0.1, 7.0)], independent)
    assert found is not None
    assert found.residuals.shape == (len(found.times), 3)
    assert np.sqrt(np.mean(found.residuals[:, :2] ** 2)) == pytest.approx(POSITION, rel=0.25)
    assert np.sqrt(np.mean(found.residuals[:, 2] ** 2)) == pytest.approx(HEADING, rel=0.25)


# What counts as motion


def observed(speed: float, sigma: float, seed: int) -> DriveHistory:
    """History of 3 s at a speed along x, with errors of the poses."""
    history, rng = DriveHistory(BEGIN, CarModel(vehicle())), np.random.default_rng(seed)
    for k in range(round(3 * RATE)):
        pose = BEGIN + np.array([speed * k / RATE, 0.0, 0.0, 0.0])
        history.observe(pose_at(k, pose, np.append(sigma * rng.normal(size=2), 0.0)), pose)
    return history


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("speed", "moves"), [(0.0, False), (0.02, False), (0.15, True)])
def test_poses_show_whether_the_vehicle_moves(speed: float, moves: bool, seed: int) -> None:
    assert observed(speed, 0.02, seed).has_moved(0.02**2) == moves


def test_poses_show_no_motion_that_is_smaller_than_their_errors() -> None:
    assert not observed(0.15, 0.02, 0).has_moved(0.05**2)


def test_the_start_alone_shows_no_motion() -> None:
    assert not DriveHistory(BEGIN, CarModel(vehicle())).has_moved(0.01)


@pytest.mark.parametrize(
    ("begin", "end", "left"),
    [
        (3.0, 4.0, [(0.0, 2.5), (4.5, 8.0), (9.0, 9.5)]),
        (3.0, 8.7, [(0.0, 2.5), (9.2, 9.5)]),
        (0.2, 20.0, []),
        (8.3, 8.4, [(0.0, 7.8), (9.0, 9.5)]),
    ],
)
def test_a_time_that_is_left_out_counts_as_standstill(
    begin: float, end: float, left: list[tuple[float, float]]
) -> None:
    history = DriveHistory(BEGIN, CarModel(vehicle()))
    history.moving = [(0.0, 8.0), (9.0, 9.5)]
    history.leave_out(begin, end)
    assert history.moving == [pytest.approx(span) for span in left]


def test_commands_right_after_a_time_that_is_left_out_do_not_bring_it_back() -> None:
    """A window uses half a second before a motion as well."""
    history = DriveHistory(BEGIN, CarModel(vehicle()))
    for time in np.arange(0.0, 7.01, 0.1):
        history.command(float(time), np.zeros(2), moves=True)
    history.leave_out(5.0, 7.0)
    for time in np.arange(7.1, 9.01, 0.1):
        history.command(float(time), np.zeros(2), moves=True)
    (begin, left), (again, end) = history.moving
    assert (begin, left, end) == pytest.approx((0.0, 4.5, 9.0))
    assert 7.5 <= again <= 7.6001


def test_a_change_that_is_forgotten_is_looked_for_anew() -> None:
    """An update that knows a change since 7 s has two seconds of data on it, one that does not know it has one."""
    drive, moving = recorded(exciting, 9.0, {}, 0.1, change=(7.0, {"phi_diff": 0.07})), [(0.1, 9.0)]
    subject, fresh = window(), window()
    for time in np.arange(7.0, 9.1, 0.25):
        known = subject.update(until(drive, float(time)), [(0.1, float(time))], independent)
    subject.forget_change()
    fresh.rho = subject.rho.copy()
    anew, first = subject.update(drive, moving, independent), fresh.update(drive, moving, independent)
    assert known is not None
    assert anew is not None
    assert first is not None
    assert np.array_equal(anew.rho, first.rho)
    k = subject.parameters.names.index("phi_diff")
    assert anew.covariance[k, k] > 1.2 * known.covariance[k, k]
