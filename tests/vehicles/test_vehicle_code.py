"""A user's own vehicle: found wherever it is, and what is wrong with its code is said in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.diagnostics import located, raised
from support.paths import ROOT

from kraft.errors import Code
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario, parse_scenario
from kraft.vehicles.load import load_vehicle

EXAMPLE = ROOT / "examples" / "05_vehicle.py"

CODE = """from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

@derivative
def motion(x, u, p):
    return x[3] * cos(x[2]), x[3] * sin(x[2]), u[1], u[0]

CAR = Vehicle(
    name="car",
    derivative=motion,
    state=("x", "y", "theta", "v"),
    controls={"a": (-1.0, 1.0), "w": (-1.0, 1.0)},
    footprint=Footprint(0.4, 0.3),
    top_speed=1.0,
)
"""
RETURN = "x[3] * cos(x[2]), x[3] * sin(x[2]), u[1], u[0]"
SCENE = (
    "name: x\nbounds: {x: [0, 4], y: [0, 4]}\nstart: {x: 1, y: 1, heading_deg: 0}\ngoal: {center: [3, 3], radius: 1}\n"
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_example_is_about_ten_lines_and_a_vehicle() -> None:
    vehicle = load_vehicle(str(EXAMPLE))
    assert vehicle.name == "skid-steer"
    body = EXAMPLE.read_text().partition("VEHICLE = ")[2]
    assert len(body.splitlines()) <= 11


def test_code_is_a_module_or_a_file_with_or_without_an_attribute(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "my_car_module.py").write_text(CODE)
    monkeypatch.syspath_prepend(str(folder))
    for reference in (
        "my_car_module:CAR",
        "my_car_module.py:CAR",
        "my_car_module.py",
        f"{folder}/my_car_module.py:CAR",
    ):
        assert load_vehicle(reference).name == "car"


def test_a_file_is_relative_to_what_names_it(folder: Path) -> None:
    robots = folder / "robots"
    robots.mkdir()
    (robots / "car.py").write_text(CODE)
    (robots / "car.yaml").write_text(
        "name: fast\nmodel: car.py:CAR\nfootprint: {length: 0.6, width: 0.5, offset: 0.1}\ntop_speed: 2\n"
    )
    vehicle = load_vehicle("robots/car.yaml")
    assert (vehicle.name, vehicle.top_speed, vehicle.footprint.offset) == ("fast", 2.0, 0.1)
    task = parse_scenario(SCENE + "vehicle: car.py:CAR\n", str(robots / "scene.yaml"), robots).task()
    assert vehicle_of_task(task).name == "car"


def test_a_vehicle_file_can_import_its_neighbour(folder: Path) -> None:
    (folder / "measured_constants.py").write_text("TOP = 1.5\n")
    (folder / "neighbourly.py").write_text(
        "from measured_constants import TOP\n" + CODE.replace("top_speed=1.0", "top_speed=TOP")
    )
    assert load_vehicle("neighbourly.py").top_speed == 1.5


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("none.py:CAR", (Code.NOT_FOUND, "a Python file")),
        ("no_such_module_at_all:CAR", (Code.CODE, "defines a Vehicle")),
        ("kraft.vehicles.mushr:MUSRH", (Code.NOT_FOUND, "'MUSHR'")),
        ("kraft.vehicles.mushr:STEERING_MAX", (Code.TYPE, "MUSHR, MUSHR_LAG, MUSHR_DRIVE")),
        ("mushrr", (Code.NOT_FOUND, "'mushr'")),
        ("a b:C", (Code.VALUE, "module:attribute")),
    ],
)
def test_a_wrong_reference_is_explained(reference: str, expected: tuple[Code, str], folder: Path) -> None:
    (problem,) = raised(lambda: load_vehicle(reference))
    assert (problem.file, problem.code) == (reference, expected[0])
    assert expected[1] in problem.expected


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (RETURN, "x[3] * cos(x[2]), x[3] * sin(x[2]), u[1]", "derivative 'motion' returns 3 values"),
        (RETURN, "x[3]", "derivative 'motion' returns one number"),
        (RETURN, "'a', 0.0, 0.0, 0.0", "derivative 'motion' returns (text, float64, float64, float64)"),
        (RETURN, "x[3], x[7], u[1], u[0]", "derivative 'motion' does not compile: tuple index out of range ({file}:6)"),
        (RETURN, "x[3].speed, x[3], u[1], u[0]", "derivative 'motion' does not compile: Unknown attribute 'speed' of type float64 ({file}:6)"),
        (RETURN, "cosine(x[2]), x[3], u[1], u[0]", "derivative 'motion' does not compile: NameError: name 'cosine' is not defined"),
        (RETURN, "[x[3], x[3], u[1], u[0]]", "derivative 'motion' does not compile: it creates a list or an array, but kernels cannot allocate memory"),
        ("(x, u, p)", "(x, u)", "derivative 'motion' does not compile: Signature mismatch: 3 argument types given, but function takes 2 arguments"),
        (RETURN, "x[3], x[3], u[1], u[0] / x[3]", "derivative 'motion' returns (0, 0, 0, nan) at rest"),
        ("@derivative\n", "", "derivative 'motion' is not compiled"),
        (RETURN, "(" + RETURN, "does not import: SyntaxError: '(' was never closed ({file}, line 6)"),
        ("Footprint(0.4, 0.3)", "Footprint(0.0, 0.3)", "does not import: ValueError: footprint sizes must be positive and finite, got Footprint(length=0.0, width=0.3, offset=0.0) at {path}:13"),
        ('"theta", "v")', '"theta")', "does not import: ValueError: vehicle 'car': rest names 'v', which is not a state component at {path}:8"),
        ("top_speed=1.0", "top_speed=-1.0", "does not import: ValueError: vehicle 'car': top_speed must be positive and finite, got -1.0 at {path}:8"),
        ("from ompl_ext.trig", "raise SystemExit(3)\nfrom ompl_ext.trig", "does not import: SystemExit: 3 at {path}:1"),
    ],
)  # fmt: skip
def test_wrong_code_is_explained_before_anything_is_planned(old: str, new: str, expected: str, folder: Path) -> None:
    assert CODE.count(old) >= 1
    (folder / "car.py").write_text(CODE.replace(old, new, 1))
    (problem,) = raised(lambda: load_vehicle("car.py:CAR"))
    assert (problem.file, problem.code) == ("car.py:CAR", Code.CODE)
    assert problem.problem == expected.format(file="car.py", path=folder / "car.py")


def test_a_wrong_stop_and_a_wrong_actuation_are_told_together(folder: Path) -> None:
    more = """
