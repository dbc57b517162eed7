"""Whether a polygon is simple, and which way it runs."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kraft.scenario.geometry import crossing_edges, signed_area

radii = st.lists(st.floats(0.5, 3.0), min_size=4, max_size=12)


def star(radii: list[float]) -> NDArray[np.float64]:
    """A polygon that sees all of itself from the origin, so it cannot cross itself."""
    angles = np.arange(len(radii)) * 2 * math.pi / len(radii)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(directions * np.array(radii)[:, None], dtype=np.float64)


@given(radii, st.integers(0, 11))
def test_a_star_is_simple_whichever_vertex_comes_first_and_whichever_way_it_runs(radii: list[float], k: int) -> None:
    vertices = np.roll(star(radii), k, axis=0)
    assert crossing_edges(vertices) is None
    assert crossing_edges(vertices[::-1]) is None


@given(radii, st.integers(0, 11))
def test_counter_clockwise_area_is_positive_wherever_the_polygon_is(radii: list[float], k: int) -> None:
    vertices = star(radii)
    wedges = [a * b for a, b in zip(radii, [*radii[1:], radii[0]], strict=True)]
    area = 0.5 * math.sin(2 * math.pi / len(radii)) * sum(wedges)
    assert math.isclose(signed_area(vertices), area, rel_tol=1e-9)
    assert math.isclose(signed_area(vertices[::-1] + 1000.0 * k), -area, rel_tol=1e-6)


@given(st.floats(0.1, 0.9), st.floats(0.1, 0.9), st.integers(0, 4))
def test_an_edge_that_crosses_another_is_found_from_every_first_vertex(u: float, v: float, k: int) -> None:
    # the last vertex lies inside the square and the edge to it comes from outside through the upper side
    vertices = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [u, 2.0], [v, 0.5]])
    assert crossing_edges(np.roll(vertices, k, axis=0)) is not None


def test_touching_counts_as_meeting() -> None:
    vertices = np.array([[0, 0], [2, 0], [2, 2], [1, 0], [0, 2]], dtype=np.float64)
    assert crossing_edges(vertices) == (0, 2)


def test_folding_back_counts_as_meeting() -> None:
    vertices = np.array([[0, 0], [2, 0], [1, 0], [1, 1]], dtype=np.float64)
    assert crossing_edges(vertices) == (0, 1)
