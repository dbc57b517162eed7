"""What `kraft sysid` says about the models that it compared."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from support.paths import ROOT

from kraft.config import bundled
from kraft.recording.area import Area
from kraft.recording.experiment import PlannedDrive
from kraft.recording.manoeuvres import Manoeuvre
from kraft.sysid.base_vehicle import load_base_vehicle
from kraft.sysid.interface import ModelTrial
from kraft.sysid.parameters import auxiliary_parameters, parameter_specs
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.load import RecordedVehicle, configured, load_vehicle
from kraft.vehicles.true_robot import CarDimensions, RobotTruth
from kraft_cli.work.next_drives import NextDrives, next_lines
from kraft_cli.work.sysid import SysidResult
from kraft_cli.work.sysid_notes import bounds_note, braking_note, uncovered_robot
from kraft_cli.work.sysid_report import BY_MODEL, TERMS_LEGEND, choice_lines, model_caption
from kraft_cli.work.sysid_request import SysidRequest


@pytest.mark.parametrize(
    ("fitted", "held_out", "expected"),
    [
        (3, 1, "mean of the 3 fitted logs, each predicted by a fit to the others; the held-out logs have no part in the choice"),
        (3, 0, "mean of the 3 fitted logs, each predicted by a fit to the others"),
        (1, 0, "mean of the fitted logs"),
    ],
)  # fmt: skip
def test_the_caption_of_the_models_says_which_logs_they_are_judged_on(
    fitted: int, held_out: int, expected: str
) -> None:
    split = SimpleNamespace(fitted=("log",) * fitted, held_out=("log",) * held_out)
    models = tuple(ModelTrial(name, (), "", {1.0: 0.1}, False, on_fitted=fitted == 1) for name in ("car", "mushr-lag"))
    identification = SimpleNamespace(models=models)
    caption = model_caption(cast(SysidResult, SimpleNamespace(split=split, identification=identification)))
    assert caption == f"models by the position error of open-loop predictions, {expected}"


def test_a_row_of_a_model_that_was_fitted_to_the_logs_it_predicts_is_named() -> None:
    models = (
        ModelTrial("car", (), "", {1.0: 0.1}, True, on_fitted=True),
        ModelTrial("mushr-lag", (), "", {1.0: 0.1}, False),
    )
    result = SimpleNamespace(
        split=SimpleNamespace(fitted=("log",) * 4, held_out=()), identification=SimpleNamespace(models=models)
    )
    assert "each predicted by a fit to the others (by car by the fit to all of them)" in model_caption(
        cast(SysidResult, result)
    )


@pytest.mark.parametrize(("other", "says"), [(0.02, False), (0.009, True)])
def test_the_rule_of_a_choice_is_told_where_another_row_is_better(other: float, says: bool) -> None:
    rows = [ModelTrial("car", (), "", {1.0: other, 2.0: 0.05}, False), ModelTrial("b", (), "", {1.0: 0.01}, True)]
    assert choice_lines(rows, BY_MODEL) == ([BY_MODEL] if says else [])


@pytest.mark.parametrize("name", ["car", "car-lag", "differential"])
def test_every_term_is_explained_where_the_legend_of_the_terms_points(name: str) -> None:
    page, _, heading = TERMS_LEGEND.split(" explains")[0].split()[-1].partition("#")
    section = (ROOT / page).read_text(encoding="utf-8").split(f"\n## {heading.capitalize()}\n")[1].split("\n## ")[0]
    kind = "`differential`" if name == "differential" else "a car"
    table = section.split(f"| term of {kind} |")[1].split("\n\n")[0]
    definition = load_base_vehicle(name).definition
    assert isinstance(definition, VehicleConfig)
    terms = {key: spec for key, spec in definition.parameters.items() if spec.neutral is not None}
    assert terms
    for key, spec in terms.items():
        assert f"\n| `{key}` | {spec.unit} | " in table
    for auxiliary in auxiliary_parameters(load_base_vehicle("mushr").vehicle):
        stem = re.sub("^(delay|lag)_.*", r"\1_<control>", auxiliary)
        assert f"`{stem}`" in section.split("| auxiliary parameter |")[1]


@pytest.mark.parametrize(("least", "says"), [(0.0, True), (-0.3, False)])
def test_a_file_of_a_car_without_brakes_is_noted(least: float, says: bool) -> None:
    base = load_base_vehicle("car")
    assert isinstance(base.definition, VehicleConfig)
    config = base.definition.with_controls({"throttle": (least, 1.0), "steering": (-0.3, 0.3)})
    car = replace(base, definition=config, vehicle=configured(config))
    noted = braking_note(SysidRequest(logs=(), out=Path("car.yaml")), car)
    assert bool(noted) == says
    assert all("car.yaml neither brakes nor drives backwards" in note for note in noted)
    assert braking_note(SysidRequest(logs=()), car) == ()
    for note in noted:
        named = re.search(r"kraft record --commands FILE .* --vehicle of .* such as ([a-z0-9-]+)\)", note)
        assert named is not None
        assert load_vehicle(named[1]).controls["throttle"][0] < 0.0


def test_bounds_that_nobody_states_are_noted_and_leave_an_offset_its_sign() -> None:
    known = load_base_vehicle("mushr-drive")
    assert bounds_note(SysidRequest(logs=()), known) == ()
    assert isinstance(known.definition, VehicleConfig)
    kept = {name: p for name, p in known.definition.parameters.items() if name == "L"}
    bare = known.definition.model_copy(update={"parameters": kept})
    base = replace(known, definition=bare, vehicle=configured(bare))
    (noted,) = bounds_note(SysidRequest(logs=(), out=Path("car.yaml")), base)
    assert noted.startswith("nothing states min, max and std of phi_diff, v_delta, tau, u_0: bounds are assumed")
    assert noted.endswith("and written to car.yaml")
    bounds = {spec.name: (spec.min, spec.max, spec.unit) for spec in parameter_specs(bare, ())}
    assert bounds["phi_diff"] == (-1.0, 1.0, "rad")
    assert bounds["v_delta"][:2] == pytest.approx((0.06861, 6.861))


def test_a_file_whose_footprint_does_not_cover_the_recorded_robot_is_warned_of(tmp_path: Path) -> None:
    base, request = load_base_vehicle("mushr-drive"), SysidRequest(logs=(), out=tmp_path / "mine.yaml")

    def warned(robot: RobotTruth | None) -> tuple[str, ...]:
        recorded = RecordedVehicle.of(base.vehicle, RobotTruth()).model_copy(update={"truth": robot})
        return uncovered_robot(request, replace(base, recorded=recorded), {})

    large = RobotTruth(car=CarDimensions(length=0.6, width=0.35))
    (warning,) = warned(large)
    assert f"(0.6 m x 0.35 m) is not covered by the footprint of {tmp_path}/mine.yaml (0.44 m x 0.28 m)" in warning
    assert "expected footprint: {length: 0.6, width: 0.35}" in warning
    assert warned(RobotTruth(car=CarDimensions())) == warned(None) == ()
    (tmp_path / "broken.xml").write_text("<mujoco")
    (broken,) = warned(RobotTruth(mjcf=str(tmp_path / "broken.xml")))
    assert "mine.yaml states does not load: " in broken
    recorded = RecordedVehicle.of(base.vehicle, large)
    assert uncovered_robot(SysidRequest(logs=()), replace(base, recorded=recorded), {}) == ()


def test_a_file_that_keeps_a_robot_beyond_its_footprint_from_the_initial_vehicle_is_warned_of(tmp_path: Path) -> None:
    text = (bundled.folder("vehicle") / "mushr-drive.yaml").read_text()
    (tmp_path / "initial.yaml").write_text(text + "truth: {car: {length: 0.6, width: 0.35}}\n")
    base = load_base_vehicle(str(tmp_path / "initial.yaml"))
    (warning,) = uncovered_robot(SysidRequest(logs=(), out=tmp_path / "next.yaml"), base, {})
    assert "is not covered by the footprint of" in warning
    assert "next.yaml" in warning


@pytest.mark.parametrize(("unidentified", "says"), [((), []), (("tau",), ["no drive shows tau"])])
def test_no_drive_is_said_to_miss_a_parameter_that_the_logs_show(
    unidentified: tuple[str, ...], says: list[str]
) -> None:
    drive = PlannedDrive(
        (), ("straight on",), cast(Manoeuvre, SimpleNamespace(end=5.0)), np.zeros((2, 3)),
        {"L": 0.02, "tau": 0.3}, {"L": 0.0199, "tau": 0.29}, 0.2, 0.1,
    )  # fmt: skip
    lines = next_lines(NextDrives((drive,), Area(6.0, 4.0), (), unidentified))
    assert [line for line in lines if line.startswith("no drive shows")] == says
