"""Random worlds are the same for a seed, suit their vehicle, and can be crossed."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from kraft.errors import Code, InputError
from kraft.evaluation.suite import load_suite
from kraft.planning.feasibility import check_placement, geodesic_time
from kraft.planning.plan import finds_plan, plan
from kraft.planning.workspace import start_state
from kraft.scenario import Box, OccupancyMap, Trial, load_scenario
from kraft.vehicles.load import load_vehicle
from kraft.worlds import layouts
from kraft.worlds.generate import ITERATIONS, KINDS, LARGE, LAYOUTS, MIXED, Size, generate, generate_worlds
from kraft.worlds.world import resolved_argument
from kraft_cli.main import main
from ompl_ext.vehicle import Footprint, Vehicle


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("generated") / "mixed"
    generate_worlds(MIXED, out, seed=7, count=2 * len(KINDS), vehicle="mushr")
    return out


def test_the_goal_of_every_kind_is_reached_by_the_disc_around_the_footprint(mixed: Path) -> None:
    vehicle = load_vehicle("mushr")
    diagonal = Size.of(vehicle).diagonal
    assert diagonal == pytest.approx(math.hypot(0.40, 0.28))
    wide = replace(vehicle, footprint=Footprint(diagonal, diagonal))
    entries = load_suite(mixed / "suite.yaml")
    assert [entry.name.rpartition("-")[0] for entry in entries] == [*KINDS, *KINDS]
    for entry in entries:
        check_placement(entry.scenario, vehicle, start_state(entry.scenario, vehicle))
        assert 0.0 < geodesic_time(entry.scenario, vehicle) <= geodesic_time(entry.scenario, wide) < math.inf


def test_the_vehicle_of_every_world_has_a_plan(mixed: Path) -> None:
    entries = load_suite(mixed / "suite.yaml")
    assert all(finds_plan(entry.scenario.task(), load_vehicle("mushr"), ITERATIONS) for entry in entries)


def test_a_layout_with_a_way_and_without_a_plan_is_followed_by_the_next_one_of_the_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("kraft.worlds.generate.finds_plan", lambda *_: True)
        first = generate("rooms", 3)
    chosen = generate("rooms", 3)
    assert chosen.content["obstacles"] != first.content["obstacles"]
    assert chosen == generate("rooms", 3)
    solved = []
    for name, world in (("first", first), ("chosen", chosen)):
        path = tmp_path / f"{name}.yaml"
        path.write_text(world.text, encoding="utf-8")
        solved.append(plan(path, iterations=ITERATIONS).solved)
    assert solved == [False, True]


def test_a_vehicle_without_a_plan_in_any_layout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.worlds.generate.finds_plan", lambda *_: False)
    monkeypatch.setattr("kraft.worlds.generate.SEARCHES", 2)
    with pytest.raises(InputError, match=r"rows-000: none of 2 layouts leaves mushr a way .* with a plan"):
        generate("rows", 0)


def test_a_seed_gives_the_same_files_whatever_else_is_generated(mixed: Path, tmp_path: Path) -> None:
    generate_worlds(MIXED, tmp_path / "other", seed=12, count=3, vehicle="mushr")
    for path in (tmp_path / "other").rglob("*-01*.*"):
        assert path.read_bytes() == (mixed / path.relative_to(tmp_path / "other")).read_bytes()
    assert generate("rooms", 1).text != generate("rooms", 2).text.replace("rooms-002", "rooms-001")


@pytest.mark.parametrize("kind", ["track", "posts"])
def test_the_bundled_scenes_are_those_of_the_seed_zero(kind: str, tmp_path: Path) -> None:
    written = generate_worlds(kind, tmp_path / "out").scenarios[0]
    assert replace(load_scenario(written), name=kind, description="") == replace(load_scenario(kind), description="")
    if kind == "track":
        image = tmp_path / "out" / "maps" / "track-000.pgm"
        assert image.read_bytes() == (ROOT / "scenarios" / "maps" / "track.pgm").read_bytes()


def test_larger_vehicles_get_larger_worlds() -> None:
    small, large = (generate("posts", 3, name) for name in ("jackal", "mushr"))
    assert small.content["bounds"] == large.content["bounds"]
    huge = replace(load_vehicle("mushr"), footprint=Footprint(2.0, 1.0))
    assert Size.of(huge).scale == pytest.approx(math.hypot(2, 1) / math.hypot(0.51, 0.43))
    assert Size.of(huge).gap[0] > math.hypot(2, 1)


def test_a_long_way_has_a_limit_of_time_of_three_least_times(tmp_path: Path) -> None:
    usual, long = (
        load_scenario(generate_worlds("corridor", tmp_path / str(seed), seed=seed).scenarios[0]) for seed in (7, 140)
    )
    assert usual.trial == Trial()
    limit = math.ceil(3.0 * geodesic_time(long, load_vehicle("mushr")))
    assert limit > Trial().timeout
    assert (long.trial.timeout, long.trial.oneshot_timeout) == (limit, limit)


@pytest.mark.parametrize("kind", ["rooms", "rows", "clutter"])
def test_an_arena_of_a_larger_vehicle_is_the_same_one_enlarged(kind: str) -> None:
    """Obstacles of half a metre all over a large arena leave a large vehicle no way."""
    small, large = (
        LAYOUTS[kind](np.random.default_rng(3), Size(scale * LARGE, scale), 0.15)["obstacles"][:-4]  # less outer walls
        for scale in (1.0, 3.0)
    )
    assert len(small) == len(large) > 3
    areas = [sum(map(layouts.area, obstacles)) for obstacles in (small, large)]
    assert areas[1] == pytest.approx(9.0 * areas[0])


def test_every_cell_of_a_maze_is_reached_on_one_way_and_walls_stand_between_the_others() -> None:
    openings = layouts.passages(np.random.default_rng(0), 5, 4)
    assert len(openings) == 5 * 4 - 1
    assert len({after for _, after in openings}) == 5 * 4 - 1
    extra = [*openings, ((0, 1), (0, 0)), ((1, 0), (0, 0))]
    way = layouts.way_through(extra, (4, 3))
    assert (way[0], way[-1]) == ((0, 0), (4, 3))
    long = sum(max(wall["box"]["size"]) - layouts.WALL for wall in layouts.walls_between(openings, 5, 4, 1.0))
    assert long == pytest.approx(4 * 4 + 5 * 3 - len(openings))


def test_the_areas_of_clutter_add_up_to_the_share_that_is_asked_for() -> None:
    for density in (0.05, 0.3):
        found = layouts.clutter(np.random.default_rng(1), 5.0, 6.0, density)
        covered = sum(map(layouts.area, found)) / (5.0 * (6.0 - 2.2))
        assert density <= covered < density + 0.03


def test_the_command_writes_a_suite_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["generate", "clutter", "--seed", "4", "--count", "2", "--density", "0.1", "--out", str(out), "--json"]
    assert main(arguments) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["schema"], [each["name"] for each in content["scenarios"]]) == (
        "kraft.generate/1",
        ["clutter-004", "clutter-005"],
    )
    assert main(["validate", content["suite"], *(each["file"] for each in content["scenarios"])]) == 0
    obstacles = load_scenario(content["scenarios"][0]["file"]).obstacles
    assert not any(isinstance(obstacle, OccupancyMap) for obstacle in obstacles)
    assert sum(isinstance(obstacle, Box) for obstacle in obstacles) >= 4


def test_what_compiles_is_announced_before_the_first_world_and_every_finished_world_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compiled(vehicle: Vehicle, report: Callable[[str], None]) -> None:
        report(f"compiling for {vehicle.name}")

    with monkeypatch.context() as patched:
        patched.setattr("kraft.worlds.generate.ensure_compiled", compiled)
        assert main(["generate", "mixed", "--seed", "2", "--count", "2", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "compiling for mushr",
        "world 1 of 2: rows-002",
        "compiling for jackal",
        "world 2 of 2: posts-003",
    ]


@pytest.mark.parametrize(
    ("options", "subject"),
    [
        (["mase"], "mase"),
        (["rooms", "--density", "0.1"], "--density"),
        (["clutter", "--density", "0.9"], "--density"),
        (["rooms", "--vehicle", "mshr"], "--vehicle"),
    ],
)
def test_what_cannot_be_generated_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], subject: str
) -> None:
    assert main(["generate", *options, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith(f"{subject}: ")
    assert not (tmp_path / "out").exists()


def test_the_vehicle_of_all_worlds_is_resolved_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resolved = list[str]()

    def recorded(reference: str) -> str:
        resolved.append(reference)
        return resolved_argument(reference)

    monkeypatch.setattr("kraft.worlds.generate.resolved_argument", recorded)
    written = generate_worlds("posts", tmp_path / "out", count=3, vehicle="jackal")
    assert len(written.scenarios) == 3
    assert resolved == ["jackal"]


def test_a_density_that_leaves_no_way_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.worlds.generate.ATTEMPTS", 2)
    with pytest.raises(InputError) as caught:
        generate("clutter", 0, "jackal", 0.5)
    assert [d.code for d in caught.value.diagnostics] == [Code.VALUE]
    assert caught.value.diagnostics[0].argument


def test_worlds_of_a_vehicle_in_code_name_its_file_and_warn_once_of_the_robot_that_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cars").mkdir()
    Path("cars/big.py").write_text(
        "from dataclasses import replace\n"
        "from kraft.vehicles.mushr import MUSHR\n"
        "from ompl_ext import Footprint\n"
        'BIG = replace(MUSHR, name="big", footprint=Footprint(0.8, 0.4))\n'
    )
    options = ["generate", "posts", "--seed", "3", "--count", "2", "--vehicle", "cars/big.py:BIG", "--out", "made"]
    assert main(["-q", *options]) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: the true robot is the MuSHR")
    first = Path("made/posts-003.yaml").read_text().splitlines()[0]
    assert first == "# Written by kraft generate posts --seed 3 --vehicle cars/big.py:BIG."
    assert main(["-q", *options[:-1], "again", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == [warning.removeprefix("warning: ")]
    assert main(["-q", "generate", "posts", "--vehicle", "mushr", "--out", "silent", "--json"]) == 0
    out, err = capsys.readouterr()
    assert (json.loads(out)["warnings"], err) == ([], "")


def test_worlds_and_their_vehicle_may_be_moved_together(tmp_path: Path) -> None:
    (tmp_path / "here" / "cars").mkdir(parents=True)
    car = shutil.copy(ROOT / "configs" / "vehicles" / "mushr.yaml", tmp_path / "here" / "cars" / "own.yaml")
    generate_worlds("rooms", tmp_path / "here" / "worlds", vehicle=str(car))
    (tmp_path / "here").rename(tmp_path / "there")
    moved = tmp_path / "there" / "worlds" / "rooms-000.yaml"
    assert str(tmp_path) not in moved.read_text()
    assert load_scenario(moved).vehicle == str((tmp_path / "there" / "cars" / "own.yaml").resolve())
