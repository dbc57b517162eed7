"""What an identification takes and gives, as plain data without types of GTSAM or numba: its settings and its result.

The defaults of the settings suit most logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from ompl_ext.arrays import Floats

AuxiliarySelection = Literal["auto", "plan", "none"] | tuple[str, ...]
SELECTIONS: Final = ("auto", "plan", "none")
GRAPHS: Final[tuple[Literal["fast", "paper"], ...]] = ("fast", "paper")
"""Forms of the factor graph."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one observed pose."""

    position: float
    """in x and in y, m"""
    yaw: float
    """rad"""


@dataclass(frozen=True)
class Settings:
    """Settings of an identification; the same settings and logs give the same result."""

    noise: Noise | None = None
    """of the poses; measured from them if None"""
    process: Mapping[str, float] = field(default_factory=dict)
    """process noise by state component, in its unit per square root of a second; defaults for components not named"""
    variation: Mapping[str, float] = field(default_factory=dict)
    """standard deviation of the changes of a parameter during a drive, in its unit; those of the vehicle for others"""
    control_noise: Mapping[str, float] = field(default_factory=dict)
    """standard deviation of the applied control from the command, by control; by default a hundredth of its range"""
    robust: float | None = 1.345
    """residual, in standard deviations, above which the weight of an observation decreases (Huber loss); None for
    squares"""
    frozen: tuple[str, ...] = ()
    """parameters that keep their value"""
    values: Mapping[str, float] = field(default_factory=dict)
    """nominal values in place of those of the vehicle, for parameters of the model and auxiliary ones"""
    auxiliary: AuxiliarySelection = "auto"
    """auxiliary parameters (`kraft.sysid.parameters`): automatic model selection, the same without those that affect
    the motion, which planning does not model, none, or those named"""
    graph: Literal["fast", "paper"] = "fast"
    """the factor graph with states and controls eliminated in compiled code, or every factor explicit"""
    step: float = 0.05
    """time between two states, s"""
    horizon: float = 3.0
    """time over which a model with terms to choose is to predict well, s"""
    clock_offset: float | None = None
    """most that commands may be recorded later than they act, s, which is how far a delay may be negative; None:
    0.1 s if the vehicle turns before it is steered, else 0"""
    iterations: int = 100
    """largest number of iterations of one fit"""

    def __post_init__(self) -> None:
        """Take lists of names.

        Raises:
            TypeError: if `frozen` is one name instead of several, or noise is no `Noise`.
        """
        if isinstance(self.frozen, str):
            raise TypeError(f"frozen: expected a tuple of names, not the text {self.frozen!r}")
        if not isinstance(self.noise, Noise | None):
            raise TypeError(f"noise: expected a kraft.sysid.Noise, not {type(self.noise).__name__}")
        object.__setattr__(self, "frozen", tuple(self.frozen))
        if not isinstance(self.auxiliary, str):
            object.__setattr__(self, "auxiliary", tuple(self.auxiliary))


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
    """Estimate of one parameter, in its unit."""

    value: float
    std: float
    """0 for a frozen parameter"""
    ci95: tuple[float, float]
    """95 % interval of the kind `Identification.interval`, truncated at the bounds"""
    unit: str
    description: str
    initial: float
    """nominal value before the identification, where the prior is centred"""
    min: float
    max: float
    frozen: bool
    at_bound: bool
    variation: float = 0.0
    """standard deviation with which it varies from drive to drive and during one"""

    @property
    def is_zero(self) -> bool:
        """Whether the value is 0: an auxiliary parameter without effect."""
        return abs(self.value) <= AT_BOUND * (self.max - self.min)

    @property
    def truncated(self) -> bool:
        """Whether the interval reaches a bound although the value is not at one: the data do not bound it there."""
        return not (self.frozen or self.at_bound) and (self.ci95[0] <= self.min or self.ci95[1] >= self.max)

    @property
    def decimals(self) -> int:
        """Number of decimals for a table: two digits of the standard deviation, or of a quarter of the interval.

        The interval is the smaller of the two where the data do not bound the parameter, and the bounds do.
        """
        width = self.ci95[1] - self.ci95[0]
        size = min(self.std, width / 4 if width > 0 else math.inf) if self.std > 0 else abs(self.value) / 1000
        return min(max(1 - math.floor(math.log10(size)), 0), 6) if size > 0 else 4

    @property
    def interval_note(self) -> str:
        """Note after the interval in a table; empty if there is none."""
        return ", at its bound" if self.at_bound else ", truncated at its bound" if self.truncated else ""


