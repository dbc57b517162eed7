"""A user's own vehicle: found wherever it is, and what is wrong with its code is said in one line."""

from __future__ import annotations

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.diagnostics import located, raised
from support.paths import ROOT

from kraft.config.user_code import failure_in_code, imported
from kraft.errors import Code
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario, parse_scenario
from kraft.vehicles.load import RecordedVehicle, load_vehicle
from kraft.vehicles.mushr import MUSHR
from kraft.vehicles.true_robot import RobotTruth
from kraft_cli.main import main
from ompl_ext.vehicle import OpenLoopErrors

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


def test_a_derivative_that_raises_only_in_motion_is_the_error_of_its_line(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moving = CODE.replace("    return ", "    if x[3] > 0.3:\n        raise ValueError('too fast')\n    return ")
    (folder / "own.py").write_text(moving, encoding="utf-8")
    assert main(["plan", "turns", "--vehicle", "own.py:CAR"]) == 2
    said = capsys.readouterr().err
    line = 1 + moving[: moving.index("raise")].count("\n")
    assert f"own.py:{line}: ValueError: too fast" in said
    assert "defect" not in said


def test_only_errors_that_the_users_code_has_raised_are_errors_of_that_code(folder: Path) -> None:
    (folder / "own.py").write_text("def half(x):\n    return 1 / x\n", encoding="utf-8")
    module, _ = imported("own.py", "own.py", "")
    with pytest.raises(ZeroDivisionError) as theirs:
        module.half(0)
    found = failure_in_code(theirs.value)
    assert found is not None
    assert [(Path(d.file).name, d.line, d.code) for d in found.diagnostics] == [("own.py", 2, Code.CODE)]
    load_vehicle("mushr")  # is imported by a reference too, from kraft
    with pytest.raises(ValueError, match="math domain error") as ours:
        math.sqrt(-1.0)
    assert failure_in_code(ours.value) is None


def test_the_example_is_about_ten_lines_and_a_vehicle() -> None:
    vehicle = load_vehicle(str(EXAMPLE))
    assert vehicle.name == "skid-steer"
    body = EXAMPLE.read_text().partition("VEHICLE = ")[2].partition("\nif __name__ == ")[0]
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


def test_a_file_of_the_working_directory_does_not_take_the_place_of_an_installed_package(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers of an evaluation import with the path of their parent: a file yaml.py there ended them."""
    (folder / "tabnanny.py").write_text("")
    (folder / "own_car.py").write_text("from kraft.vehicles.mushr import MUSHR as CAR\n")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(folder))])
    assert load_vehicle("own_car:CAR").name == "mushr"
    found = importlib.util.find_spec("tabnanny")  # of the standard library
    assert found is not None
    assert found.origin != str(folder / "tabnanny.py")


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


def test_an_import_that_is_interrupted_is_begun_again(tmp_path: Path) -> None:
    first = "from pathlib import Path\nif not (mark := Path(__file__).with_name('mark')).exists():\n"
    (tmp_path / "car.py").write_text(f"{first}    mark.touch()\n    raise KeyboardInterrupt\nNAME = 'car'\n")
    with pytest.raises(KeyboardInterrupt):
        imported(f"{tmp_path / 'car.py'}", "car.py", "expected a car")
    assert imported(f"{tmp_path / 'car.py'}", "car.py", "expected a car")[0].NAME == "car"


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
        (RETURN, "x[3] * 1j, x[3], u[1], u[0]", "derivative 'motion' returns (complex128, float64, float64, float64)"),
        ("    return", "    import math\n    return", "derivative 'motion' does not compile: Use of unsupported opcode (IMPORT_NAME) found ({path}:6)"),
        ("    return", "    with x as y:\n        pass\n    return", "derivative 'motion' does not compile: The 'with (context manager) as (variable):' construct is not supported"),
        ("    return", "    assert x[3] > 1\n    return", "derivative 'motion' fails at rest: AssertionError"),
        ("@derivative\n", "", "derivative 'motion' is not compiled"),
        (RETURN, "(" + RETURN, "does not import: SyntaxError: '(' was never closed ({file}, line 6)"),
        ("Footprint(0.4, 0.3)", "Footprint(0.0, 0.3)", "does not import: ValueError: footprint sizes must be positive and finite, got Footprint(length=0.0, width=0.3, offset=0.0) at {path}:13"),
        ('"theta", "v")', '"theta")', "does not import: ValueError: vehicle 'car': rest names 'v', which is not a state component at {path}:8"),
        ("top_speed=1.0", "top_speed=1.0, rest=('v', 'v')", "does not import: ValueError: vehicle 'car': rest names a component twice: ('v', 'v') at {path}:8"),
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


def test_a_vehicle_that_is_imported_is_not_one_that_the_file_defines(folder: Path) -> None:
    changed = "from dataclasses import replace\nfrom kraft.vehicles.mushr import MUSHR\n"
    (folder / "changed.py").write_text(changed + "CAR = replace(MUSHR, name='longer')\nSAME = CAR\n")
    assert load_vehicle("changed.py").name == "longer"
    (folder / "imported.py").write_text("from kraft.vehicles.mushr import MUSHR\n")
    assert load_vehicle("imported.py").name == "mushr"


def test_an_attribute_that_cannot_be_read_is_explained(folder: Path) -> None:
    (folder / "lazy.py").write_text("def __getattr__(name):\n    raise RuntimeError('no battery')\n")
    (problem,) = raised(lambda: load_vehicle("lazy.py:CAR"))
    assert (problem.file, problem.code) == ("lazy.py:CAR", Code.CODE)
    assert problem.problem == f"does not import: RuntimeError: no battery at {folder / 'lazy.py'}:2"


def test_parameters_are_checked_also_where_the_kernels_are_in_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for cached in (False, True):
        monkeypatch.setattr("kraft.vehicles.code.is_cached", lambda _, cached=cached: cached)
        monkeypatch.setattr("kraft.vehicles.code.are_steps_cached", lambda _: False)
        found.append(raised(lambda: load_vehicle("kraft.vehicles.benchmark:BENCHMARK", parameters={"wheelbase": 0})))
    assert found[0] == found[1]
    assert [problem.code for problem in found[0]] == [Code.CODE]
    assert "nan" in found[0][0].problem


@pytest.mark.parametrize("name", ["benchmark", "jackal", "mushr-force", "unicycle2"])
def test_a_vehicle_whose_kernels_are_in_the_cache_loads_without_compiling(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_now(_: object) -> None:
        raise AssertionError("compiles a function")

    monkeypatch.setattr("kraft.vehicles.code.is_cached", lambda _: True)
    monkeypatch.setattr("kraft.vehicles.code._problems", compile_now)
    assert load_vehicle(name).name == name


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ("name='my robot'", ["name is the text 'my robot'"]),
        ("delay=(0.6, 0.01)", ["delay.value is the number 0.6"]),
        ("name='a b', delay=(0.6, 0.01)", ["name is the text 'a b'", "delay.value is the number 0.6"]),
        ("footprint=Footprint(0.4, 0.0001)", ["footprint.width is the number 0.0001"]),
    ],
)
def test_what_no_vehicle_file_could_state_is_refused_in_code_too(
    stated: str, expected: list[str], folder: Path
) -> None:
    (folder / "car.py").write_text(CODE + f"from dataclasses import replace\nCAR = replace(CAR, {stated})\n")
    problems = raised(lambda: load_vehicle("car.py:CAR"))
    assert [(each.file, each.code, each.problem) for each in problems] == [
        ("car.py:CAR", Code.CODE, each) for each in expected
    ]
    text = "name: a\nmodel: car.py:CAR\nfootprint: {length: 1, width: 1}\ntop_speed: 1\n"
    (folder / "car.yaml").write_text(text)
    assert load_vehicle("car.yaml").name == "a"  # the file states them


def test_what_is_recorded_of_a_vehicle_in_code_is_checked() -> None:
    vehicle = replace(load_vehicle("jackal"), name="my robot", file="")
    (problem,) = raised(lambda: RecordedVehicle.of(vehicle, RobotTruth()))
    assert (problem.file, problem.code) == ("my robot", Code.CODE)


@pytest.mark.parametrize(
    ("stated", "problem"),
    [
        ("limits={'v': (1, 0)}", "the limits of v need low < high"),
        ("delay=(float('nan'), -1.0)", "delay needs"),
        ("delay=(0.1, 0.0)", "delay needs"),
        ("gravity_share=0.5", "gravity_share needs the parameters a_x and a_y"),
        ("gravity_share=-3.0, parameters={'a_x': 0.0, 'a_y': 0.0}", "gravity_share must be above 0"),
        ("parameters={'tau': float('nan')}", "parameter tau needs a finite number"),
        ("parameters={'tau': 'long'}", "parameter tau needs a finite number"),
    ],
)
def test_numbers_that_a_vehicle_cannot_have_are_refused(stated: str, problem: str, folder: Path) -> None:
    (folder / "car.py").write_text(CODE + f"from dataclasses import replace\nCAR = replace(CAR, {stated})\n")
    (found,) = raised(lambda: load_vehicle("car.py:CAR"))
    assert found.code is Code.CODE
    assert f"vehicle 'car': {problem}" in found.problem


@pytest.mark.parametrize(
    ("stated", "problems"),
    [
        ({"controls": None, "state": "xyv"}, ["state must be a tuple of names, got 'xyv'", "controls must be"]),
        ({"controls": {"a": 1.0, "b": (0, 1, 2)}}, ["control a needs finite bounds", "control b needs finite bounds"]),
        (
            {"parameters": {"a b": 0.3, "L": 0.3, "9": 1.0}},
            ["names of parameters need letters, digits", "got 'a b', '9'"],
        ),
        ({"controls": {"k/g": (0.0, 1.0), 3: (0.0, 1.0)}}, ["names of controls need letters", "first, got 'k/g', 3"]),
        ({"top_speed": "1", "limits": {"v": ("0", 1)}}, ["top_speed must be positive", "the limits of v need"]),
        ({"footprint": (0.4, 0.2), "stop": 3}, ["stop must be a function or None", "footprint must be a Footprint"]),
        ({"parameters": {"tau": 1.0}, "ranges": {"tau": (0, 1, 1)}}, ["the range of tau needs a ParameterRange"]),
        ({"delay": 0.1, "gravity_share": "0.5"}, ["gravity_share must be above 0", "delay needs a value"]),
        ({"errors_by_speed": ((0, 1),), "rest": "v"}, ["rest must be a tuple", "errors_by_speed must be a tuple"]),
    ],
)
def test_values_of_the_wrong_type_are_refused_together(stated: dict[str, object], problems: list[str]) -> None:
    with pytest.raises(ValueError, match="vehicle 'mushr'") as refused:
        replace(MUSHR, **stated)  # type: ignore[arg-type]
    assert all(problem in str(refused.value) for problem in problems)


@pytest.mark.parametrize(
    ("errors", "problem"),
    [
        (((0.0, 1.0), (), (), (), ()), "after needs positive times"),
        (((0.0, 1.0), (2.0, 1.0), (0.1, 0.1), (0.1, 0.1), (0.1, 0.1)), "after needs positive times"),
        (((0.0, 1.0), (1.0,), (0.1, 0.1), (0.1,), (0.1,)), "along needs"),
        (((0.0, 1.0), (1.0,), (0.1,), (-0.1,), (0.1,)), "across needs"),
        (((0.0, 1.0), (1.0,), (0.1,), (0.1,), (np.nan,)), "yaw needs"),
        (((1.0, 0.0), (1.0,), (0.1,), (0.1,), (0.1,)), "speeds need"),
        ((1.0, 1.0, 0.1, 0.1, 0.1), "speeds need"),
    ],
)
def test_errors_of_prediction_that_are_none_are_refused(errors: tuple[Any, ...], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        OpenLoopErrors(*errors)


def test_lists_and_arrays_are_taken_where_tuples_are_stated() -> None:
    errors = OpenLoopErrors([0, 1], np.array([1.0, 2.0]), [0, 0], [0, 0], [0, 0])  # type: ignore[arg-type]
    assert errors == OpenLoopErrors((0.0, 1.0), (1.0, 2.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    names = {kind: list(getattr(MUSHR, kind)) for kind in ("state", "inputs", "manoeuvres", "rest")}
    assert replace(MUSHR, **names, errors_by_speed=[]) == MUSHR  # type: ignore[arg-type]


def test_numbers_of_any_numeric_type_are_parameters() -> None:
    stated = {"a_x": np.float32(0.5), "a_y": 1}
    vehicle = replace(load_vehicle("mushr-drive"), parameters=stated, ranges={}, gravity_share=1, delay=(0, 0.1))
    assert vehicle.parameter_array.tolist() == [0.5, 1.0]


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
