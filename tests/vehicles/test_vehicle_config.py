"""Vehicle files: the bundled ones hold the measured numbers, and wrong ones are explained."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.diagnostics import located, raised

from kraft.config import bundled
from kraft.config.document import Document
from kraft.errors import Code
from kraft.vehicles import config
from kraft.vehicles.config import Footprint, VehicleConfig, load_vehicle_config
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.mushr import MUSHR_LAG
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle

CAR = """name: car
model: my_robots.car:CAR
parameters:
  L: {value: 0.3, unit: m, min: 0.2, max: 0.4, std: 0.01}
footprint: {length: 0.4, width: 0.28}
top_speed: 1.0
"""


def car(folder: Path, text: str) -> VehicleConfig:
    path = folder / "car.yaml"
    path.write_text(text)
    return load_vehicle_config(path)


def test_a_delay_of_commands_may_be_stated(tmp_path: Path) -> None:
    assert car(tmp_path, CAR).delay is None
    stated = car(tmp_path, CAR + "delay: {value: 0.02, std: 0.005}\n").delay
    assert stated is not None
    assert (stated.value, stated.std) == (0.02, 0.005)
    assert load_vehicle("f1tenth").delay == (0.01, 0.01)
    assert load_vehicle("mushr").delay is None


def test_errors_of_predictions_by_speed_may_be_stated(tmp_path: Path) -> None:
    errors = "{speeds: [0, 1.5], windows: 9, after: [1, 2], along: [0.1, 0.2], across: [0.01, 0.03], yaw: [0.1, 0.1]}"
    (found,) = car(tmp_path, CAR + f"errors_by_speed: [{errors}]\n").prediction_errors
    assert (found.speeds, found.after, found.across) == ((0.0, 1.5), (1.0, 2.0), (0.01, 0.03))
    assert car(tmp_path, CAR).prediction_errors == ()
    slow, *_, fast = load_vehicle("f1tenth").errors_by_speed
    assert slow.speeds[1] < fast.speeds[0]
    wrong = errors.replace("[0, 1.5]", "[1.5, 0]").replace("[1, 2]", "[2, 1]")
    assert len(problems_of(tmp_path, CAR + f"errors_by_speed: [{wrong}, {errors.replace('[1, 2]', '[]')}]\n")) == 3
    assert len(problems_of(tmp_path, CAR + f"errors_by_speed: [{errors.replace('[0.01, 0.03]', '[0.01]')}]\n")) == 1


@pytest.mark.parametrize("delay", ["{value: -0.1, std: 0.01}", "{value: 0.6, std: 0.01}", "{value: 0.1, std: 0}"])
def test_a_delay_that_no_estimate_could_have_is_refused(tmp_path: Path, delay: str) -> None:
    assert len(problems_of(tmp_path, CAR + f"delay: {delay}\n")) == 1


RECORD = """identification:
  started_from: car
  interval: graph
  covariance: {names: [L, tau], matrix: [[1, 0.5], [0.5, 2]]}
  noise: {position: 0.01, yaw: 0.01, measured: true}
  fitted: {position: [0.1], yaw: [0.1], overall_position: 0.1, overall_yaw: 0.1}
  logs: []
  versions: {}
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("0.5, 2", "0.5, 2", []),
        ("[L, tau]", "[L, L]", ["10:27 identification.covariance.names[1] duplicate"]),
        ("[[1, 0.5]", "[[1, 0.4]", ["10:53 identification.covariance.matrix[1][0] mismatch"]),
        ("[[1, 0.5], [0.5, 2]]", "[[1, 0.5]]", ["10:41 identification.covariance.matrix mismatch"]),
        ("[[1, 0.5], [0.5, 2]]", "[[1], [0.5, 2]]", ["10:41 identification.covariance.matrix mismatch"]),
        ("[[1, 0.5], [0.5, 2]]", "[[-1, 5], [7, -1]]", [
            "10:43 identification.covariance.matrix[0][0] value",
            "10:52 identification.covariance.matrix[1][0] mismatch",
            "10:55 identification.covariance.matrix[1][1] value",
        ]),
        ("[[1, 0.5], [0.5, 2]]", "[[1, x], [0.5, 2]]", ["10:46 identification.covariance.matrix[0][1] type"]),
    ],
)  # fmt: skip
def test_a_covariance_that_none_could_be_is_refused(old: str, new: str, expected: list[str], tmp_path: Path) -> None:
    assert problems_of(tmp_path, CAR + RECORD.replace(old, new)) == expected


