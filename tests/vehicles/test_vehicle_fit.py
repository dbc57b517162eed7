"""What a vehicle file states fits its model: units, names of parameters, the top speed."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.diagnostics import raised

from kraft.errors import Code
from kraft.vehicles.load import load_vehicle, units_of
from kraft.vehicles.mushr import MUSHR

CAR = """name: car
model: kraft.vehicles.mushr:MUSHR
parameters:
  L: {value: 0.3, unit: m}
footprint: {length: 0.4, width: 0.28}
top_speed: v_delta
"""


def car(folder: Path, *changes: tuple[str, str]) -> str:
    text = CAR
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "car.yaml").write_text(text)
    return str(folder / "car.yaml")


def test_the_top_speed_may_be_a_parameter_that_keeps_the_value_of_the_model(tmp_path: Path) -> None:
    vehicle = load_vehicle(car(tmp_path))
    assert vehicle.top_speed == vehicle.parameters["v_delta"] == MUSHR.parameters["v_delta"]
    assert vehicle.parameters["L"] == 0.3


def test_a_unit_that_is_not_that_of_the_model_is_refused_at_its_place(tmp_path: Path) -> None:
    (found,) = raised(lambda: load_vehicle(car(tmp_path, ("unit: m}", "unit: mm}"))))
    assert (found.line, found.path, found.code) == (4, "parameters.L.unit", Code.MISMATCH)
    assert "'m'" in found.expected


def test_a_top_speed_is_no_parameter_in_another_unit(tmp_path: Path) -> None:
    (found,) = raised(lambda: load_vehicle(car(tmp_path, ("top_speed: v_delta", "top_speed: phi_diff"))))
    assert (found.line, found.path, found.code) == (6, "top_speed", Code.MISMATCH)
    assert found.problem == "is the parameter phi_diff, in rad"


def test_code_of_ones_own_states_no_units() -> None:
    assert units_of("my_robots.car:CAR") == {}
    assert units_of("kraft.vehicles.mushr:MUSHR") == {"L": "m", "phi_diff": "rad", "v_delta": "m/s"}


@pytest.mark.parametrize(
    ("model", "speed", "paths"),
    [
        ("kraft.vehicles.mushr:MUSHRR", "-1", ["model", "parameters.L.value", "top_speed"]),
        ("kraft.vehicles.mushr:MUSHR", "v_dleta", ["parameters.L.value", "parameters.l", "top_speed"]),
        ("kraft.vehicles.mushr", "-1", ["model", "parameters.L.value", "top_speed"]),
    ],
)
def test_problems_of_the_file_and_of_its_model_come_together(
    tmp_path: Path, model: str, speed: str, paths: list[str]
) -> None:
    wrong = ("value: 0.3, unit: m}", "value: x, unit: m}\n  l: {value: 1, unit: m}")
    path = car(tmp_path, ("kraft.vehicles.mushr:MUSHR", model), ("v_delta", speed), wrong)
    assert [d.path for d in raised(lambda: load_vehicle(path))] == paths
