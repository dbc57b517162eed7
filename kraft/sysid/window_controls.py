"""Controls that act in windows and before them, which fits of the same windows with other terms share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Final, TypeVar

import numpy as np

from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.chains import Chains, Segment, chains_of
from kraft.sysid.initial_values import SmoothedPoses, smooth_chains
from kraft.sysid.parameters import Parameters, steering_offset
from kraft.sysid.windows import Acting, Windows, controls_in_parts, places
from ompl_ext.arrays import Floats, Ints, Matrix

LEAD, SETTLING = 1.0, 1.0
"""Time before a window whose commands show components of its initial state that poses do not show, and time for which
the command before is held, s."""
KEPT: Final = 16
"""Number of values of the actuator parameters for which the acting controls are kept: more than the nine of a
linearisation, whose threads only read."""

Found = TypeVar("Found")


class WindowControls:
    """Windows as chains of steps, and the controls that act in and before them; kept for the last `KEPT` values."""

    def __init__(self, windows: Windows, parameters: Parameters) -> None:
        """Stack the windows; of the parameters only the names matter, and the limits of the controls."""
        self.windows, self._parameters = windows, parameters
        self.chains: Chains = chains_of(windows.segments, len(windows.segments))
        self.actuators = ActuatorModel(windows.segments, parameters)
        self._during: dict[bytes, tuple[Acting, Ints, Matrix]] = {}
        self._before: dict[bytes, Acting] = {}

    @cached_property
    def smoothed(self) -> SmoothedPoses:
        """Smoothed poses of the windows at the times of the steps."""
        return smooth_chains(self.chains)

    @cached_property
    def components(self) -> list[int]:
        """Indices of the components of rho on which the acting controls depend."""
        p, acts = self._parameters, ("delay", "lag_", "play_", "dead_band_")
        found = [k for k, name in enumerate(p.names) if k >= p.model_size and name.startswith(acts)]
        if p.auxiliary_index("play_steering") >= 0 and (k := steering_offset(p)) >= 0:
            found.append(k)
        return found

    def during(self, rho: Floats) -> tuple[Acting, Ints, Matrix]:
        """Controls that act in the windows, and `places` of the poses."""
        return _kept(self._during, rho[self.components], lambda: self._find_during(rho))

    def before(self, rho: Floats) -> Acting:
        """Controls before the windows, the first of them held until the state has settled."""
        return _kept(self._before, rho[self.components], lambda: self._find_before(rho))

    def _find_during(self, rho: Floats) -> tuple[Acting, Ints, Matrix]:
        acting = controls_in_parts(self.actuators, self.chains, rho, halved=self.windows.halved)
        return acting, *places(acting, self.chains, self.windows)

    def _find_before(self, rho: Floats) -> Acting:
        chains = chains_of(self._leads, len(self._leads))
        led = controls_in_parts(self._actuators_before, chains, rho, halved=self.windows.halved)
        settling = round(SETTLING / float(self.windows.h.min()))
        held = np.repeat(led.controls[:1], settling, axis=0)
        durations = np.concatenate([np.tile(self.windows.h[led.window], (settling, 1)), led.h])
        controls = np.concatenate([held, led.controls])
        return replace(led, controls=controls, h=durations, first=led.first + settling)

    @cached_property
    def _leads(self) -> list[Segment]:
        """The time before each window, in as many steps for each."""
        steps = math.ceil(LEAD / float(self.windows.h.min()))
        none = slice(0, 0)
        return [replace(s, begin=s.begin - steps * s.h, steps=steps, poses=none) for s in self.windows.segments]

    @cached_property
    def _actuators_before(self) -> ActuatorModel:
        return ActuatorModel(self._leads, self._parameters)


def _kept(known: dict[bytes, Found], values: Floats, find: Callable[[], Found]) -> Found:
    """What is known for some values, or is found for them and kept in place of what was found first."""
    key = values.tobytes()
    if key not in known:
        if len(known) >= KEPT:
            del known[next(iter(known))]
        known[key] = find()
    return known[key]