def problems_of(folder: Path, text: str) -> list[str]:
    path = folder / "car.yaml"
    path.write_text(text)
    return located(raised(lambda: load_vehicle_config(path)))


VEHICLES = (
    "benchmark",
    "car",
    "car-lag",
    "differential",
    "f1tenth",
    "jackal",
    "mushr",
    "mushr-drive",
    "mushr-force",
    "mushr-lag",
    "unicycle2",
)


def test_the_vehicles_are_bundled() -> None:
    assert bundled.names("vehicle") == VEHICLES


@pytest.mark.parametrize(
    ("name", "values", "footprint"),
    [
        ("mushr", {"L": 0.329, "phi_diff": 0.0, "v_delta": 0.631}, (0.40, 0.28, 0.0)),
        ("mushr-lag", {"L": 0.331, "phi_diff": 0.0, "v_delta": 0.650, "tau": 0.748}, (0.40, 0.28, 0.0)),
        ("mushr-drive", {"L": 0.331, "phi_diff": 0.0, "v_delta": 0.707, "tau": 0.866, "u_0": 0.138}, (0.44, 0.28, -0.005)),
        ("benchmark", {"gain": 0.6228, "rate": 0.9898, "steering_max": 0.4203, "wheelbase": 0.2965}, (0.40, 0.28, 0.0)),
    ],
)  # fmt: skip
def test_a_bundled_car_has_the_measured_parameters_in_the_models_order(
    name: str, values: dict[str, float], footprint: tuple[float, float, float]
) -> None:
    config = load_vehicle_config(name)
    assert config.name == name
    assert list(config.values) == list(values)
    assert config.values == pytest.approx(values, abs=1e-3)
    length, width, offset = footprint
    assert config.footprint == Footprint(length=length, width=width, offset=offset)


def test_the_lag_is_the_benchmarks_rate_seen_as_a_time() -> None:
    rate = load_vehicle_config("benchmark").values["rate"]
    assert MUSHR_LAG.parameters["tau"] == pytest.approx(1 / rate, abs=1e-4)


@pytest.mark.parametrize("name", bundled.names("vehicle"))
def test_a_bundled_vehicle_is_described_and_names_its_schema(name: str) -> None:
    text = (bundled.folder("vehicle") / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.splitlines()[0] == "# yaml-language-server: $schema=vehicle.schema.json"
    assert load_vehicle_config(name).description


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("name: car", "name: a/b", "1:7 name value"),
        ("my_robots.car:CAR", "my_robots.car", "2:8 model value"),
        ("my_robots.car:CAR", "my-robots:CAR", "2:8 model value"),
        ("  L:", "  2L:", "4:3 parameters.2L value"),
        ("value: 0.3", "value: 0.5", "4:14 parameters.L.value value"),
        ("value: 0.3", "value: 0.1", "4:14 parameters.L.value value"),
        ("value: 0.3", "value: .inf", "4:14 parameters.L.value value"),
        ("min: 0.2", "min: 0.9", "4:33 parameters.L.min conflict"),
        ("std: 0.01", "std: 0", "4:53 parameters.L.std value"),
        ("unit: m, ", "", "4:3 parameters.L.unit missing"),
        ("max: 0.4", "maxx: 0.4", "4:38 parameters.L.maxx unknown"),
        ("length: 0.4", "length: 0", "5:21 footprint.length value"),
        ("length: 0.4", "lenght: 0.4, length: 0.4", "5:13 footprint.lenght unknown"),
        ("top_speed: 1.0", "top_speed: -1", "6:12 top_speed value"),
    ],
)  # fmt: skip
def test_a_wrong_vehicle_file_is_explained(old: str, new: str, expected: str, tmp_path: Path) -> None:
    assert problems_of(tmp_path, CAR.replace(old, new)) == [expected]


