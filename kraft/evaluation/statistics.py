"""Statistics of trials: intervals of rates, means and ratios, tests of two methods, quantiles of measured times."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats

SIGNIFICANT: Final = 0.05
"""p-value below which a difference is shown."""
GROUPS_MIN: Final = 3
"""Fewest groups whose mean difference has an interval and a test."""
ROUNDING: Final = 1e-9
"""Difference of two mean differences up to which they are the same: those of times are not exact."""
CONFIDENCE: Final = 1.0 - SIGNIFICANT
"""Confidence of all intervals: one excludes what a test of the same data would not show to be true."""


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's score interval of a success rate; (0, 1) without trials.

    Raises:
        ValueError: if there are fewer trials than successes, or a number is negative.
    """
    from scipy.stats import binomtest

    if successes == trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Student's t interval of a mean; None with fewer than two values."""
    from scipy.special import stdtrit

    if len(values) < 2:
        return None
    half = stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2) * np.std(values, ddof=1) / np.sqrt(len(values))
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


def fisher_p(one: tuple[int, int], other: tuple[int, int]) -> float:
    """Two-sided p-value of Fisher's exact test of two rates, each given as the successes of so many trials.

    The trials are independent ones: those that are paired by their seeds are tested by `mcnemar`.
    """
    from scipy.stats import fisher_exact

    return float(fisher_exact([[successes, trials - successes] for successes, trials in (one, other)]).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values of several tests, adjusted for their number by Holm's method, in the order in which they were given.

    If each below 0.05 is taken as a difference, the probability of one that is none is at most 0.05 for all together.
    """
    adjusted, largest = [1.0] * len(p_values), 0.0
    for rank, k in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted


def percentile(values: Sequence[float], share: float) -> float | None:
    """Smallest value that at least `share` of the values do not exceed; None without values."""
    return float(np.quantile(values, share, method="inverted_cdf")) if values else None


def while_driving(planning: Iterable[Sequence[float]]) -> list[float]:
    """Planning times of trials without those of their first plans, which are made before the vehicles drive.

    If all trials have one plan at most, as those of a method that plans once, it is the time of these.
    """
    trials = list(planning)
    return [each for trial in trials for each in trial[1:]] or [each for trial in trials for each in trial]


@dataclass(frozen=True)
class PairedDifference:
    """Difference of the shares of two methods on the same trials.

    Attributes:
        pairs: number of trials that both methods have.
        counts: numbers of trials in which each of them has what is counted.
        gained: number of trials in which only the first one has it.
        lost: number of trials in which only the second one has it.
        difference: share of the first one minus that of the second one.
        interval: 95 % interval of the difference over groups, see `mean_difference_interval`.
        p: two-sided p-value of the exact sign-flip test over groups.
        least_p: least p-value that this test can give with as many groups in which the methods differ.
    """

    pairs: int
    counts: tuple[int, int]
    gained: int
    lost: int
    difference: float
    interval: tuple[float, float]
    p: float
    least_p: float

    @property
    def shown(self) -> int:
        """1 or -1 if the first method has shown more or less, 0 if there may be no difference.

        The interval and the test have to exclude that: the test is exact also where few groups differ.
        """
        low, high = self.interval
        if self.p >= SIGNIFICANT or low <= 0.0 <= high:
            return 0
        return 1 if low > 0.0 else -1


def paired_difference(one: Sequence[bool], other: Sequence[bool], groups: Sequence[Hashable]) -> PairedDifference:
    """Compare two methods on the same trials, given in the same order, each with the group that it belongs to.

    Trials of a group are alike, as are the seeds of one scenario, so interval and test treat groups as independent, not
    trials.  The interval is Student's over groups.  With fewer than three groups, or with the same difference in all of
    them, which do not tell how it varies, it is `newcombe` with one pair for each group.

    Raises:
        ValueError: if there is no trial, or not one of each for the other, or not a group for each.
    """
    if not one or not len(one) == len(other) == len(groups):
        raise ValueError("expected pairs of trials and their groups")
    n = len(one)
    both = sum(a and b for a, b in zip(one, other, strict=True))
    gained, lost = sum(one) - both, sum(other) - both
    differences = [int(a) - int(b) for a, b in zip(one, other, strict=True)]
    interval, whole = mean_difference_interval(differences, groups), _sums(differences, groups)
    if interval is None:
        each = len(whole) / n
        interval = newcombe(each * both, each * gained, each * lost, each * (n - both - gained - lost))
    interval = max(interval[0], -1.0), min(interval[1], 1.0)
    p, least = sign_flip_p(whole), least_sign_flip_p(sum(change != 0 for change in whole))
    return PairedDifference(n, (sum(one), sum(other)), gained, lost, (gained - lost) / n, interval, p, least)


def _sums(values: Sequence[int], groups: Sequence[Hashable]) -> list[int]:
    """Sum of the values of each group."""
    sums = dict.fromkeys(groups, 0)
    for value, group in zip(values, groups, strict=True):
        sums[group] += value
    return list(sums.values())


def sign_flip_p(changes: Sequence[int]) -> float:
    """Two-sided p-value of the sum of `changes`, each of which is as likely to have the other sign.

    It is exact, by the distribution of the sum.  With changes of 1 and -1 it is the exact McNemar test.
    """
    found = [abs(change) for change in changes if change]
    chances = np.zeros(2 * sum(found) + 1)  # of the sums from -sum(found) on
    chances[sum(found)] = 1.0
    for size in found:
        chances = 0.5 * (np.roll(chances, size) + np.roll(chances, -size))  # no sum gets past the ends
    sums = np.abs(np.arange(len(chances)) - sum(found))
    return min(1.0, float(chances[sums >= abs(sum(changes))].sum()))


def least_sign_flip_p(number: int) -> float:
    """Least p-value of `sign_flip_p` for a number of changes that are not zero: all of them have the same sign."""
    return min(1.0, 2.0 * 0.5**number)


def grouped_share_interval(counts: Sequence[int], sizes: Sequence[int]) -> tuple[float, float]:
    """Interval of a share of trials that come in groups of some `sizes`, of which `counts` have what is counted.

    It is bootstrapped over groups (BCa, 9,999 resamples).  With fewer than three groups, or with the same share in all
    of them, it is Wilson's with one trial for each group; (0, 1) without groups.
    """
    if not counts:
        return 0.0, 1.0
    values, trials = np.asarray(counts, dtype=float), np.asarray(sizes, dtype=float)
    interval = _share_bootstrap(values, trials)
    return interval or _score_interval(float(values.sum() / trials.sum()), len(counts))


def mean_difference_interval(differences: Sequence[float], groups: Sequence[Hashable]) -> tuple[float, float] | None:
    """Student's t interval of the mean of differences between pairs, each with the group that it belongs to.

    Pairs of a group are alike, and pairs that are independent have a group each.  The variance is that of a ratio, of
    the sums of the groups over their sizes, linearised (Cochran 1977, Sampling techniques, section 6.4).  A bootstrap
    of so few groups as there often are would be too narrow: of three, its interval has the true mean in 70 % of cases.
    None with fewer than three groups, or with the same mean in all of them.
    """
    from scipy.special import stdtrit

    found = _mean_difference(differences, groups)
    if found is None:
        return None
    mean, error, freedom = found
    half = stdtrit(freedom, (1 + CONFIDENCE) / 2) * error
    return float(mean - half), float(mean + half)


def mean_difference_p(differences: Sequence[float], groups: Sequence[Hashable]) -> float | None:
    """Two-sided p-value of a mean difference of zero; below 0.05 where the 95 % interval is on one side of it.

    None where there is no `mean_difference_interval`.
    """
    from scipy.special import stdtr

    found = _mean_difference(differences, groups)
    if found is None:
        return None
    mean, error, freedom = found
    return 2.0 * float(stdtr(freedom, -abs(mean) / error))


def _mean_difference(differences: Sequence[float], groups: Sequence[Hashable]) -> tuple[float, float, int] | None:
    """Mean of differences in groups, its standard error, and the degrees of freedom of Student's distribution."""
    number = {group: k for k, group in enumerate(dict.fromkeys(groups))}
    sums, sizes = np.zeros(len(number)), np.zeros(len(number))
    for difference, group in zip(differences, groups, strict=True):
        sums[number[group]] += difference
        sizes[number[group]] += 1
    n = len(number)
    if n < GROUPS_MIN or np.ptp(sums / sizes) <= ROUNDING:
        return None
    mean = sums.sum() / sizes.sum()
    error = np.sqrt(n / (n - 1) * np.square(sums - mean * sizes).sum()) / sizes.sum()
    return float(mean), float(error), n - 1


def _share_bootstrap(values: Floats, sizes: Floats) -> tuple[float, float] | None:
    """Interval of the sum of `values` over that of `sizes`, both by group; None where bootstrapping cannot judge it."""
    from scipy.stats import bootstrap

    if len(values) < 3 or np.ptp(values / sizes) == 0.0:
        return None
    found = bootstrap(
        (values, sizes), lambda a, b, axis=-1: a.sum(axis=axis) / b.sum(axis=axis), paired=True, vectorized=True,
        confidence_level=CONFIDENCE, method="BCa", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def newcombe(both: float, gained: float, lost: float, neither: float) -> tuple[float, float]:
    """Interval of the difference of two shares of independent pairs, of which these many have each outcome.

    It is that of method 10 of Newcombe 1998, "Improved confidence intervals for the difference between binomial
    proportions based on paired data".  It does not shrink to a point where the methods never differ.
    """
    n = both + gained + lost + neither
    share, share_other = (both + gained) / n, (both + lost) / n
    low, high = _score_interval(share, n)
    low_other, high_other = _score_interval(share_other, n)
    phi = _correlation(both, gained, lost, neither)
    below = _joint(share - low, high_other - share_other, phi)
    above = _joint(high - share, share_other - low_other, phi)
    return share - share_other - below, share - share_other + above


def _score_interval(share: float, trials: float) -> tuple[float, float]:
    """Wilson's interval of a share; the number of trials need not be whole."""
    from scipy.special import ndtri

    z = float(ndtri((1.0 + CONFIDENCE) / 2.0))
    centre = (share + z * z / (2.0 * trials)) / (1.0 + z * z / trials)
    half = z * np.sqrt(share * (1.0 - share) / trials + (z / (2.0 * trials)) ** 2) / (1.0 + z * z / trials)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def _joint(a: float, b: float, phi: float) -> float:
    return float(np.sqrt(max(a * a - 2.0 * phi * a * b + b * b, 0.0)))


def _correlation(both: float, gained: float, lost: float, neither: float) -> float:
    """Correlation of two shares, corrected for continuity as in method 10; 0 where one of them is 0 or 1."""
    margins = (both + gained) * (lost + neither) * (both + lost) * (gained + neither)
    if margins == 0:
        return 0.0
    product = float(both * neither - gained * lost)
    if product > 0:
        product = max(product - (both + gained + lost + neither) / 2, 0.0)
    return float(product / np.sqrt(margins))


def ratio_interval(one: Sequence[float], other: Sequence[float]) -> tuple[float, float] | None:
    """Student's t interval of the geometric mean of `one` over `other`, pair by pair, of the logarithms of the ratios.

    None with fewer than three pairs, or if all have the same ratio, which does not tell how it varies.
    """
    logs = np.log(np.asarray(one, dtype=float) / np.asarray(other, dtype=float))
    found = mean_difference_interval(logs.tolist(), range(len(logs)))
    return None if found is None else (float(np.exp(found[0])), float(np.exp(found[1])))
