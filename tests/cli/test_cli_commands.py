"""`kraft validate`, `kraft list` and `kraft doctor`."""

from __future__ import annotations

import json
import os
import pickle
import re
import subprocess
import sys
import tomllib
from collections import OrderedDict
from pathlib import Path

import pytest
from support.evaluation import places
from support.paths import ROOT

from kraft.config import bundled
from kraft.provenance import install_command
from kraft.scenario.planners import PLANNERS
from kraft_cli.main import main
from kraft_cli.work import doctor as environment
from kraft_cli.work.doctor import REQUIRED, Finding
from ompl_ext.cache_error import CacheError
from ompl_ext.kernel_cache import cache_folder
from ompl_ext.vehicle import Vehicle

GOOD = """name: x
bounds: {x: [0, 4], y: [0, 4]}
start: {x: 1, y: 1, heading_deg: 0}
goal: {center: [3, 3], radius: 1}
"""


@pytest.fixture
def files(folder: Path) -> Path:
    (folder / "good.yaml").write_text(GOOD)
    (folder / "bad.yaml").write_text(GOOD.replace("radius: 1", "radius: 0") + "colour: red\n")
    (folder / "car.yaml").write_text("name: car\nmodel: x\nfootprint: {length: 1, width: 1}\ntop_speed: 1\n")
    return folder


def test_valid_files_are_said_to_be_what_they_are(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "good.yaml", str(bundled.folder("vehicle") / "mushr.yaml")]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == "good.yaml: valid scenario"
    assert out.splitlines()[1].endswith("mushr.yaml: valid vehicle")
    assert err == ""


def test_validation_says_that_a_camera_does_not_see_the_start(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "far.yaml").write_text(GOOD + "sensing: {preset: rendered, camera: [1, 1, 90]}\n")
    assert main(["validate", "far.yaml"]) == 2
    assert "sensing.camera: sees the marker at the start with a side of " in capsys.readouterr().err


