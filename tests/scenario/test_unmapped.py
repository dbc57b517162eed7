"""What no occupancy map covers: an obstacle inside the bounds if the scenario says so."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kraft.errors import InputError
from kraft.planning.feasibility import check_placement
from kraft.planning.workspace import start_state
from kraft.scenario import OccupancyMap, Polygon, load_scenario, parse_scenario
from kraft.scenario.geometry import signed_area
from kraft.scenario.schema import Bounds
from kraft.scenario.unmapped import unmapped, unstated_outside
from kraft.vehicles.load import load_vehicle

SCENE = (
    "name: x\nbounds: {x: [0, 8], y: [0, 4]}\nstart: {x: 3, y: 2, heading_deg: 0}\n"
    "goal: {center: [5, 2], radius: 0.3}\nobstacles:\n  - {name: floor, map: {file: m.yaml, height: 0.4, outside: occupied}}\n"
)


def scene_of(folder: Path, text: str = SCENE, x: float = 2.0) -> tuple[Polygon, ...]:
    """Polygons of a scenario with a free map of 4 m by 4 m whose lower left corner is at (x, 0)."""
    (folder / "m.pgm").write_bytes(b"P5 40 40 255\n" + bytes([254]) * 1600)
    (folder / "m.yaml").write_text(f"{{image: m.pgm, resolution: 0.1, origin: [{x}, 0, 0]}}\n")
    return tuple(each for each in parse_scenario(text, folder=folder).obstacles if isinstance(each, Polygon))


def is_inside(polygon: NDArray[np.float64], point: NDArray[np.float64], margin: float) -> bool:
    """Whether a point is inside of a convex polygon and farther than a margin from its border, or not nearer than it."""
    along, to = np.roll(polygon, -1, axis=0) - polygon, point - polygon
    left = (along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]) / np.linalg.norm(along, axis=1)
    return bool((left > margin).all())


def test_bounds_beyond_a_map_are_obstacles(tmp_path: Path) -> None:
    right, left = scene_of(tmp_path)
    assert (right.name, left.name) == ("outside the map 1", "outside the map 2")
    assert {corner[0] for corner in right.vertices} == {6.0, 8.0}
    assert {corner[0] for corner in left.vertices} == {0.0, 2.0}
    assert {each.height for each in (right, left)} == {0.4}


def test_a_start_beyond_the_map_is_refused(tmp_path: Path) -> None:
    scene_of(tmp_path)
    task = parse_scenario(SCENE.replace("x: 3,", "x: 1,"), folder=tmp_path).task()
    vehicle = load_vehicle("benchmark")
    with pytest.raises(InputError, match=r"3:8: start: .* is in collision with 'outside the map 2'"):
        check_placement(task, vehicle, start_state(task, vehicle))


def test_bounds_beyond_a_map_are_free_if_the_scenario_says_so(tmp_path: Path) -> None:
    assert scene_of(tmp_path, SCENE.replace("outside: occupied", "outside: free")) == ()


@pytest.mark.parametrize(("stated", "warned"), [("", True), (", outside: free", False), (", outside: occupied", False)])
def test_a_scenario_that_does_not_state_what_is_beyond_its_map_is_warned_of(
    stated: str, warned: bool, tmp_path: Path
) -> None:
    text = SCENE.replace(", outside: occupied", stated)
    assert bool(scene_of(tmp_path, text)) == (stated == ", outside: occupied")
    text_of_warning = unstated_outside(parse_scenario(text, folder=tmp_path))
    assert text_of_warning.startswith("50% of the bounds are outside the map") if warned else text_of_warning == ""


@pytest.mark.parametrize("outside", [None, "free", "occupied"])
def test_obstacles_that_replace_those_of_the_file_also_state_what_is_beyond_their_map(
    outside: str | None, tmp_path: Path
) -> None:
    scene_of(tmp_path)
    stated = {"file": str(tmp_path / "m.yaml")} | ({} if outside is None else {"outside": outside})
    (tmp_path / "scene.yaml").write_text(SCENE)
    scenario = load_scenario(tmp_path / "scene.yaml", {"obstacles": [{"map": stated}]})
    assert bool(unstated_outside(scenario)) == (outside is None)


def test_a_map_that_reaches_the_bounds_to_a_rounding_adds_nothing(tmp_path: Path) -> None:
    whole = SCENE.replace("x: [0, 8]", "x: [1.9999996, 6.0000004]")
    assert scene_of(tmp_path, whole) == ()
    assert len(scene_of(tmp_path, whole, x=1.99)) == 1


def test_of_several_maps_one_that_says_occupied_decides_about_what_none_of_them_covers(tmp_path: Path) -> None:
    (tmp_path / "n.yaml").write_text("{image: m.pgm, resolution: 0.1, origin: [4, 0, 0]}\n")
    text = SCENE + "  - map: {file: n.yaml, outside: free}\n"
    (left,) = scene_of(tmp_path, text)
    assert sorted(left.vertices) == [(0.0, 0.0), (0.0, 4.0), (2.0, 0.0), (2.0, 4.0)]


@given(
    st.lists(
        st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(-4, 4), st.integers(1, 60), st.integers(1, 60)),
        min_size=1, max_size=3,
    ),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_every_place_is_covered_by_a_map_or_by_one_part(
    placed: list[tuple[float, float, float, int, int]], seed: int
) -> None:
    maps = [OccupancyMap(np.zeros((rows, columns), bool), 0.1, (x, y, yaw)) for x, y, yaw, rows, columns in placed]
    parts = [np.array(each.vertices) for each in unmapped(Bounds(x=(-3.0, 4.0), y=(-2.0, 3.0)), maps, 0.2)]
    assert all(signed_area(each) > 0.0 for each in parts)
    assert all(np.linalg.norm(np.roll(each, -1, axis=0) - each, axis=1).min() >= 1e-3 for each in parts)
    for point in np.random.default_rng(seed).uniform((-3, -2), (4, 3), (60, 2)):
        surely, maybe = (sum(is_inside(each, point, margin) for each in parts) for margin in (0.003, -0.003))
        mapped = any(is_inside(each.corners, point, 0.003) for each in maps)
        near = any(is_inside(each.corners, point, -0.003) for each in maps)
        assert surely <= 1
        assert not (surely and mapped)
        assert maybe or near


def test_corners_of_a_turned_map() -> None:
    grid = OccupancyMap(np.zeros((2, 3), bool), 0.5, (1.0, 2.0, math.pi / 2))
    assert grid.corners == pytest.approx(np.array([[1.0, 2.0], [1.0, 3.5], [0.0, 3.5], [0.0, 2.0]]))
