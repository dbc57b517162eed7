"""Warnings of settings of a method: a watchdog that stops the car too early, and what has no effect."""

from pathlib import Path

import pytest

from kraft.config import bundled
from kraft.driving.method import load_method
from kraft.evaluation.experiment import experiment_of
from kraft.trial.warnings import early_watchdog, unused_polish, warnings_of


@pytest.mark.parametrize(("watchdog", "early"), [(0.1, True), (0.5, True), (0.6, False), (None, False)])
def test_a_watchdog_that_is_not_longer_than_the_patience_is_said(watchdog: float | None, early: bool) -> None:
    method = load_method("adaptive-kraft")
    method = method.model_copy(update={"planner": method.planner.model_copy(update={"watchdog": watchdog})})
    assert ("planner.watchdog" in early_watchdog(method)) is early


@pytest.mark.parametrize("name", bundled.names("method"))
def test_no_bundled_method_has_such_settings(name: str) -> None:
    assert early_watchdog(load_method(name)) == ""
    assert unused_polish(load_method(name)) == ""


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