def test_validation_of_a_scenario_compiles_the_maps_kernels_alone_and_says_so(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def planner(vehicle: Vehicle) -> None:
        raise AssertionError(f"the planner is compiled for {vehicle.name}")

    monkeypatch.setattr("ompl_ext.motion.model_step", planner)
    monkeypatch.setattr("kraft.planning.compilation.model_step", planner)
    monkeypatch.setattr("kraft.planning.shared_kernels._marker", lambda name: files / name)
    monkeypatch.setattr("kraft.planning.shared_kernels.search", lambda: planner)
    assert main(["validate", "good.yaml"]) == 0
    out, err = capsys.readouterr()
    assert out == "good.yaml: valid scenario\n"
    assert err.startswith("compiling the maps for this machine, once: ")


def test_validation_of_a_goal_with_limits_compiles_the_model_but_not_the_search(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def search() -> None:
        raise AssertionError("the search is compiled")

    monkeypatch.setattr("ompl_ext.kernels.specialise.search", search)
    monkeypatch.setattr("ompl_ext.kernels.specialise._kernels", {})
    monkeypatch.setattr("ompl_ext.motion._cache", OrderedDict())
    monkeypatch.setattr("kraft.planning.compilation.is_model_cached", lambda _: False)
    (files / "stop.yaml").write_text(GOOD.replace("goal: {", "goal: {limits: {v: [0, 0.1]}, "))
    assert main(["validate", "stop.yaml"]) == 0
    out, err = capsys.readouterr()
    assert out == "stop.yaml: valid scenario\n"
    assert err.startswith("compiling the model of mushr for this machine, once: ")


def test_a_file_of_another_kind_is_said_to_be_one(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "yard.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (files / "named.yaml").write_text(GOOD + "vehicle: yard.png\n")
    expected = "expected the path of a .yaml file or the name of a"
    for arguments, message in (
        (["validate", "yard.png"], "yard.png: is no file that can be checked; expected the .yaml file of a scenario, "),
        (["plan", "yard.png"], f"yard.png: is no scenario file; {expected} scenario"),
        (["plan", "turns", "--vehicle", "yard.png"], f"yard.png: 'yard.png' is no vehicle file; {expected} vehicle"),
        (["validate", "named.yaml"], f"named.yaml:5:10: vehicle: 'yard.png' is no vehicle file; {expected} vehicle"),
    ):
        assert main(arguments) == 2
        assert capsys.readouterr().err.startswith(message)


def test_the_car_of_a_vehicle_file_is_checked_beside_its_other_keys(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "name: m\nmodel: kraft.vehicles.mushr:MUSHR\nparameters: {L: {value: 0.3}}\n"
    text += "footprint: {length: 0.4, width: 0.3}\ntop_speed: 1\ntruth: {car: {track: 0.03}}\n"
    (files / "m.yaml").write_text(text)
    assert main(["validate", "m.yaml"]) == 2
    assert places(capsys.readouterr().err)[:2] == ["m.yaml:3:14", "m.yaml:6:14"]


def test_a_valid_file_whose_true_robot_reaches_beyond_the_footprint_is_warned_of(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (bundled.folder("vehicle") / "mushr.yaml").read_text()
    (files / "wide.yaml").write_text(text + "truth: {car: {length: 0.7, width: 0.5}}\n")
    jackal = (bundled.folder("vehicle") / "jackal.yaml").read_text()
    (files / "small.yaml").write_text(jackal.replace("length: 0.51, width: 0.43", "length: 0.3, width: 0.3"))
    (files / "jackal.xml").write_bytes((bundled.folder("vehicle") / "jackal.xml").read_bytes())
    (files / "scene.yaml").write_text(GOOD + "truth: {car: {length: 0.8}}\n")
    assert main(["validate", "wide.yaml", "small.yaml", "scene.yaml"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == ["wide.yaml: valid vehicle", "small.yaml: valid vehicle", "scene.yaml: valid scenario"]
    warnings = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert [line.split(" is not covered")[0].removeprefix("warning: ") for line in warnings] == [
        "wide.yaml: the true robot (0.7 m x 0.5 m)",
        "small.yaml: the true robot (0.51 m x 0.43 m)",
        "scene.yaml: the true robot (0.8 m x 0.271 m)",
    ]


def test_every_bundled_file_is_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", *bundled.names("scenario"), *bundled.names("vehicle")]) == 0
    assert capsys.readouterr().err == ""


def test_all_problems_of_all_files_are_shown(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "bad.yaml", "good.yaml", "car.yaml", "none.yaml"]) == 2
    out, err = capsys.readouterr()
    assert out == "good.yaml: valid scenario\n"
    assert [line.split(": ")[0] for line in err.splitlines()] == [
        "bad.yaml:4:32",
        "bad.yaml:5:1",
        "car.yaml:2:8",
        "none.yaml",
        "4 problems in 3 files",
    ]


@pytest.mark.parametrize(
    ("argv", "status", "message"),
    [
        (["validate", "bad.yaml", "-q"], 2, "bad.yaml:4:32: goal.radius: is the number 0; expected a number of at least 0.001 (distance from the centre that counts as arrived, m)\nbad.yaml:5:1: colour: unknown key; expected one of name, description, bounds, obstacles, start, goal, vehicle, planning, truth, sensing, trial\n"),
        (["plan", "turnz"], 2, "turnz: there is no scenario of this name; did you mean 'turns'? (or the path of a .yaml file)\n"),
        (["plan", "turns", "--iterations", "0"], 2, "--iterations: is the number 0; expected a number of at least 1 (planning budget in iterations, repeatable; 20000 unless `time` is given)\n"),
        (["plan", "turns.yaml"], 2, "turns.yaml: there is no such file; expected the path of a .yaml file (there is a bundled scenario 'turns')\n"),
        (["plan", "good.yml"], 2, "good.yml: there is no such file; did you mean 'good.yaml'?\n"),
        (["list", "vehicle"], 2, "vehicle: cannot be listed; did you mean 'vehicles'?\n"),
        (["lst"], 2, "error: No such command 'lst'; did you mean 'list'?\ntry 'kraft --help'\n"),
        (["plan", "--json", "turnz", "--after", "1"], 2, "--after: is given without --from; expected --from PLAN too\nturnz: there is no scenario of this name; did you mean 'turns'? (or the path of a .yaml file)\n"),
        (["plan", "turns", "--set"], 2, "error: Option '--set' requires an argument.\ntry 'kraft plan --help'\n"),
        (["eval", "turns", "--method", "kraft"], 2, "error: No such option: --method; did you mean '--methods'?\ntry 'kraft eval --help'\n"),
        (["run", "turns", "--metod", "kraft"], 2, "error: No such option: --metod; did you mean '--method'?\ntry 'kraft run --help'\n"),
        (["plan", "turns", "--iter", "3"], 2, "error: No such option: --iter; did you mean '--iterations'?\ntry 'kraft plan --help'\n"),
        (["run", "turns", "--json=1"], 2, "error: Option '--json' does not take a value.\ntry 'kraft run --help'\n"),
        (["--jsn-all", "plan"], 2, "error: No such option: --jsn-all\ntry 'kraft --help'\n"),
        (["--json", "plan", "turns"], 2, "error: No such option before the command: --json; expected it after, as in 'kraft COMMAND --json'\ntry 'kraft --help'\n"),
        (["plan", "folder"], 2, "folder: is a folder; expected the path of a .yaml file or the name of a scenario\n"),
        (["plan", "folder.yaml"], 2, "folder.yaml: is a folder; expected the path of a .yaml file or the name of a scenario\n"),
        (["eval", "--suite", "good.yaml"], 2, "good.yaml:1:1: none of the keys is known; expected the keys name, description, entries\n"),
        (["eval", "turns", "--vary", "goal.radius"], 2, "--vary: is 'goal.radius'; expected KEY=V1,V2, as in sensing.noise_scale=0,1,2\n"),
        (["plan", "wall.yaml"], 1, "error: the goal is unreachable: no path from the start is wide enough for the footprint\n"),
    ],
)  # fmt: skip
def test_messages_read_like_this(
    argv: list[str], status: int, message: str, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The golden messages of the command line; all other tests compare places and codes."""
    wall = "obstacles: [{box: {center: [2, 2], size: [0.2, 4]}}]\n"
    (files / "wall.yaml").write_text(GOOD + wall)
    for name in ("folder", "folder.yaml"):
        (files / name).mkdir()
    assert main(argv) == status
    assert capsys.readouterr().err == message


def test_quiet_leaves_only_the_problems(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "-q", "bad.yaml"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_the_vehicle_of_a_method_is_checked_beside_its_other_keys(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planner = "planner: {mode: replanning, margin: -1, vehicle: musrh}\n"
    (files / "m.yaml").write_text(f"name: m\ntitle: M\n{planner}controller: {{kind: kinodynamic}}\n")
    assert main(["validate", "m.yaml"]) == 2
    assert places(capsys.readouterr().err) == ["m.yaml:3:37", "m.yaml:3:50", "2 problems in 1 file"]


def test_a_vehicle_in_code_is_checked_as_a_file_is(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = f"{ROOT}/examples/05_vehicle.py"
    assert main(["validate", example, "kraft.vehicles.mushr:MUSHR"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{example}: valid vehicle",
        "kraft.vehicles.mushr:MUSHR: valid vehicle",
    ]
    (files / "empty.py").write_text("CAR = 1\n")
    assert main(["validate", "empty.py", "empty.py:CAR", "none.py:CAR"]) == 2
    assert [line.split("; ")[0] for line in capsys.readouterr().err.splitlines()] == [
        "empty.py: defines no Vehicle",
        "empty.py:CAR: CAR is of type int, not a Vehicle",
        f"none.py:CAR: there is no file {files / 'none.py'}",
        "3 problems in 3 files",
    ]


def test_the_class_of_a_controller_is_checked_in_its_method_file(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (files / "own.py").write_text("class Own:\n    def command(self): ...\n\n\nclass Other:\n    pass\n")
    assert main(["validate", "own.py:Own", "own.py:Other", "own.py"]) == 2
    assert capsys.readouterr().err.splitlines()[:3] == [
        "own.py:Own: is the class of a controller; expected the method file that names it, or a vehicle",
        "own.py:Other: Other is a class, not a Vehicle; expected an ompl_ext.vehicle.Vehicle",
        "own.py: defines no Vehicle; expected a module-level ompl_ext.vehicle.Vehicle",
    ]


def test_validate_prints_one_json_object(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--json", "good.yaml", "bad.yaml"]) == 2
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert err == ""
    assert content["schema"] == "kraft.validate/1"
    assert [(f["file"], f["kind"], f["valid"]) for f in content["files"]] == [
        ("good.yaml", "scenario", True),
        ("bad.yaml", "scenario", False),
    ]
    problems = content["files"][1]["problems"]
    assert [(p["line"], p["column"], p["path"], p["code"]) for p in problems] == [
        (4, 32, "goal.radius", "value"),
        (5, 1, "colour", "unknown"),
    ]
    assert set(problems[0]) == {"file", "line", "column", "path", "code", "problem", "expected"}


@pytest.mark.parametrize("size", ["1e-308", "1e-9", "0.0009"])
def test_a_length_below_a_millimetre_is_refused(size: str, files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "tiny.yaml").write_text(GOOD + f"obstacles: [{{box: {{center: [2, 1], size: [{size}, 1]}}}}]\n")
    for command in ("validate", "plan"):
        assert main([command, "tiny.yaml"]) == 2
        assert capsys.readouterr().err.startswith("tiny.yaml:5:43: obstacles[0].box.size[0]: ")


def test_a_defect_in_the_check_of_one_file_leaves_the_others_checked(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("kraft_cli.work.validate.check_placement", broken)
    vehicle = str(bundled.folder("vehicle") / "mushr.yaml")
    assert main(["validate", "good.yaml", "bad.yaml", vehicle]) == 70
    out, err = capsys.readouterr()
    assert out == f"{vehicle}: valid vehicle\n"
    assert "bad.yaml:4:32: goal.radius: " in err
    assert "good.yaml: cannot be checked" in err
    assert "ZeroDivisionError" in err
    assert main(["validate", "--json", "good.yaml", "bad.yaml", vehicle]) == 70
    files = json.loads(capsys.readouterr().out)["files"]
    assert [(f["valid"], bool(f["problems"]), f["defect"]) for f in files] == [
        (False, False, "ZeroDivisionError: division by zero"),
        (False, True, None),
        (True, False, None),
    ]


@pytest.mark.parametrize("what", ["scenarios", "vehicles", "planners"])
def test_lists_name_and_describe_what_there_is(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", what]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert main(["list", what, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["schema"], content["kind"]) == ("kraft.list/1", what)
    assert all(item["description"] for item in content["items"])
    assert [line.split()[0] for line in lines[1:]] == [item["name"] for item in content["items"]]


def test_methods_are_what_the_folder_holds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "methods", "--json"]) == 0
    items = json.loads(capsys.readouterr().out)["items"]
    assert tuple(item["name"] for item in items) == bundled.names("method")


def test_the_planners_listed_are_those_a_scenario_may_name() -> None:
    from typing import get_args

    from kraft.scenario.planning import Planning

    assert get_args(Planning.model_fields["planner"].annotation) == tuple(PLANNERS)


def test_every_mistake_of_a_vehicle_file_comes_at_once(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "configs/vehicles/mushr.yaml").read_text()
    text = re.sub(r"L: \{value: [\d.]+", "L: {value: 9", text).replace("{length:", "{lenght:")
    (files / "car.yaml").write_text(text.replace("top_speed: v_delta", "top_speed: vdelta"))
    assert main(["validate", "car.yaml"]) == 2
    *problems, _ = capsys.readouterr().err.splitlines()
    keys = ["parameters.L.value", "footprint.lenght", "top_speed"]
    assert [line.split(": ")[1] for line in problems] == keys


def test_plan_files_are_checked_as_such_and_other_files_of_kraft_are_named(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "turns", "--iterations", "3000", "--out", "plans"]) == 0
    capsys.readouterr()
    assert main(["validate", "plans/plan.json"]) == 0
    assert capsys.readouterr().out == "plans/plan.json: valid plan\n"
    content = json.loads((files / "plans/plan.json").read_text())
    (files / "bad.json").write_text(json.dumps({**content, "durations": "long"}))
    assert main(["validate", "bad.json"]) == 2
    assert re.match(r"bad\.json:1:\d+: durations: ", capsys.readouterr().err)
    (files / "manifest.json").write_text(json.dumps({"schema": "kraft.eval-manifest/1", "trials": 3}))
    assert main(["validate", "manifest.json"]) == 2
    assert capsys.readouterr().err.startswith("manifest.json:1:12: schema: ")


def test_the_doctor_looks_at_every_required_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {re.split(r"[<>=!~\[; ]", requirement)[0] for requirement in project["dependencies"]}
    assert named == set(REQUIRED)
    assert "pytest" not in named, "only tests need it"


def test_identification_does_not_load_what_only_tests_need() -> None:
    loads = "import sys; sys.modules['pytest'] = None; import gtsam, kraft.sysid.factor_graph"
    subprocess.run([sys.executable, "-c", loads], check=True, cwd=ROOT)


def test_the_doctor_looks_at_the_packages_of_every_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = [(extra, each) for extra, each_of in extras.items() if extra != "dev" for each in each_of]
    extra_of = {re.split(r"[\[<>=; ]", each)[0]: extra for extra, each in named}
    assert extra_of == {name: extra for name, (_, extra, _) in environment.OPTIONAL.items()}


def test_the_doctor_names_the_extra_of_a_missing_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    monkeypatch.setattr(environment, "examine", lambda: [environment._extra("casadi", *environment.OPTIONAL["casadi"])])
    assert main(["doctor"]) == 0
    assert f"extra mpc: {install_command('mpc')}" in " ".join(capsys.readouterr().out.split())


def test_the_doctor_ends_with_3_when_something_required_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = [Finding("python", "ok", "3.12"), Finding("gtsam", "missing", "No module named 'gtsam'")]
    monkeypatch.setattr(environment, "examine", lambda: findings)
    assert main(["doctor"]) == 3
    out, err = capsys.readouterr()
    assert "No module named 'gtsam'" in out
    assert err == "error: missing: gtsam\n"
    assert main(["doctor", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["ok"] is False


def test_the_doctor_is_content_without_what_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "examine", lambda: [Finding("ray", "note", "not installed")])
    assert main(["doctor"]) == 0


def test_a_package_that_does_not_load_is_missing_with_the_reason() -> None:
    finding = environment._package("nothing", "there_is_no_such_module")
    assert finding == Finding("nothing", "missing", "No module named 'there_is_no_such_module'")


def test_an_extra_that_installs_nothing_elsewhere_says_where_it_does() -> None:
    finding = environment._extra("nothing", "there_is_no_such_module", *environment.OPTIONAL["dynobench"][1:])
    assert finding.state == "note"
    assert "(Python 3.11 on x86-64 alone)" in finding.detail


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_the_doctor_tries_whether_the_cache_can_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("KRAFT_CACHE_DIR", "/proc/c")
    finding = environment._cache()
    assert (finding.subject, finding.state) == ("kernel cache", "missing")
    assert "KRAFT_CACHE_DIR" in finding.detail
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(tmp_path / "new"))
    assert environment._cache().state == "ok"
    assert list(tmp_path.iterdir()) == []


def test_the_doctor_refuses_a_cache_that_another_user_has_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def of_another_user(_: Path) -> None:
        raise CacheError(tmp_path, "belongs to another user", "expected another folder")

    monkeypatch.setattr("ompl_ext.kernel_cache.check_owner", of_another_user)
    assert environment._cache().state == "missing"


def test_the_doctor_reads_the_files_of_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(tmp_path))
    file = cache_folder() / "tree-1.py311.nbi"
    file.parent.mkdir(parents=True)
    file.write_bytes(pickle.dumps("0.68") + pickle.dumps({}))
    assert environment._cache() == Finding("kernel cache", "ok", f"{tmp_path}, 1 file")
    file.write_bytes(b"")
    found = environment._cache()
    assert found.state == "missing"
    assert f"{file.parents[1]}: the kernel cache has damaged files: {file.name}" in found.detail


def test_the_doctor_names_old_kernels_and_removes_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KRAFT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(environment, "examine", environment._old_kernels)
    assert environment._old_kernels() == []
    old = cache_folder().parents[1] / f"{'a' * 16}-{'0' * 8}"
    old.mkdir(parents=True)
    assert environment._old_kernels()[0].state == "ok"
    os.utime(old, (0.0, 0.0))
    (finding,) = environment._old_kernels()
    assert (finding.state, "kraft doctor --remove-kernels 30" in finding.detail) == ("note", True)
    assert main(["doctor", "--remove-kernels", "30"]) == 0
    assert "removed 1 folder (0 MB) unused for 30 days" in capsys.readouterr().err
    assert not old.exists()
    assert main(["doctor", "--remove-kernels", "0"]) == 2
    assert "--remove-kernels: is 0; expected a number of at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("backend", ["foo", "glfw"])
def test_the_doctor_finds_a_way_to_draw_that_draws_nothing(backend: str) -> None:
    hidden = {name: text for name, text in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-m", "kraft_cli", "doctor", "--json"],
        cwd=ROOT, env={**hidden, "MUJOCO_GL": backend}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    found = {each["subject"]: each for each in json.loads(done.stdout)["findings"]}
    assert found["rendering"]["state"] == "note"
    assert f"MUJOCO_GL={backend} cannot draw here, unset it" in found["rendering"]["detail"]
    assert found["mujoco"]["state"] == ("missing" if backend == "foo" else "ok")
    assert "defect" not in done.stderr


def test_a_simulator_that_does_not_load_is_a_missing_dependency() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "kraft_cli", "run", "turns"],
        cwd=ROOT, env={**os.environ, "MUJOCO_GL": "foo"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert "MUJOCO_GL" in done.stderr


@pytest.mark.parametrize("command", ["drive", "world"])
def test_a_seed_is_not_said_to_repeat_what_depends_on_the_clock(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    text = " ".join(re.sub("[│╭╰─]", " ", capsys.readouterr().out).split())
    assert "the same trial" not in text
    assert ("Model to plan with" in text) == (command == "drive")  # the world does not plan
