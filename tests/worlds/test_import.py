"""Worlds from elsewhere become scenarios; what cannot be read is refused at its line."""

from __future__ import annotations

import gzip
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from kraft.errors import Code, InputError, Unreachable
from kraft.evaluation.suite import load_suite
from kraft.scenario import Box, Circle, Polygon, Task, load_scenario
from kraft.worlds.dynobench import OTHERS
from kraft.worlds.imports import Collection, Request, read_sources, write_imported
from kraft_cli.main import main
from ompl_ext.vehicle import Vehicle

CYLINDER = "<cylinder><radius>0.1</radius><length>1</length></cylinder>"


def model(name: str, shape: str, pose: str = "0 0 0 0 0 0", inner: str = "") -> str:
    return (
        f"<model name='{name}'><pose>{pose}</pose><link name='link'>{inner}<collision name='c'>\n"
        f"<geometry>{shape}</geometry></collision></link></model>\n"
    )


GROUND = model("ground", "<plane><normal>0 0.0 1.00</normal><size>9 9</size></plane>")


def sdf(*models: str, state: str = "") -> str:
    return f"<sdf version='1.6'>\n<world name='default'>\n{GROUND}{''.join(models)}{state}</world></sdf>\n"


def import_worlds(request: Request) -> Collection:
    return write_imported(request, read_sources(request))


def imported(tmp_path: Path, text: str, kind: str = "barn", name: str = "world_7.world", **settings: object) -> Path:
    source = tmp_path / name
    source.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    import_worlds(Request(kind, (source,), tmp_path / "out", **{"vehicle": "mushr", **settings}))  # type: ignore[arg-type]
    return tmp_path / "out"


def problems(tmp_path: Path, text: str, **settings: object) -> list[tuple[Code, str | None, int | None, int | None]]:
    with pytest.raises((InputError, Unreachable)) as caught:
        imported(tmp_path, text, **settings)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
    return [(d.code, Path(d.file).name, d.line, d.column) for d in caught.value.diagnostics]


def test_cylinders_boxes_and_spheres_keep_their_places(tmp_path: Path) -> None:
    half_turn = f"0 0 0 0 0 {math.pi / 2}"
    out = imported(
        tmp_path,
        sdf(
            model("post", CYLINDER, "1 2 0.5 0 0 0"),
            model("wall", "<box><size>2 0.2 1</size></box>", "1 6 0 0 0 0.5", "<pose>1 0 0 0 0 0.25</pose>"),
            model("ball", "<sphere><radius>0.3</radius></sphere>", half_turn, "<pose>2 0 0.1 0 0 0</pose>"),
            model("cellar", CYLINDER, "0 0 -3 0 0 0"),
        ),
    )
    post, wall, ball = load_scenario(out / "barn-7.yaml").obstacles
    assert post == Circle((1.0, 2.0), 0.1, 1.0, "post")
    assert isinstance(wall, Box)
    assert wall.center == pytest.approx((1 + math.cos(0.5), 6 + math.sin(0.5)))
    assert (wall.size, wall.yaw) == ((2.0, 0.2), pytest.approx(0.75))
    assert isinstance(ball, Circle)
    assert (*ball.center, ball.radius, ball.height) == pytest.approx((0.0, 2.0, 0.3, 0.4))


def test_the_state_of_a_saved_world_moves_models_and_links(tmp_path: Path) -> None:
    box = "<box><size>2 0.2 1</size></box>"
    leg = model("leg", CYLINDER, "1 0 0 0 0 0")
    state = (
        "<state world_name='default'>"
        "<model name='wall'><pose>3 4 0 0 0 0.5</pose><scale>1 1 1</scale></model>"
        "<model name='door'><pose>1 6 0 0 0 0</pose><link name='link'><pose>1 7 0 0 0 0.25</pose></link></model>"
        "<model name='table'><pose>5 5 0 0 0 0</pose><model name='leg'><pose>6 5.5 0 0 0 0</pose></model></model>"
        "<model name='gone'><pose>0 0 0 0 0 0</pose></model></state>"
    )
    models = (
        model("wall", box, "1 6 0 0 0 0"),
        model("door", box, "1 6 0 0 0 0"),
        f"<model name='table'><pose>2 2 0 0 0 0</pose>{leg}</model>",
        model("post", CYLINDER, "1 8 0 0 0 0"),
    )
    out = imported(tmp_path, sdf(*models, state=state))
    wall, door, leg_at, post = load_scenario(out / "barn-7.yaml").obstacles
    assert isinstance(wall, Box)
    assert isinstance(door, Box)
    assert (wall.center, wall.yaw) == (pytest.approx((3.0, 4.0)), pytest.approx(0.5))
    assert (door.center, door.yaw) == (pytest.approx((1.0, 7.0)), pytest.approx(0.25))
    assert isinstance(leg_at, Circle)
    assert isinstance(post, Circle)
    assert (leg_at.center, post.center) == (pytest.approx((6.0, 5.5)), pytest.approx((1.0, 8.0)))


