"""The planner's random numbers depend on the seed alone, and look uniform."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ompl_ext.kernels.rng import generator, uniform

MASK = 2**64 - 1
PINNED = {
    0: [0.753439610411553, 0.5353210898649783, 0.7013033354721914],
    1: [0.6467644228567826, 0.7900803580362935, 0.2819318982930057],
    -1: [0.9276207310058714, 0.5493389994564666, 0.6417272112475111],
}
seeds = st.integers(-(2**200), 2**200)


def split_mix(state: int, count: int) -> list[float]:
    """SplitMix64 over Python's integers, from the publication."""
    numbers = []
    for _ in range(count):
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        numbers.append(((z ^ (z >> 31)) >> 11) * 2.0**-53)
    return numbers


def drawn(seed: int, count: int) -> list[float]:
    state = generator(seed)
    return [uniform(state) for _ in range(count)]


def test_split_mix_from_state_zero_gives_the_published_numbers() -> None:
    state = np.zeros(1, np.uint64)
    published = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [uniform(state) for _ in published] == [(z >> 11) * 2.0**-53 for z in published]


def test_the_sequence_of_a_seed_is_pinned() -> None:
    assert drawn(0, 3) == PINNED[0]
    assert drawn(1, 3) == PINNED[1]
    assert drawn(-1, 3) == PINNED[-1]


@given(seeds)
@settings(max_examples=100)
def test_any_integer_is_a_seed_and_gives_the_reference_sequence(seed: int) -> None:
    assert drawn(seed, 5) == split_mix(int(generator(seed)[0]), 5)


@given(seeds, st.integers(1, 2**64 - 1))
@settings(max_examples=100)
def test_seeds_that_differ_modulo_two_to_the_64_give_different_sequences(seed: int, other: int) -> None:
    assert drawn(seed, 2) != drawn(seed + other, 2)
    assert drawn(seed, 2) == drawn(seed + 2**64, 2)


@pytest.mark.parametrize("seed", [0, 1, 2, -1, 2**63, 2**64 - 1])
def test_numbers_are_uniform_in_the_half_open_unit_interval(seed: int) -> None:
    sample = np.array(drawn(seed, 200_000))
    assert sample.min() >= 0.0
    assert sample.max() < 1.0
    counts = np.bincount((sample * 100).astype(int), minlength=100)
    chi_squared = ((counts - 2000.0) ** 2 / 2000.0).sum()
    assert 50 < chi_squared < 170  # 99 degrees of freedom
    assert abs(np.corrcoef(sample[:-1], sample[1:])[0, 1]) < 0.01


def test_neighbouring_seeds_are_not_correlated() -> None:
    sequences = np.array([drawn(seed, 5_000) for seed in range(20)])
    correlation = np.corrcoef(sequences) - np.eye(20)
    assert np.abs(correlation).max() < 0.08
