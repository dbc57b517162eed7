"""Auxiliary parameters: effects between commands, model and observed poses that any vehicle may be given."""

from __future__ import annotations

from dataclasses import dataclass

from ompl_ext.vehicle import Vehicle

YAW_RATES = ("omega", "yaw_rate", "r", "w")
"""Names of a state component that is the derivative of theta."""


FRICTION_SHARE_MAX = 0.5
"""Largest friction, as a share of the full throttle."""


DEAD_BAND_SHARE_MAX = {"throttle": 0.5, "steering": 0.25}
"""Controls that may have a dead band, and the largest dead band as a share of the largest command."""


def affects_motion(name: str) -> bool:
    """Whether an auxiliary parameter affects the motion: planning does not model it, and is wrong by its effect.

    The others affect only how the vehicle is observed, which planning does not need.
    """
    return name.startswith(("delay", "lag_", "dead_band_", "friction"))


def speed_index(vehicle: Vehicle) -> int:
    """Index of the speed in the state: the first component that is 0 at rest; -1 if there is none."""
    return vehicle.rest_indices[0] if vehicle.rest and vehicle.rest[0] not in YAW_RATES else -1


@dataclass(frozen=True)
class AuxiliaryParameter:
    """A parameter that any model may be extended with; its nominal value is 0, which means no effect."""

    name: str
    unit: str
    min: float
    max: float
    std: float
    """standard deviation of the prior"""
    description: str


def auxiliary_parameters(vehicle: Vehicle) -> dict[str, AuxiliaryParameter]:
    """Auxiliary parameters that apply to a vehicle, by name; none shares a name with a parameter of the model."""
    found = [AuxiliaryParameter("delay", "s", 0.0, 0.5, 0.3, "time until a command takes effect")]
    found += [
        AuxiliaryParameter(f"delay_{name}", "s", 0.0, 0.5, 0.3, f"additional time until {name} takes effect")
        for name in vehicle.controls
    ]
    found += [
        AuxiliaryParameter(f"lag_{name}", "s", 0.0, 2.0, 0.5, f"time constant with which {name} follows its command")
        for name in vehicle.controls
    ]
    full = max(map(abs, vehicle.controls["throttle"])) if "throttle" in vehicle.controls else 0.0
    if full > 0.0 and speed_index(vehicle) >= 0:
        most = FRICTION_SHARE_MAX * full
        found.append(AuxiliaryParameter("friction", "1", 0.0, most, most, "throttle that friction uses up"))
    for name, share in DEAD_BAND_SHARE_MAX.items():
        if name in vehicle.controls:
            most = share * max(map(abs, vehicle.controls[name]))
            unit = "rad" if name == "steering" else "1"
            found.append(AuxiliaryParameter(f"dead_band_{name}", unit, 0.0, most, most, f"{name} without effect"))
    if vehicle.index("theta") >= 0:
        found += [
            AuxiliaryParameter("lever", "m", -1.0, 1.0, 0.5, "tracked point ahead of the model's point"),
            AuxiliaryParameter("side", "m", -0.5, 0.5, 0.2, "tracked point left of the model's point"),
            AuxiliaryParameter("yaw_offset", "rad", -0.5, 0.5, 0.2, "observed yaw less the model's"),
        ]
    return {parameter.name: parameter for parameter in found if parameter.name not in vehicle.parameters}