@pytest.mark.parametrize(
    ("state", "code"),
    [
        ("<model name='post'>\n<scale>2 1 1</scale></model>", Code.VALUE),
        ("\n<insertions><model name='more'/></insertions>", Code.UNKNOWN),
        ("\n<deletions><name>post</name></deletions>", Code.UNKNOWN),
    ],
)
def test_a_state_that_scales_or_adds_or_deletes_models_is_refused(tmp_path: Path, state: str, code: Code) -> None:
    text = sdf(model("post", CYLINDER), state=f"<state world_name='default'>{state}</state>")
    assert problems(tmp_path, text, skip=True) == [(code, "world_7.world", 8, 1)]


def test_a_pose_may_be_relative_to_its_parent_by_name(tmp_path: Path) -> None:
    post = (
        "<model name='post'><pose relative_to='world'>1 6 0 0 0 0</pose><link name='leg'>"
        "<pose relative_to='__model__'>0.5 0 0 0 0 0</pose><collision name='c'>"
        f"<pose relative_to='leg'>0 0.25 0 0 0 0</pose><geometry>{CYLINDER}</geometry></collision></link></model>"
    )
    (found,) = load_scenario(imported(tmp_path, sdf(post)) / "barn-7.yaml").obstacles
    assert isinstance(found, Circle)
    assert found.center == pytest.approx((1.5, 6.25))


def test_angles_may_be_in_degrees(tmp_path: Path) -> None:
    text = sdf(model("wall", "<box><size>2 0.2 1</size></box>", "1 6 0 0 0 90"))
    out = imported(tmp_path, text.replace("<pose>1 6", "<pose degrees='true'>1 6"))
    (wall,) = load_scenario(out / "barn-7.yaml").obstacles
    assert isinstance(wall, Box)
    assert wall.yaw == pytest.approx(math.pi / 2)


def test_compressed_worlds_of_a_folder_make_a_suite_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "worlds"
    folder.mkdir()
    for number in (10, 9):
        (folder / f"world_{number}.world.gz").write_bytes(gzip.compress(sdf(model("post", CYLINDER)).encode()))
    import_worlds(Request("barn", (folder,), tmp_path / "out"))
    entries = load_suite(tmp_path / "out" / "suite.yaml")
    assert [entry.name for entry in entries] == ["barn-9", "barn-10"]
    assert all(entry.scenario.goal.radius == 1.0 and entry.scenario.vehicle.endswith("jackal") for entry in entries)


def test_the_optimal_time_is_that_of_the_path_beside_the_world_at_two_metres_a_second(tmp_path: Path) -> None:
    np.save(tmp_path / "path_7.npy", np.array([[15, 0], [15, 20]]))
    out = imported(tmp_path, sdf(model("post", CYLINDER)))
    score = load_scenario(out / "barn-7.yaml").trial.score
    assert score is not None
    x = 15 * 0.15 - 4.575
    length = math.hypot(-2.25 - x, 5.075 - 3) + 3.0 + math.hypot(-2.25 - x, 13 - 8.075)
    assert score.optimal_time == pytest.approx(length / 2, abs=1e-5)
    assert (score.label, score.of(None)) == ("BARN layouts, known map", 0.0)
    times = [score.optimal_time * factor for factor in (1, 2, 4, 8, 20)]
    assert [score.of(time) for time in times] == pytest.approx([0.5, 0.5, 0.25, 0.125, 0.125])


def test_other_starts_and_goals_are_taken_and_have_no_score(tmp_path: Path) -> None:
    np.save(tmp_path / "path_7.npy", np.array([[15, 0], [15, 20]]))
    scene = load_scenario(imported(tmp_path, sdf(model("post", CYLINDER)), start=(1.0, 1.0, 90.0)) / "barn-7.yaml")
    assert (scene.start.x, scene.start.y, scene.trial.score) == (1.0, 1.0, None)


