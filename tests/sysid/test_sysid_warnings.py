"""What an identification says of doubtful logs and of parameters that they hardly show."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from support.lag_logs import changed, commanded, driven, lag, logs, said

from benchmarks.synthetic_logs import synthetic_logs
from benchmarks.sysid import NOISE, PLAIN, TRUTH
from kraft.logs.log import Part
from kraft.sysid import Noise, identify
from kraft.sysid.optimiser import ParameterUncertainty, estimate_uncertainty
from kraft.vehicles.config import load_vehicle_config


def test_driving_straight_asks_for_turns() -> None:
    straight = [commanded([0.0], [0.4, 0.9, 0.6])] * 3
    data = synthetic_logs(lag(), {**TRUTH, "phi_diff": 0.0}, range(3), seconds=8.0, commands=straight)
    result = identify(lag(), data, PLAIN)
    assert said(result, "steering hardly changes", "arcs to the left and to the right")
    assert said(result, "do not identify L:", "arcs to the left")
    assert "L" in result.unidentified


def test_radians_taken_for_degrees_are_suspected_where_the_vehicle_turns_with_them() -> None:
    shrunk = [
        replace(log, parts=tuple(replace(p, commands=p.commands * [1.0, np.pi / 180]) for p in log.parts))
        for log in driven(commanded([0.3, -0.2]), commanded([-0.3, 0.1]), commanded([0.15, -0.25]))
    ]
    assert said(identify(lag(), shrunk, PLAIN), "steering hardly changes", "were radians taken for degrees?")


@pytest.mark.parametrize(("scale", "foreign"), [(5.0, False), (100.0, True)])
def test_a_throttle_far_beyond_that_of_the_vehicle_is_suspected_to_be_in_another_unit(
    scale: float, foreign: bool
) -> None:
    scaled = [
        replace(log, parts=tuple(replace(p, commands=p.commands * [scale, 1.0]) for p in log.parts))
        for log in driven(commanded([0.3, -0.2]), commanded([-0.3, 0.1]), commanded([0.15, -0.25]))
    ]
    result = identify(lag(), scaled, PLAIN)
    assert said(result, "the throttle reaches 90,", "takes 0 to 1", "mapping file") == foreign
    assert foreign or not said(result, "the throttle reaches")


def test_a_throttle_that_makes_steps_diverge_ends_with_warnings_of_the_identification_alone() -> None:
    """Numeric overflow is an error in the tests."""
    absurd = [
        replace(log, parts=tuple(replace(p, commands=p.commands * [1e6, 1.0]) for p in log.parts)) for log in logs()
    ]
    assert said(identify(lag(), absurd, PLAIN), "the throttle reaches")


def test_one_constant_circle_asks_for_the_other_side() -> None:
    assert said(identify(lag(), driven(*[commanded([0.3, 0.1, 0.2])] * 3), PLAIN), "only steers to the left")
    result = identify(lag(), driven(*[commanded([0.3])] * 3), PLAIN)
    assert said(result, "L and phi_diff are nearly indistinguishable", "arcs to the left and to the right")
    both = identify(lag(), driven(commanded([0.3]), commanded([-0.3]), commanded([0.15])), PLAIN)
    assert not said(both, "L and phi_diff")


def test_what_is_hardly_told_apart_follows_from_the_correlation_that_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def alike(*given: Any) -> ParameterUncertainty:
        found = estimate_uncertainty(*given)
        covariance = found.covariance.copy()
        covariance[0, 3] = covariance[3, 0] = -0.96 * np.sqrt(covariance[0, 0] * covariance[3, 3])
        shifts = found.shifts.copy()
        shifts[:, 3] = -shifts[:, 0]  # in all logs
        return replace(found, covariance=covariance, shifts=shifts)

    monkeypatch.setattr(import_module("kraft.sysid.identify"), "estimate_uncertainty", alike)
    result = identify(lag(), logs(), PLAIN)
    assert result.correlation[0, 3] == pytest.approx(-0.96)
    assert abs(result.graph_covariance[0, 3]) < 0.9 * np.prod(np.sqrt(np.diag(result.graph_covariance)[[0, 3]]))
    assert said(result, "L and tau are nearly indistinguishable (correlation -0.96):")
    assert sum("indistinguishable" in warning for warning in result.warnings) == 1


def test_a_lag_without_changes_of_throttle_is_not_told() -> None:
    truth = load_vehicle_config("mushr-lag")
    one = driven(*[commanded([0.3, -0.3, 0.1, -0.1], [0.7])] * 2)
    parts = [log.parts[0] for log in one]
    late = [
        replace(log, parts=(Part(p.command_times, p.commands, p.pose_times[150:], p.poses[150:]),))
        for log, p in zip(one, parts, strict=True)
    ]
    result = identify(truth, late, PLAIN)
    assert said(result, "tau", "steps of the throttle")


def test_steering_with_the_wrong_sign_is_noticed() -> None:
    flipped = [changed(log, commands=log.parts[0].commands * [1.0, -1.0]) for log in logs()]
    assert "opposite signs" in identify(lag(), flipped, PLAIN).warnings[0]  # the cause before its consequences


def test_commands_of_another_drive_are_noticed() -> None:
    swapped = [changed(log, commands=np.roll(log.parts[0].commands, 4, axis=0)) for log in logs()]
    assert said(identify(lag(), swapped, PLAIN), "does not correlate with curvature")


def test_a_value_at_its_bound_is_named() -> None:
    data = synthetic_logs(lag(), {**TRUTH, "v_delta": 2.4}, range(3), seconds=8.0)
    result = identify(lag(), data, PLAIN)
    assert result.parameters["v_delta"].at_bound
    assert said(result, "v_delta is at its upper bound 2 m/s")


def test_an_interval_is_cut_at_a_bound_and_that_the_data_do_not_bound_it_is_said() -> None:
    free = identify(lag(), logs(), PLAIN)
    tau = free.parameters["tau"]
    most = tau.value + 0.5 * tau.std
    narrow = lag().parameters["tau"].model_copy(update={"value": tau.value - tau.std, "max": most})
    near = lag().model_copy(update={"parameters": {**lag().parameters, "tau": narrow}})
    result = identify(near, logs(), PLAIN)
    found = result.parameters["tau"]
    assert not found.at_bound
    assert found.ci95[0] == pytest.approx(tau.ci95[0], abs=0.2 * tau.std)
    assert found.ci95[1] == most == found.max
    assert found.truncated
    assert said(result, "the data do not bound tau", f"beyond its bounds {lag().parameters['tau'].min:g} to {most:g} s")
    assert not any(each.truncated for each in free.parameters.values())
    assert not said(free, "do not bound")


@pytest.mark.parametrize(("factor", "words"), [(0.1, "stated too small"), (10.0, "stated too large")])
def test_noise_that_does_not_fit_the_residuals_is_named(factor: float, words: str) -> None:
    noise = Noise(factor * NOISE.position, factor * NOISE.yaw)
    assert said(identify(lag(), logs(), replace(PLAIN, noise=noise)), words)


def test_logs_that_disagree_are_named() -> None:
    other = synthetic_logs(lag(), {**TRUTH, "L": 0.4}, [77], seconds=10.0)
    result = identify(lag(), [*logs(), *other], PLAIN)
    assert said(result, "the logs disagree about", "log-077 differs most")
