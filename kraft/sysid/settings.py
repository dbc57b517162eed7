"""What a user may decide about an identification; everything has a default that suits most logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

AuxiliarySelection = Literal["auto", "plan", "none"] | tuple[str, ...]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one observed pose."""

    position: float
    """in x and in y, m"""
    yaw: float
    """rad"""


@dataclass(frozen=True)
class Settings:
    """How to identify; same settings and logs, same result."""

    noise: Noise | None = None
    """of the poses; measured from them if None"""
    process: Mapping[str, float] = field(default_factory=dict)
    """what the model misses, by state component, in its unit per square root of a second; the rest has defaults"""
    control_noise: Mapping[str, float] = field(default_factory=dict)
    """how far the control applied in a step strays from the command, by control; by default a hundredth of its range"""
    robust: float | None = 1.345
    """residual, in standard deviations, above which an observation counts less (Huber's loss); None for squares"""
    frozen: tuple[str, ...] = ()
    """parameters that keep their value"""
    values: Mapping[str, float] = field(default_factory=dict)
    """nominal values in place of the vehicle's, for parameters and extras"""
    auxiliary: AuxiliarySelection = "auto"
    """parameters beside the model's own (`kraft.sysid.parameters`): those that the data show, the same without those
    that belong to the motion, which planning does not know, those named, or none"""
    graph: Literal["fast", "paper"] = "fast"
    """the factor graph with states and controls eliminated in compiled code, or every factor explicit"""
    step: float = 0.05
    """time between two states, s"""
    iterations: int = 50
    """most iterations of the optimiser"""