@pytest.mark.parametrize(
    ("text", "code", "line"),
    [
        ("<sdf><world>", Code.SYNTAX, 1),
        ("<robot/>", Code.MISMATCH, 1),
        ("<sdf>\n<world/></sdf>", Code.MISMATCH, 2),
        (sdf(model("post", CYLINDER)).replace("</sdf>", "\n<world name='more'/></sdf>"), Code.DUPLICATE, 8),
        ("<sdf><world>\n" + "<model>" * 3000 + "</model>" * 3000 + "</world></sdf>", Code.SYNTAX, 2),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><sdf/>", Code.SYNTAX, 1),
        (sdf(model("post", "<cylinder><length>1</length></cylinder>")), Code.MISSING, 6),
        (sdf(model("post", "<cylinder><radius>-1</radius><length>1</length></cylinder>")), Code.VALUE, 6),
        (sdf(model("post", CYLINDER, "0 0 zero 0 0 0")), Code.VALUE, 5),
        (sdf(model("post", CYLINDER).replace("<pose>", "<pose relative_to='map'>")), Code.UNKNOWN, 5),
        (
            sdf("<model name='post'><pose relative_to='dock'/>" + model("", CYLINDER).partition("</pose>")[2]),
            Code.UNKNOWN,
            5,
        ),
        (sdf("<model placement_frame='x' " + model("post", CYLINDER)[7:]), Code.UNKNOWN, 5),
        (sdf(model("post", CYLINDER).replace("<pose>", "<pose rotation_format='quat_xyzw'>")), Code.UNKNOWN, 5),
        (sdf(model("post", CYLINDER, "-2.25 3 0 0 0 0")), Code.GEOMETRY, 2),
    ],
)
def test_a_world_that_cannot_be_read_is_refused_at_its_line(tmp_path: Path, text: str, code: Code, line: int) -> None:
    found = problems(tmp_path, text)
    assert [each[:3] for each in found] == [(code, "world_7.world", line)]
    assert all(each[3] is not None for each in found)


def test_unknown_shapes_are_counted_refused_and_left_out_on_request(tmp_path: Path) -> None:
    mesh, lying = "<mesh><uri>a.dae</uri></mesh>", model("lying", CYLINDER, "0 0 0 1.57 0 0")
    text = sdf(model("a", mesh), model("b", mesh), lying, model("post", CYLINDER), "<include><uri>x</uri></include>")
    found = problems(tmp_path, text)
    assert [(code, line) for code, _, line, _ in found] == [(Code.UNKNOWN, 6), (Code.UNKNOWN, 10), (Code.UNKNOWN, 13)]
    out = imported(tmp_path, text, skip=True)
    assert [obstacle.name for obstacle in load_scenario(out / "barn-7.yaml").obstacles] == ["post"]