def test_a_value_out_of_its_bounds_is_reported_whatever_else_is_wrong(tmp_path: Path) -> None:
    text = CAR.replace("value: 0.3, unit: m,", "value: 0.5,").replace("top_speed: 1.0\n", "")
    assert problems_of(tmp_path, text) == [
        "1:1 top_speed missing",
        "4:3 parameters.L.unit missing",
        "4:14 parameters.L.value value",
    ]


def test_an_unknown_vehicle_is_answered_with_the_nearest_one() -> None:
    (problem,) = raised(lambda: load_vehicle_config("musrh"))
    assert (problem.file, problem.code) == ("musrh", Code.NOT_FOUND)
    assert "'mushr'" in problem.expected


def test_a_vehicle_knows_where_its_values_were_written(tmp_path: Path) -> None:
    (tmp_path / "car.yaml").write_text(CAR)
    position = load_vehicle_config(tmp_path / "car.yaml").source.where("parameters.L.value")
    assert str(position) == "line 4, column 14"


def test_the_true_robot_of_a_file_is_the_one_that_it_states_now(tmp_path: Path) -> None:
    path, text = tmp_path / "mine.yaml", (bundled.folder("vehicle") / "mushr.yaml").read_text()
    path.write_text(text)
    vehicle = load_vehicle(str(path))
    before, _ = natural_robot(vehicle)
    path.write_text(f"{text}truth: {{car: {{length: 0.5}}}}\n")
    os.utime(path, (0, 0))
    after, source = natural_robot(vehicle)
    assert before.car is not None
    assert after.car is not None
    assert (before.car.length, after.car.length) == (None, 0.5)
    assert source.where("truth.car.length") is not None


def test_other_values_keep_the_rest_of_the_vehicle() -> None:
    config = load_vehicle_config("mushr")
    changed = config.with_values({"L": 0.3})
    assert changed.values == {**config.values, "L": 0.3}
    assert config.values["L"] != 0.3
    assert changed.source.where("top_speed") == config.source.where("top_speed")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"l": 0.3}, "l unknown"),
        ({"mass": 3.0}, "mass unknown"),
        ({"L": 9.0}, "mushr parameters.L.value value"),
        ({"L": float("nan")}, "mushr parameters.L.value value"),
    ],
)
def test_other_values_are_checked(values: dict[str, float], expected: str) -> None:
    (problem,) = raised(lambda: load_vehicle_config("mushr").with_values(values))
    assert f"{problem.file} {located([problem])[0]}" == expected


def test_a_reference_is_a_name_a_path_or_a_module_and_attribute(tmp_path: Path) -> None:
    (tmp_path / "car.yaml").write_text(CAR)
    assert resolve_vehicle("mushr", tmp_path) == "mushr"
    assert resolve_vehicle("a.b:C", tmp_path) == "a.b:C"
    assert resolve_vehicle("car.yaml", tmp_path) == str((tmp_path / "car.yaml").resolve())
    for wrong in ("mushrr", "a.b:", ":C", "a b:C", "none.yaml", "", "x\0.yaml"):
        with pytest.raises(VehicleProblem):
            resolve_vehicle(wrong, tmp_path)


def test_a_file_is_checked_again_only_after_it_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every row of an evaluation asks for its vehicle."""
    checked: list[str] = []
    check = config.valid

    def counted(model: type[VehicleConfig], document: Document) -> VehicleConfig:
        checked.append(document.source.file)
        return check(model, document)

    monkeypatch.setattr(config, "valid", counted)
    path = tmp_path / "own.yaml"
    path.write_bytes((bundled.folder("vehicle") / "mushr.yaml").read_bytes())
    first, again = load_vehicle(str(path)), load_vehicle(str(path))
    assert checked == [str(path)]
    assert (again.parameters, again.footprint) == (first.parameters, first.footprint)
    before = path.stat()
    path.write_text(path.read_text().replace("top_speed: v_delta", "top_speed: 0.500"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert load_vehicle(str(path)).top_speed == 0.5
    assert load_vehicle(str(path), parameters={"L": 0.3}).parameters["L"] == 0.3
    assert load_vehicle(str(path)).parameters["L"] == first.parameters["L"]
    assert checked == [str(path)] * 2
