"""One trial, two trials; clearances and finite numbers."""

from __future__ import annotations

import math

import pytest

from kraft.text import counted, decimals, finite, grouped, listed, metres, nearest, slugs


@pytest.mark.parametrize(("number", "text"), [(0, "0 trials"), (1, "1 trial"), (2, "2 trials")])
def test_one_thing_is_no_plural(number: int, text: str) -> None:
    assert counted(number, "trial") == grouped(number, "trial") == text
    assert grouped(20_000, "edge") == "20,000 edges"


@pytest.mark.parametrize("value", [None, math.inf, -math.inf, math.nan])
def test_what_is_not_finite_is_null_in_json_and_words_in_text(value: float | None) -> None:
    assert finite(value) is None
    assert (metres(value), metres(value, "-"), decimals(value, 2)) == ("no obstacle", "-", "-")


def test_finite_numbers_keep_their_digits() -> None:
    assert (finite(0.1), metres(0.12345), decimals(2.0, 1)) == (0.1, "0.123 m", "2.0")


@pytest.mark.parametrize(("word", "option"), [("Turns", "turns"), ("turn", "turns"), ("yaw", "yaw_deg"), ("zzz", None)])
def test_the_same_name_is_nearer_than_one_that_begins_with_it(word: str, option: str | None) -> None:
    assert nearest(word, ["turns-real", "turns", "yaw_deg"]) == option


def test_of_a_long_list_the_first_few_are_said_and_how_many_more() -> None:
    assert [listed(range(n)) for n in (0, 1, 3, 5)] == ["", "0", "0; 1; 2", "0; 1; 2; and 2 more"]


def test_slugs_of_long_names_fit_into_names_of_files_and_differ() -> None:
    names = [f"{'ä' * 300} {k}" for k in range(3)]
    found = list(slugs(names).values())
    assert len(set(found)) == 3
    assert max(len(each.encode()) for each in found) < 120


@pytest.mark.parametrize(
    ("word", "option"), [("nope", None), ("trun", "turns"), ("urns", "turns"), ("bumb", "bump"), ("slop", "slope")]
)
def test_what_is_suggested_is_spelt_alike(word: str, option: str | None) -> None:
    assert nearest(word, ["turns", "boxes", "bump", "slope", "slip", "movable"]) == option
