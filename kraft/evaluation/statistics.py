"""Intervals and tests for numbers of successes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Z95: Final = 1.959963984540054
"""97.5 % quantile of the normal distribution"""


def wilson(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """Wilson's score interval of a success rate, by default with 95 % confidence; (0, 1) without trials.

    Raises:
        ValueError: if there are fewer trials than successes, or a number is negative.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials")
    if trials == 0:
        return 0.0, 1.0
    rate, weight = successes / trials, z * z / trials
    middle = (rate + weight / 2) / (1 + weight)
    half = z / (1 + weight) * math.sqrt(rate * (1 - rate) / trials + weight / (4 * trials))
    low = 0.0 if successes == 0 else max(0.0, middle - half)  # rounding must not move what is exact
    high = 1.0 if successes == trials else min(1.0, middle + half)
    return low, high


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of two methods on the same seeds.

    Attributes:
        gained: seeds on which the method succeeded and the reference did not.
        lost: seeds on which the reference succeeded and the method did not.
        p: two-sided probability of a split at least as uneven if both methods were equally good.
    """

    gained: int
    lost: int
    p: float


def mcnemar(successes: Mapping[int, bool], reference: Mapping[int, bool]) -> McNemar:
    """Compare successes by seed; seeds that only one of the two ran do not count."""
    from scipy.stats import binomtest

    common = successes.keys() & reference.keys()
    gained = sum(successes[seed] and not reference[seed] for seed in common)
    lost = sum(reference[seed] and not successes[seed] for seed in common)
    discordant = gained + lost
    return McNemar(gained, lost, float(binomtest(gained, discordant, 0.5).pvalue) if discordant else 1.0)


def percentile(values: list[float], share: float) -> float | None:
    """The smallest value that at least `share` of the values do not exceed; None without values."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]