@dataclass(frozen=True)
class PartFit:
    """Fit of an uninterrupted part of a log: K + 1 states, n poses."""

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
    """(n, 3) the same poses predicted from the smoothed states"""
    weights: Floats
    """(n,) weight of each observation under the robust loss, 1 for inliers"""

    @property
    def residuals(self) -> Floats:
        """(n, 3) observed less fitted, m, m, rad."""
        difference: Floats = self.poses - self.fitted
        return difference


@dataclass(frozen=True)
class LogFit:
    """Fit of a log."""

    name: str
    parts: tuple[PartFit, ...]


@dataclass(frozen=True)
class ModelTrial:
    """One model of those that the identification chose from, judged on logs that it was not fitted to."""

    model: str
    terms: tuple[str, ...]
    """parameters that could be switched off and are on"""
    without: str
    """those that were switched off last, separated by commas; empty for the first model"""
    errors: Mapping[float, float]
    """position error by time since the beginning of a window (s), m; without times that no window reaches"""
    chosen: bool
    added: str = ""
    """those that were switched on again at the end, separated by commas"""
    on_fitted: bool = False
    """whether the errors are of the logs that it was fitted to, because there are too few to leave one out"""


@dataclass(frozen=True)
class Identification:
    """Identified parameters with their uncertainty, warnings and the fit of each log."""

    model: str
    parameters: Mapping[str, ParameterEstimate]
    """those of the model in its order, then the auxiliary parameters that were kept"""
    auxiliary: tuple[str, ...]
    """names of the auxiliary parameters"""
    names: tuple[str, ...]
    """names of the estimated parameters, in the order of `covariance`"""
    covariance: Floats
    """(names, names), of the kind `interval`"""
    interval: Literal["graph", "sandwich"]
    """source of the uncertainty: the stated noise, or the differences between logs"""
    graph_covariance: Floats
    """(names, names) under the stated noise"""
    unidentified: tuple[str, ...]
    """parameters whose uncertainty the data hardly reduce below that of the prior"""
    converged: bool
    iterations: int
    """of the optimiser, those of model selection included"""
    cost: float
    """half of the weighted squared residuals at the end, priors included"""
    noise: Noise
    """of the poses, stated or measured"""
    noise_measured: bool
    process: Mapping[str, float]
    """by state component, per square root of a second"""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    """decisions that were taken, such as which auxiliary parameters were kept"""
    logs: tuple[LogFit, ...]
    rear_axle: float | None
    """distance of the tracked point ahead of the rear axle, m; None without steering"""
    models: tuple[ModelTrial, ...] = ()
    """models that were compared by predicting logs that they were not fitted to from the poses before each window"""
    trials: tuple[ModelTrial, ...] = ()
    """steps of the choice of terms, if the model has such, compared by predicting logs that it was not fitted to"""
    off: tuple[str, ...] = ()
    """parameters of the model that are off"""
    without_log: tuple[Mapping[str, float], ...] = ()
    """for each log, the values that the others give, to first order; empty for one log, and where the folds of a
    cross-validation are not the logs"""

    @property
    def values(self) -> dict[str, float]:
        """Value of each parameter, auxiliary ones included."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    def predicting(self, settings: Settings) -> Settings:
        """Settings for predictions with what was identified beside the parameters: process noise and variation."""
        process = self.process if self.trials else {}
        return replace(
            settings,
            process={**process, **settings.process},
            variation={
                **{name: p.variation for name, p in self.parameters.items() if p.variation},
                **settings.variation,
            },
        )

    @property
    def correlation(self) -> Floats:
        """(names, names) correlation of the estimated parameters; 0 of one whose estimates without a log are all alike.

        Those are alike, to the last bit, where no log shows the parameter.
        """
        return np.nan_to_num(correlations(self.covariance))


def correlations(covariance: Floats) -> Floats:
    """(n, n) correlations for a covariance (n, n); NaN for what does not vary."""
    std = covariance.diagonal() ** 0.5
    with np.errstate(invalid="ignore"):
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