def test_what_the_checks_need_is_compiled_with_a_word_and_every_checked_world_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(task: Task, vehicle: Vehicle, report: Callable[[str], None]) -> None:
        report(f"compiling for {task.name} and {vehicle.name}")

    for number in (7, 8):
        (tmp_path / f"world_{number}.world").write_text(sdf(model("post", CYLINDER)), encoding="utf-8")
    monkeypatch.setattr("kraft.worlds.world.ensure_checks_compiled", compiled)
    assert main(["import", "barn", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "no score" not in line]
    assert said == [
        "compiling for barn-7 and jackal",
        "world 1 of 2: barn-7",
        "compiling for barn-8 and jackal",
        "world 2 of 2: barn-8",
    ]


def test_bounds_around_an_obstacle_too_far_away_are_a_problem_of_the_world(tmp_path: Path) -> None:
    found = problems(tmp_path, sdf(model("post", CYLINDER, "1e9 5 0 0 0 0")))
    assert {file for _, file, _, _ in found} == {"world_7.world"}


@pytest.mark.parametrize("content", [b"", b"0 0\n0 1\n", b"PK\x03\x04"])
def test_a_path_that_is_no_file_of_numpy_is_refused_without_advice_to_load_code(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "path_7.npy").write_bytes(content)
    with pytest.raises(InputError) as caught:
        imported(tmp_path, sdf(model("post", CYLINDER)))
    assert [(d.code, Path(d.file).name) for d in caught.value.diagnostics] == [(Code.SYNTAX, "path_7.npy")]
    assert "pickle" not in str(caught.value)


def test_an_enclosed_goal_is_a_negative_result_at_the_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ring = [
        model(f"p{k}", CYLINDER, f"{2 * math.cos(k / 8) - 2.25} {2 * math.sin(k / 8) + 13} 0 0 0 0") for k in range(51)
    ]
    assert problems(tmp_path, sdf(*ring)) == [(Code.GEOMETRY, "world_7.world", 2, 1)]
    assert main(["import", "barn", str(tmp_path / "world_7.world"), "--out", str(tmp_path / "out")]) == 1
    assert "world_7.world:2:1: goal" in capsys.readouterr().err


PROBLEM = """name: test
environment:
  min: [0, 0]
  max: [6, 6]
  obstacles:
    - {type: box, center: [3, 3], size: [1.0, 0.5]}
    - {type: sphere, center: [1, 5], size: [0.3]}
robots:
  - type: unicycle1_v0
    start: [1, 1, 0]
    goal: [5, 5, 1.5]
"""


@pytest.mark.parametrize("robot", ["car1_v0", "integrator2_2d_v0", "quad2d_v0", "unicycle9"])
def test_a_robot_that_is_no_vehicle_of_kraft_is_refused_at_its_line_and_says_why(
    tmp_path: Path, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "problem.yaml"
    source.write_text(PROBLEM.replace("unicycle1_v0", robot))
    assert main(["import", "dynobench", str(source), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "problem.yaml:9:11" in said
    assert f"{robot} {OTHERS.get(robot, 'is not known')}" in said
    given = main(["import", "dynobench", str(source), "--vehicle", "mushr", "--out", str(tmp_path / "out")])
    assert given == (2 if robot in OTHERS else 0)  # a trailer's angle must not become a speed


def test_a_problem_of_dynobench_keeps_its_states_and_names_its_vehicle(tmp_path: Path) -> None:
    source = tmp_path / "kink.yaml"
    source.write_text(PROBLEM)
    import_worlds(Request("dynobench", (source,), tmp_path / "out"))
    scene = load_scenario(tmp_path / "out" / "test.yaml")
    assert scene.obstacles == (Box((3, 3), (1, 0.5), name="box 0"), Circle((1, 5), 0.3, name="sphere 1"))
    assert (scene.goal.center, scene.goal.heading) == ((5, 5), pytest.approx(1.5))
    assert scene.vehicle == "kraft.vehicles.dynobench:UNICYCLE1_V0"


@pytest.mark.parametrize(
    ("change", "code", "line", "column"),
    [
        (("type: sphere", "type: octomap"), Code.UNKNOWN, 7, 14),
        (("size: [0.3]", "size: [0.3, 0.3]"), Code.VALUE, 7, 44),
        (("type: sphere, center", "type: octomap, octomap_file: a.bt, center"), Code.UNKNOWN, 7, 14),
        (("unicycle1_v0", "quadrotor_v0"), Code.UNKNOWN, 9, 11),
        (("start: [1, 1, 0]", "start: [3, 3, 0]"), Code.GEOMETRY, 10, 12),
        (("goal: [5, 5, 1.5]", "goal: [1, 5, 1.5]"), Code.GEOMETRY, 11, 11),
        (
            ("goal: [5, 5, 1.5]", "goal: [5, 5, 1.5]\n  - {type: unicycle1_v0, start: [0, 0, 0], goal: [0, 0, 0]}"),
            Code.VALUE,
            12,
            5,
        ),
        (("unicycle1_v0\n    start: [1, 1, 0]", "unicycle2_v0\n    start: [1, 1, 0, 0, 0.2]"), Code.VALUE, 10, 25),
        (("max: [6, 6]", "maximum: [6, 6]"), Code.UNKNOWN, 4, 3),
    ],
)
def test_a_problem_that_cannot_be_read_is_refused_at_its_line(
    tmp_path: Path, change: tuple[str, str], code: Code, line: int, column: int
) -> None:
    vehicle = None if change[1] == "quadrotor_v0" else "mushr"
    found = problems(tmp_path, PROBLEM.replace(*change), kind="dynobench", name="kink.yaml", vehicle=vehicle)
    assert (code, "kink.yaml", line, column) in found


def test_a_wrong_size_has_one_problem_at_its_number(tmp_path: Path) -> None:
    for size, at in (("[1.0, -0.5]", (6, 47)), ("[1.0, wide]", (6, 47)), ("-1.0", (6, 35))):
        text = PROBLEM.replace("[1.0, 0.5]", size)
        found = problems(tmp_path, text, kind="dynobench", name="kink.yaml", vehicle="mushr")
        assert [(line, column) for _, _, line, column in found] == [at]


def test_an_octomap_is_left_out_on_request_whatever_it_states(tmp_path: Path) -> None:
    octomap = "type: octomap, octomap_file: a.bt, center: [0, 0, 1], size: [1, 1, 1]"
    text = PROBLEM.replace("type: sphere, center: [1, 5], size: [0.3]", octomap)
    out = imported(tmp_path, text, kind="dynobench", name="kink.yaml", skip=True)
    assert load_scenario(out / "test.yaml").obstacles == (Box((3, 3), (1, 0.5), name="box 0"),)


def test_a_file_that_is_no_problem_of_dynobench_has_one_problem(tmp_path: Path) -> None:
    text = "".join(f"parameter_{k}: {k}\n" for k in range(70))
    found = problems(tmp_path, text, kind="dynobench", name="model.yaml", vehicle="mushr")
    assert [(code, file, line) for code, file, line, _ in found] == [(Code.MISMATCH, "model.yaml", None)]


def map_file(tmp_path: Path) -> Path:
    cells = np.full((40, 60), 254, dtype=np.uint8)
    cells[:, 30] = cells[0] = 0
    cells[15:25, 30] = 254
    (tmp_path / "floor.pgm").write_bytes(b"P5\n60 40\n255\n" + cells.tobytes())
    path = tmp_path / "floor.yaml"
    path.write_text("image: floor.pgm\nresolution: 0.1\norigin: [1.0, 2.0, 0.0]\n")
    return path


def test_a_map_stays_where_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = map_file(tmp_path), tmp_path / "deep" / "out"
    arguments = ["import", "map", str(source), "--start", "2,4,0", "--goal", "6,4", "--out", str(out), "--json"]
    assert main(arguments) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["schema"], [each["name"] for each in content["scenarios"]]) == ("kraft.import/1", ["floor"])
    scene = load_scenario(content["scenarios"][0]["file"])
    assert (scene.bounds.x, scene.bounds.y, scene.goal.radius) == ((1.0, 7.0), (2.0, 6.0), 0.25)
    assert sorted(path.name for path in out.iterdir()) == ["floor.yaml", "suite.yaml"]
    assert main(["import", "map", str(source), "--start", "2,4,0", "--goal", "6,4", "--out", str(out)]) == 2
    assert f"{out}: is there already; expected a new folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["300", "1e3", "null", "floor-2"])
def test_the_suite_of_a_world_whose_name_yaml_would_read_as_something_else_can_be_loaded(
    name: str, tmp_path: Path
) -> None:
    source = map_file(tmp_path).rename(tmp_path / f"{name}.yaml")
    out = tmp_path / "out"
    import_worlds(Request("map", (source,), out, vehicle="mushr", start=(2.0, 4.0, 0.0), goal=(6.0, 4.0, 0.25)))
    assert [(entry.name, entry.scenario.name) for entry in load_suite(out / "suite.yaml")] == [(name, name)]


def test_a_vehicle_that_is_not_the_robot_that_drives_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "big.py").write_text(
        "from dataclasses import replace\n"
        "from kraft.vehicles.mushr import MUSHR\n"
        "from ompl_ext import Footprint\n"
        'BIG = replace(MUSHR, name="big", footprint=Footprint(0.8, 0.4))\n'
    )
    arguments = ["-q", "import", "map", str(map_file(tmp_path)), "--start", "2,4,0", "--goal", "6,4"]
    vehicles = {"other": ["--vehicle", f"{tmp_path}/big.py:BIG"], "usual": [], "named": ["--vehicle", "mushr"]}
    found = {}
    for name, vehicle in vehicles.items():
        assert main([*arguments, *vehicle, "--out", str(tmp_path / name), "--json"]) == 0
        out, err = capsys.readouterr()
        assert [f"warning: {text}" for text in json.loads(out)["warnings"]] == err.splitlines()
        found[name] = err.splitlines()
    (warning,) = found.pop("other")
    assert warning.startswith("warning: the true robot is the MuSHR")
    assert found == {"usual": [], "named": []}


def test_a_map_is_found_from_a_folder_that_is_a_link(tmp_path: Path) -> None:
    source, out = map_file(tmp_path), tmp_path / "link" / "out"
    (tmp_path / "real" / "deep").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "real" / "deep")
    import_worlds(Request("map", (source,), out, vehicle="mushr", start=(2.0, 4.0, 0.0), goal=(6.0, 4.0, 0.25)))
    assert load_scenario(out / "floor.yaml").bounds.x == (1.0, 7.0)


@pytest.mark.parametrize(("scale", "limits"), [(1, (60.0, 30.0)), (10, (189.0, 189.0))])
def test_a_long_way_has_a_limit_of_time_of_three_least_times(
    tmp_path: Path, scale: int, limits: tuple[float, float]
) -> None:
    source = map_file(tmp_path)
    text = source.read_text()
    assert "resolution: 0.1\n" in text
    source.write_text(text.replace("resolution: 0.1\n", f"resolution: {0.1 * scale}\n"))
    start, goal = (1.0 + scale, 2.0 + 2.0 * scale, 0.0), (1.0 + 5.0 * scale, 2.0 + 2.0 * scale, 0.25)
    import_worlds(Request("map", (source,), tmp_path / "out", start, goal, "mushr"))
    trial = load_scenario(tmp_path / "out" / "floor.yaml").trial  # 4 m, or 40 m, at 0.63 m/s
    assert (trial.timeout, trial.oneshot_timeout) == pytest.approx(limits, rel=0.03)


@pytest.mark.parametrize("yaw", [0.6, -0.6, 2.0, math.pi / 2, 3.5])
def test_what_is_outside_of_a_turned_map_is_not_free(tmp_path: Path, yaw: float) -> None:
    source = map_file(tmp_path)
    source.write_text(source.read_text().replace("0.0]", f"{yaw}]"))
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    start, goal = ((turn @ place + (1.0, 2.0)).tolist() for place in ((1.0, 2.0), (5.0, 2.0)))
    request = Request("map", (source,), tmp_path / "out", (*start, math.degrees(yaw)), (*goal, 0.25))
    (written,) = import_worlds(request).written.scenarios
    scene = load_scenario(written)
    (x0, x1), (y0, y1) = scene.bounds.x, scene.bounds.y
    triangles = [np.array(each.vertices) for each in scene.obstacles if isinstance(each, Polygon)]
    assert len(triangles) == (0 if yaw == math.pi / 2 else 4)
    sides = [each[1:] - each[0] for each in triangles]
    outside = sum(0.5 * abs(np.linalg.det(each)) for each in sides)
    assert (x1 - x0) * (y1 - y0) - outside == pytest.approx(6.0 * 4.0, abs=1e-4)


def test_a_vehicle_file_is_relative_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "configs" / "vehicles" / "mushr-lag.yaml", "own.yaml")
    source = map_file(tmp_path)
    arguments = ["import", "map", str(source), "--start", "2,4,0", "--goal", "6,4", "--vehicle"]
    assert main([*arguments, "own.yaml", "--out", "deep/out"]) == 0
    assert load_scenario(tmp_path / "deep" / "out" / "floor.yaml").vehicle == str(tmp_path / "own.yaml")
    capsys.readouterr()
    assert main([*arguments, "none.yaml", "--out", "other"]) == 2
    assert capsys.readouterr().err.startswith("--vehicle: there is no file")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "2,4,0"], "--goal: is not given"),
        (["--start", "2,4", "--goal", "6,4"], "--start: is '2,4'"),
        (["--start", "2,4,0", "--goal", "6,nan"], "--goal: is '6,nan"),
        (["--start", "4,5.9,0", "--goal", "6,4"], "--start: mushr at (4, 5.9) heading 0 deg is"),
        (["--start", "2,4,0", "--goal", "40,4"], "--goal: the goal's centre is out of bounds"),
    ],
)
def test_a_start_or_goal_of_a_map_that_is_missing_or_wrong_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    out = tmp_path / "out"
    assert main(["import", "map", str(map_file(tmp_path)), *options, "--out", str(out)]) == 2
    assert capsys.readouterr().err.startswith(message)
    assert not out.exists()


def test_what_cannot_be_imported_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", "bran", "x.world"]) == 2
    assert "'barn'" in capsys.readouterr().err
    assert main(["import", "barn", str(tmp_path)]) == 2
    assert main(["import", "barn", str(tmp_path / "none.world")]) == 2
    (tmp_path / "bad.world.gz").write_bytes(b"\x1f\x8b nothing")
    assert main(["import", "barn", str(tmp_path / "bad.world.gz")]) == 2
    assert main(["import", "dynobench", str(tmp_path / "none.yaml"), "--start", "1,2,3"]) == 2
    assert capsys.readouterr().err.count("\n") == 5
