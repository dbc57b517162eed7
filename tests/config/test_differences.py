"""Differences between two JSON values are named where they are, and told in a few words."""

from __future__ import annotations

from typing import Any

import pytest

from kraft.provenance import MISSING, difference_text, differences

WALLS: list[dict[str, Any]] = [{"box": {"center": [float(k), 0.0], "size": [1.0, 0.2]}} for k in range(50)]


def test_an_item_of_a_list_that_differs_is_named_by_its_index() -> None:
    moved = [*WALLS[:7], {"box": {"center": [7.0, 0.5], "size": [1.0, 0.2]}}, *WALLS[8:]]
    assert list(differences({"obstacles": WALLS}, {"obstacles": moved})) == [
        (("obstacles[7]", "box", "center"), [7.0, 0.0], [7.0, 0.5])
    ]
    corners = {"vertices": [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]}
    assert list(differences(corners, {"vertices": [[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]]})) == [
        (("vertices[1]",), [1.0, 0.0], [2.0, 0.0])
    ]


@pytest.mark.parametrize("now", [WALLS[1:], [*WALLS[:-1], 3], 3, MISSING])
def test_lists_that_have_not_the_same_items_differ_as_a_whole(now: Any) -> None:
    assert list(differences({"obstacles": WALLS, "name": "a"}, {"obstacles": now, "name": "a"})) == [
        (("obstacles",), WALLS, now)
    ]


def test_of_a_long_list_that_became_shorter_the_numbers_of_items_are_told() -> None:
    assert difference_text(WALLS, WALLS[1:]) == "was a list of 50 items, is one of 49 now"
    assert difference_text([1, 2], [1]) == "was [1, 2], is [1] now"
