"""Settings of an identification; the defaults suit most logs."""

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
    iterations: int = 50
    """largest number of iterations of one fit"""
