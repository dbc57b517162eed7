"""Statistics of trials: intervals of rates, means and ratios, tests of two methods, quantiles of measured times."""

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


def while_driving(planning: Sequence[float]) -> Sequence[float]:
    """Planning times of a trial without that of its first plan, which is made before the vehicle drives.

    A trial with one plan has no others: its time is that of the first plan.
    """
    return planning[1:] if len(planning) > 1 else planning


@dataclass(frozen=True)
class PairedDifference:
    """Difference of the shares of two methods on the same trials.

    Attributes:
        pairs: number of trials that both methods have.
        gained: number of trials in which only the first one has what is counted.
        lost: number of trials in which only the second one has it.
        difference: share of the first one minus that of the second one.
        interval: 95 % interval of the difference, Newcombe's from Wilson's intervals for paired shares.
        p: two-sided p-value of the exact McNemar test.
    """

    pairs: int
    gained: int
    lost: int
    difference: float
    interval: tuple[float, float]
    p: float


def paired_difference(one: Sequence[bool], other: Sequence[bool], confidence: float = 0.95) -> PairedDifference:
    """Compare two methods on the same trials, given in the same order.

    The interval is that of method 10 of Newcombe 1998, "Improved confidence intervals for the difference between
    binomial proportions based on paired data".  It does not shrink to a point where the methods never differ.

    Raises:
        ValueError: if there is no trial, or not one of each for the other.
    """
    if not one or len(one) != len(other):
        raise ValueError("expected pairs of trials")
    n = len(one)
    both = sum(a and b for a, b in zip(one, other, strict=True))
    gained, lost = sum(one) - both, sum(other) - both
    neither = n - both - gained - lost
    (low, high), (low_other, high_other) = wilson(sum(one), n, confidence), wilson(sum(other), n, confidence)
    share, share_other = sum(one) / n, sum(other) / n
    phi = _correlation(both, gained, lost, neither)
    difference = share - share_other
    below = _joint(share - low, high_other - share_other, phi)
    above = _joint(high - share, share_other - low_other, phi)
    p = mcnemar(dict(enumerate(one)), dict(enumerate(other))).p
    return PairedDifference(n, gained, lost, difference, (difference - below, difference + above), p)


def _joint(a: float, b: float, phi: float) -> float:
    return float(np.sqrt(max(a * a - 2.0 * phi * a * b + b * b, 0.0)))


def _correlation(both: int, gained: int, lost: int, neither: int) -> float:
    """Correlation of two shares, corrected for continuity as in method 10; 0 where one of them is 0 or 1."""
    margins = (both + gained) * (lost + neither) * (both + lost) * (gained + neither)
    if margins == 0:
        return 0.0
    product = float(both * neither - gained * lost)
    if product > 0:
        product = max(product - (both + gained + lost + neither) / 2, 0.0)
    return float(product / np.sqrt(margins))


def ratio_interval(
    one: Sequence[float], other: Sequence[float], confidence: float = 0.95
) -> tuple[float, float] | None:
    """Bootstrapped interval (BCa, 9,999 resamples) of the geometric mean of `one` over `other`, pair by pair.

    None with fewer than three pairs, or if all have the same ratio, which bootstrapping cannot judge.
    """
    from scipy.stats import bootstrap

    logs = np.log(np.asarray(one, dtype=float) / np.asarray(other, dtype=float))
    if len(logs) < 3 or np.ptp(logs) == 0.0:
        return None
    generator = np.random.default_rng(0)
    found = bootstrap((logs,), np.mean, confidence_level=confidence, method="BCa", rng=generator).confidence_interval
    return float(np.exp(found.low)), float(np.exp(found.high))
