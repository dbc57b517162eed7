"""What an identification hands back: plain data, nothing of GTSAM or numba in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from kraft.sysid.settings import Noise
from ompl_ext.arrays import Floats

AT_BOUND: Final = 1e-6
"""Share of the range between the bounds within which a value counts as at a bound, and an auxiliary parameter as 0."""
CORRELATION_HIGH: Final = 0.95
"""Absolute correlation above which two parameters are reported as nearly indistinguishable: a warning."""
CORRELATION_REMOVED: Final = 0.985
"""Absolute correlation above which model selection removes an auxiliary parameter."""
CORRELATION_INDISTINGUISHABLE: Final = 0.99
"""Absolute correlation above which two parameters are indistinguishable, and the model is not identified."""


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter as the data see it, in its unit."""

    value: float
    std: float
    """0 for a frozen parameter"""
    ci95: tuple[float, float]
    """95 % interval, as `Identification.interval` says, cut at the bounds"""
    unit: str
    description: str
    initial: float
    """nominal value before the identification, where the prior is centred"""
    min: float
    max: float
    frozen: bool
    at_bound: bool

    @property
    def is_zero(self) -> bool:
        """Whether it is 0: an extra that is not there."""
        return abs(self.value) <= AT_BOUND * (self.max - self.min)

    @property
    def truncated(self) -> bool:
        """Whether its interval reaches to a bound that the value is not at: the data do not bound it on that side."""
        return not (self.frozen or self.at_bound) and (self.ci95[0] <= self.min or self.ci95[1] >= self.max)

    @property
    def interval_note(self) -> str:
        """What is said after its interval, if anything."""
        return ", at its bound" if self.at_bound else ", cut at its bound" if self.truncated else ""


@dataclass(frozen=True)
class PartFit:
    """An uninterrupted stretch of a log, as the graph explains it: K + 1 states, n poses."""

    times: Floats
    """(K + 1,) of the states, s"""
    states: Floats
    """(K + 1, nx) smoothed"""
    controls: Floats
    """(K, nu) applied between the states"""
    pose_times: Floats
    """(n,) s"""
    poses: Floats
    """(n, 3) observed x, y (m), yaw (rad)"""
    fitted: Floats
    """(n, 3) the same as the smoothed states say"""
    weights: Floats
    """(n,) what the robust loss leaves of each observation, 1 for all of it"""

    @property
    def residuals(self) -> Floats:
        """(n, 3) observed less fitted, m, m, rad."""
        difference: Floats = self.poses - self.fitted
        return difference


@dataclass(frozen=True)
class LogFit:
    """What the graph makes of a log."""

    name: str
    parts: tuple[PartFit, ...]


@dataclass(frozen=True)
class Identification:
    """Parameters, how well they are known, and what is wrong with them."""

    model: str
    parameters: Mapping[str, ParameterEstimate]
    """the model's own in its order, then the extras that were kept"""
    auxiliary: tuple[str, ...]
    """names of those"""
    names: tuple[str, ...]
    """of the parameters that were estimated, in the order of `covariance`"""
    covariance: Floats
    """(names, names), of the kind that `interval` says"""
    interval: Literal["graph", "sandwich"]
    """whether uncertainty follows from the stated noise, or from how much the logs differ"""
    graph_covariance: Floats
    """(names, names) that follows from the stated noise"""
    unidentified: tuple[str, ...]
    """parameters about which the data say next to nothing beyond the prior"""
    converged: bool
    iterations: int
    """of the optimiser, trying extras included"""
    cost: float
    """half of the weighted squared residuals at the end, priors included"""
    noise: Noise
    """of the poses, stated or measured"""
    noise_measured: bool
    process: Mapping[str, float]
    """by state component, per square root of a second"""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    """decisions that were taken for the user, such as which extras were kept"""
    logs: tuple[LogFit, ...]
    rear_axle: float | None
    """how far the tracked point is ahead of the axle that does not slip sideways, m; None without steering"""

    @property
    def values(self) -> dict[str, float]:
        """Value of each parameter, extras included."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    @property
    def correlation(self) -> Floats:
        """(names, names) correlation of what was estimated."""
        return correlations(self.covariance)


def correlations(covariance: Floats) -> Floats:
    """(n, n) correlations of what has this covariance (n, n)."""
    std = covariance.diagonal() ** 0.5
    found: Floats = covariance / (std[:, None] * std[None, :])
    return found


@dataclass(frozen=True)
class PredictionErrors:
    """Root mean square errors of open-loop prediction."""

    position: Mapping[float, float]
    """m, by time since the window's start (1, 2, 3 s); a time that no window reaches is left out"""
    yaw: Mapping[float, float]
    """rad, likewise"""
    overall_position: float
    """over all poses of all windows, m"""
    overall_yaw: float
    """rad"""
    windows: int
    poses: int