@derivative
def actuation(u, p):
    return u[0]

@derivative
def stop(x, p, k):
    return 0.0, 0.0, 0.0
"""
    code = CODE.replace("\nCAR", more + "\nCAR").replace(
        "    name=", "    actuation=actuation,\n    inputs=('a', 'w'),\n    stop=stop,\n    name="
    )
    (folder / "car.py").write_text(code)
    found = raised(lambda: load_vehicle("car.py:CAR"))
    assert [(problem.code, problem.problem.split()[0]) for problem in found] == [
        (Code.CODE, "actuation"),
        (Code.CODE, "stop"),
    ]


def test_a_file_with_two_vehicles_asks_which(folder: Path) -> None:
    (folder / "two.py").write_text(CODE + "VAN = CAR.with_parameters({})\n")
    (problem,) = raised(lambda: load_vehicle("two.py"))
    assert problem.code is Code.CODE
    assert "two.py:CAR, two.py:VAN" in problem.expected
    (folder / "zero.py").write_text("x = 1\n")
    (problem,) = raised(lambda: load_vehicle("zero.py"))
    assert problem.code is Code.CODE


def test_what_a_scenario_names_is_explained_at_its_line(folder: Path) -> None:
    (folder / "car.py").write_text("import nothing_like_it\n" + CODE)
    task = parse_scenario(SCENE + "vehicle: car.py:CAR\n", str(folder / "scene.yaml"), folder).task()
    (problem,) = raised(lambda: vehicle_of_task(task))
    assert located([problem]) == ["5:10 vehicle code"]
    assert problem.file == f"{folder}/scene.yaml"
    assert f"{folder}/car.py:1" in problem.problem


def test_what_a_vehicle_file_says_of_its_model_is_explained_at_its_line(folder: Path) -> None:
    (folder / "car.py").write_text(CODE)
    text = "name: a\nmodel: car.py:CRA\nparameters:\n  mass: {value: 1, unit: kg}\nfootprint: {length: 1, width: 1}\ntop_speed: 1\n"
    (folder / "car.yaml").write_text(text)
    assert located(raised(lambda: load_vehicle("car.yaml"))) == ["2:8 model not-found"]
    (folder / "car.yaml").write_text(text.replace("CRA", "CAR"))
    assert located(raised(lambda: load_vehicle("car.yaml"))) == ["4:3 parameters.mass unknown"]
    (folder / "car.yaml").write_text(text.replace("car.py:CRA", "cra.py:CAR"))
    assert located(raised(lambda: load_vehicle("car.yaml"))) == ["2:8 model not-found"]


def test_bundled_scenarios_name_vehicles_that_load() -> None:
    assert vehicle_of_task(load_scenario("turns").task()).name == "mushr"


def test_a_copied_or_moved_file_is_compiled_for_itself(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cached machine code imports the module that it was compiled from, which may be gone."""
    monkeypatch.chdir(folder)
    for name in ("one.py", "two.py"):
        Path(name).write_text(CODE)
    by_file, copied, as_module = (load_vehicle(name) for name in ("one.py:CAR", "two.py:CAR", "one:CAR"))
    assert len({by_file.hash, copied.hash, as_module.hash}) == 3
    assert load_vehicle("one.py:CAR").hash == by_file.hash
