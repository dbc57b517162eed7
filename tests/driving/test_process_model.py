"""Motion of the pose filter's state: mean and covariance are those of the model, propagated by its derivatives."""

import math

import numpy as np
import pytest

from kraft.driving.car_model import model_of
from kraft.driving.estimation.pose_filter import ProcessModel
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats, Matrix

DURATION = 0.12
TIMES = np.array([0.5, 2.0, math.inf])


def process_of(name: str) -> tuple[ProcessModel, Floats, Floats]:
    """Process model of a vehicle with three errors, a state in motion and a control."""
    model = model_of(load_vehicle(name))
    process = ProcessModel(model, TIMES.copy())
    control = 0.6 * model.high
    state = np.zeros(process.size)
    state[: len(model.vehicle.state)] = model.advance(np.zeros(len(model.vehicle.state)), control, 0.4)
    state[[model.x, model.y, model.theta]] = 1.0, -2.0, 2.5
    state[-4:] = 0.05, 0.02, -0.03, 0.1
    return process, state, control


def jacobian_of(process: ProcessModel, state: Floats, control: Floats) -> Matrix:
    """Central differences (size, size) of the motion."""
    columns = []
    for change in 1e-6 * np.eye(process.size):
        ahead, behind = (process.advance(state + side * change, [(control, DURATION)]) for side in (1.0, -1.0))
        columns.append((ahead - behind) / 2e-6)
    return np.array(columns).T


@pytest.mark.parametrize("name", ["mushr-force", "mushr-lag", "unicycle2", "jackal", "f1tenth"])
def test_the_covariance_is_propagated_by_the_derivatives_of_the_motion(name: str) -> None:
    process, state, control = process_of(name)
    process.variance_rate[:] = np.linspace(0.01, 0.02, process.size)
    root = np.random.default_rng(0).normal(size=(process.size, process.size))
    before = root @ root.T
    mean, covariance = process.predicted(state, before, [(control, DURATION)])
    jacobian = jacobian_of(process, state, control)
    assert mean == pytest.approx(process.advance(state, [(control, DURATION)]), abs=1e-12)
    expected = jacobian @ before @ jacobian.T + np.diag(process.variance_rate * DURATION)
    assert covariance == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["mushr-force", "unicycle2"])
def test_without_excess_and_errors_the_vehicle_moves_as_in_its_model(name: str) -> None:
    process, state, control = process_of(name)
    model, nx = model_of(load_vehicle(name)), len(state) - 4
    state[nx:] = 0.0
    assert process.advance(state, [(control, DURATION)])[:nx] == pytest.approx(
        model.advance(state[:nx], control, DURATION), abs=1e-12
    )


def test_an_excess_of_the_speed_moves_a_car_further_along_its_curve() -> None:
    """And decays; the errors decay with their time constants, one with an infinite time constant stays."""
    process, state, control = process_of("mushr-force")
    plain = state.copy()
    plain[-4] = 0.0
    faster, slower = (process.advance(each, [(control, DURATION)]) for each in (state, plain))
    moved = faster[:3] - slower[:3]
    distance = 0.05 * 2.0 * (1.0 - math.exp(-DURATION / 2.0))
    assert math.hypot(*moved[:2]) == pytest.approx(distance, rel=1e-3)
    course = math.atan2(*(slower[:2] - state[:2])[::-1])
    assert math.remainder(math.atan2(moved[1], moved[0]) - course, math.tau) == pytest.approx(0.0, abs=0.05)
    assert moved[2] > 0.0, "the car turns left"
    assert faster[-4] == pytest.approx(0.05 * math.exp(-DURATION / 2.0))
    assert faster[-3:] == pytest.approx(state[-3:] * np.exp(-DURATION / TIMES))


def test_an_excess_of_the_speed_of_a_unicycle_moves_it_straight_ahead() -> None:
    """However fast it turns: its turning rate is another component of its state."""
    process, state, control = process_of("unicycle2")
    plain = state.copy()
    plain[-4] = 0.0
    faster, slower = (process.advance(each, [(control, DURATION)]) for each in (state, plain))
    moved = faster[:3] - slower[:3]
    heading = 0.5 * (state[2] + slower[2])
    assert math.remainder(math.atan2(moved[1], moved[0]) - heading, math.tau) == pytest.approx(0.0, abs=0.02)
    assert moved[2] == pytest.approx(0.0, abs=1e-6)


def test_uncertain_parameters_make_the_speed_uncertain() -> None:
    """By the square of the derivative of the acceleration, for as long as it counts as the same."""
    process, state, control = process_of("mushr-force")
    model = model_of(load_vehicle("mushr-force"))
    k, names = model.v, list(model.vehicle.parameters)
    process.spread = np.zeros((1, len(names)))
    process.spread[0, names.index("v_delta")] = 0.2
    process.same[k] = 0.4
    changed = model.parameters.copy()
    changed[names.index("v_delta")] += 1e-4
    rates = model.rates(state[: len(process.same)], control, np.array([model.parameters, changed]))
    expected = (0.2 * (rates[1] - rates[0]) / 1e-4) ** 2
    assert process.rate_variance(state, control) == pytest.approx(expected, rel=1e-2, abs=1e-9)
    zero = np.zeros((process.size, process.size))
    _, covariance = process.predicted(state, zero, [(control, 0.01)])
    assert covariance[k, k] == pytest.approx(expected[k] * 0.4 * 0.01, rel=0.05)


def test_without_commands_nothing_changes() -> None:
    process, state, _ = process_of("mushr-force")
    covariance = np.eye(process.size)
    mean, after = process.predicted(state, covariance, [])
    assert np.array_equal(mean, state)
    assert np.array_equal(after, covariance)
    assert mean is not state, "the result is a copy"


def test_commands_that_follow_each_other_act_as_if_each_was_predicted_alone() -> None:
    process, state, control = process_of("mushr-force")
    held = [(control, DURATION), (-0.5 * control, 0.03), (0.2 * control, 0.07)]
    single, mean, covariance = state, state, np.eye(process.size)
    for command in held:
        single = process.advance(single, [command])
        mean, covariance = process.predicted(mean, covariance, [command])
    assert np.array_equal(process.advance(state, held), single)
    assert all(map(np.array_equal, process.predicted(state, np.eye(process.size), held), (mean, covariance)))
