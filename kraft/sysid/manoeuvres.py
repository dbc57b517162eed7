"""Which manoeuvre the logs lack when parameters cannot be told apart or are not seen at all."""

from __future__ import annotations

from typing import Final

from kraft.sysid.parameters import Parameters

_TURNS: Final = "arcs to the left and to the right, of several radii"
_STEPS: Final = "steps of the throttle up and down, from rest and back to it"
_LEVELS: Final = "stretches at several constant throttles, low ones too"
_CHANGES: Final = "sudden changes of the commands while driving"
_KNOWN: Final = {
    "L": _TURNS,
    "phi_diff": _TURNS,
    "v_delta": _LEVELS,
    "tau": _STEPS,
    "u_0": _LEVELS,
    "delay": _CHANGES,
    "friction": _STEPS,
    "dead_band_throttle": _LEVELS,
    "dead_band_steering": _TURNS,
    "lever": _TURNS,
    "side": _TURNS,
    "yaw_offset": _TURNS,
}


def lacking(parameters: Parameters, *names: str) -> str:
    """The manoeuvres that would show some parameters, for a sentence."""
    controls = ", ".join(parameters.vehicle.controls)
    general = f"steps of each command ({controls}) one at a time, at several levels and of both signs"
    found = dict.fromkeys(_of(name, general) for name in names)
    return " and ".join(found)


def _of(name: str, general: str) -> str:
    return _CHANGES if name.startswith(("delay_", "lag_")) else _KNOWN.get(name, general)
