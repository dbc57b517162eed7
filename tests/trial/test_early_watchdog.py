"""Warnings of settings of a method: a watchdog that stops the car too early, and what has no effect."""

from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.driving.method import load_method
from kraft.evaluation.experiment import experiment_of
from kraft.trial.result import TrialSpec
from kraft.trial.trial import run_trial
from kraft.trial.warnings import early_watchdog, unused_polish, warnings_of, watchdog_of_one_plan


@pytest.mark.parametrize(("watchdog", "early"), [(0.1, True), (0.5, True), (0.6, False), (None, False)])
def test_a_watchdog_that_is_not_longer_than_the_patience_is_said(watchdog: float | None, early: bool) -> None:
    method = load_method("adaptive-kraft")
    method = method.model_copy(update={"planner": method.planner.model_copy(update={"watchdog": watchdog})})
    assert ("planner.watchdog" in early_watchdog(method)) is early


@pytest.mark.parametrize("name", bundled.names("method"))
def test_no_bundled_method_has_such_settings(name: str) -> None:
    assert early_watchdog(load_method(name)) == ""
    assert watchdog_of_one_plan(load_method(name)) == ""
    assert unused_polish(load_method(name)) == ""


def test_a_car_with_one_plan_is_stopped_by_a_watchdog_when_the_warning_says(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("base: oneshot-kinodynamic\nname: m\ntitle: M\nplanner: {watchdog: 0.5}\n")
    (cell,) = experiment_of(["turns"], [tmp_path / "m.yaml"]).cells
    (said,) = warnings_of(cell.scenario, cell.method, cell.vehicle)
    assert "stops the car for good 1.5 s after the start" in said
    steps = run_trial(TrialSpec.load("turns", tmp_path / "m.yaml", None, 0)).steps
    assert next(step.time for step in steps if step.watchdog) == pytest.approx(1.5, abs=0.1)
    assert all(step.watchdog for step in steps if step.time > 1.6)
    assert steps[-1].speed == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("planner", "said"), [("sst", True), ("dirt", False)])
def test_local_optimisation_that_a_planner_does_not_have_is_said(planner: str, said: bool) -> None:
    method = load_method("adaptive-kraft")
    assert unused_polish(method) == ""
    changes = {"type": planner, "polish": True}
    method = method.model_copy(update={"planner": method.planner.model_copy(update=changes)})
    assert (f"planner.polish, which has no effect with planner.type {planner}" in unused_polish(method)) is said
    assert (
        unused_polish(method.model_copy(update={"planner": method.planner.model_copy(update={"polish": None})})) == ""
    )


def test_a_trial_and_an_evaluation_warn_of_an_early_watchdog(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("base: adaptive-kraft\nname: m\ntitle: M\nplanner: {watchdog: 0.1}\n")
    (cell,) = experiment_of(["turns"], [tmp_path / "m.yaml"]).cells
    assert warnings_of(cell.scenario, cell.method, cell.vehicle) == (early_watchdog(cell.method),)
