"""Intervals and tests for numbers of successes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate; (0, 1) without trials.

    Raises:
        ValueError: if there are fewer trials than successes, or a number is negative.
    """
    from scipy.stats import binomtest

    if successes == trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> tuple[float, float] | None:
    """Student's t interval of a mean; None with fewer than two values."""
    from scipy.special import stdtrit

    if len(values) < 2:
        return None
    half = stdtrit(len(values) - 1, (1 + confidence) / 2) * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values) - half), float(np.mean(values) + half)


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of two methods on the same seeds.

    Attributes:
        gained: number of seeds on which only the method succeeded.
        lost: number of seeds on which only the reference succeeded.
        p: two-sided p-value under the hypothesis of equal success rates.
    """

    gained: int
    lost: int
    p: float


def mcnemar(successes: Mapping[int, bool], reference: Mapping[int, bool]) -> McNemar:
    """Compare successes by seed, over the seeds that both have."""
    from scipy.stats import binomtest

    common = successes.keys() & reference.keys()
    gained = sum(successes[seed] and not reference[seed] for seed in common)
    lost = sum(reference[seed] and not successes[seed] for seed in common)
    discordant = gained + lost
    return McNemar(gained, lost, float(binomtest(gained, discordant, 0.5).pvalue) if discordant else 1.0)


def percentile(values: Sequence[float], share: float) -> float | None:
    """Smallest value that at least `share` of the values do not exceed; None without values."""
    return float(np.quantile(values, share, method="inverted_cdf")) if values else None
