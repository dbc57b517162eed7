"""Online identification over a sliding window: what the data tell is found, what they do not tell stays at its prior."""

from __future__ import annotations

import numpy as np
import pytest
from support.adaptive import HEADING, OTHER, POSITION, exciting, recorded, standing, straight, vehicle, window

from kraft.driving.estimation.sliding_window import Identified
from kraft.sysid.interface import Noise

NOISE = Noise(POSITION, HEADING)
INTERVAL = 2.5  # standard deviations, 99 %


def deviations(found: Identified) -> dict[str, float]:
    """Standard deviation of each parameter."""
    return dict(zip(window().parameters.names, np.sqrt(np.diag(found.covariance)), strict=True))


def values(found: Identified) -> dict[str, float]:
    return dict(zip(window().parameters.names, found.rho, strict=True))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2])
def test_the_window_finds_delay_wheelbase_and_steering_offset(seed: int, delay: float) -> None:
    found = window().update(recorded(exciting, 7.0, OTHER, delay, seed), [(0.1, 7.0)], NOISE)
    assert found is not None
    value, deviation = values(found), deviations(found)
    assert value["delay"] == pytest.approx(delay, abs=0.03)
    for name in ("L", "phi_diff"):
        assert value[name] == pytest.approx(OTHER[name], abs=INTERVAL * deviation[name])
    assert deviation["L"] < 0.4 * window().parameters.std[0]  # so the interval says something
    assert deviation["phi_diff"] < 0.3 * window().parameters.std[1]
    assert deviation["delay"] < 0.2 * window().parameters.std[-1]


def test_a_car_that_stands_tells_nothing() -> None:
    assert window().update(recorded(standing, 7.0, OTHER, 0.1), [], NOISE) is None


def test_a_car_that_stands_but_is_taken_to_move_leaves_wheelbase_and_delay_at_their_priors() -> None:
    subject = window()
    found = subject.update(recorded(standing, 7.0, OTHER, 0.1), [(0.5, 6.0)], NOISE)
    assert found is not None
    names, priors = subject.parameters.names, subject.parameters
    for name in ("L", "phi_diff", "delay"):
        k = names.index(name)
        assert found.rho[k] == pytest.approx(priors.nominal[k], abs=0.05 * priors.std[k])
        assert deviations(found)[name] == pytest.approx(priors.std[k], rel=0.05)


def test_driving_straight_tells_the_steering_offset_but_not_the_wheelbase() -> None:
    subject = window()
    found = subject.update(recorded(straight, 7.0, {"phi_diff": 0.06}, 0.0), [(0.1, 7.0)], NOISE)
    assert found is not None
    deviation, priors = deviations(found), subject.parameters
    assert values(found)["phi_diff"] == pytest.approx(0.06, abs=INTERVAL * deviation["phi_diff"])
    assert deviation["phi_diff"] < 0.3 * priors.std[1]
    assert deviation["L"] > 0.8 * priors.std[0]


def test_standing_does_not_make_the_window_forget() -> None:
    moved = [(0.1, 7.5)]
    soon, late = (window().update(recorded(exciting, 7.0, OTHER, 0.1, rest=rest), moved, NOISE) for rest in (1.5, 20.0))
    assert soon is not None
    assert late is not None
    assert late.rho == pytest.approx(soon.rho, abs=1e-9)
    assert late.covariance == pytest.approx(soon.covariance, rel=1e-6, abs=1e-12)


def test_motion_before_the_window_does_not_count() -> None:
    """The last 6 s of motion are those after 1 s, so where it began does not matter."""
    drive = recorded(exciting, 7.0, OTHER, 0.1)
    whole, cut = (window().update(drive, [(begin, 7.0)], NOISE) for begin in (0.1, 1.0))
    assert whole is not None
    assert cut is not None
    assert np.array_equal(whole.rho, cut.rho)


def test_an_update_begins_where_the_last_one_ended() -> None:
    subject = window()
    drive = recorded(exciting, 7.0, OTHER, 0.1)
    first, second = (subject.update(drive, [(0.1, 7.0)], NOISE) for _ in range(2))
    assert first is not None
    assert second is not None
    assert np.array_equal(subject.rho, second.rho)
    assert second.rho == pytest.approx(first.rho, abs=0.2 * np.sqrt(np.diag(first.covariance)).min())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("name", "value"), [("phi_diff", 0.07), ("phi_diff", -0.07), ("v_delta", 0.4)])
def test_a_parameter_that_changes_is_followed_while_most_of_the_window_is_older(
    seed: int, name: str, value: float
) -> None:
    """Two of the six seconds are those of the changed car; the noise is that of a good camera."""
    drive = recorded(exciting, 9.0, {}, 0.1, seed, change=(7.0, {name: value}))
    subject, constant = window(), window()
    found = subject.update(drive, [(0.1, 9.0)], NOISE)
    before = constant.update(recorded(exciting, 7.0, {}, 0.1, seed), [(0.1, 7.0)], NOISE)
    assert found is not None
    assert before is not None
    k = subject.parameters.names.index(name)
    own, change = vehicle().parameters[name], value - vehicle().parameters[name]
    assert before.rho[k] == pytest.approx(own, abs=0.15 * abs(change))
    assert abs(subject.rho[k] - value) > 0.4 * abs(change)  # rho of the whole window
    assert found.constant == pytest.approx(subject.rho)
    assert abs(found.rho[k] - value) < 0.25 * abs(change)
    assert found.covariance[k, k] > before.covariance[k, k]


def test_a_car_that_does_not_change_is_hardly_taken_for_one_that_did() -> None:
    moved = []
    for seed in range(12):
        subject = window()
        found = subject.update(recorded(exciting, 7.0, OTHER, 0.1, seed), [(0.1, 7.0)], NOISE)
        assert found is not None
        moved.append(np.abs(found.rho - subject.rho) / subject.parameters.std)
        assert found.rho[-1] == pytest.approx(subject.rho[-1], abs=0.02)
    assert np.sqrt(np.mean(np.square(moved))) < 0.15


def test_residuals_are_as_large_as_the_noise() -> None:
    found = window().update(recorded(exciting, 7.0, OTHER, 0.1), [(0.1, 7.0)], NOISE)
    assert found is not None
    assert found.residuals.shape == (len(found.times), 3)
    assert np.sqrt(np.mean(found.residuals[:, :2] ** 2)) == pytest.approx(POSITION, rel=0.25)
    assert np.sqrt(np.mean(found.residuals[:, 2] ** 2)) == pytest.approx(HEADING, rel=0.25)
