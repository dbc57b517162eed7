"""Where a car is along the reference it follows, kept from command to command."""

from __future__ import annotations

import copy
import math

from kraft.control.path import Path, Place, paths_of
from kraft.driving import Reference
from kraft.model import Model
from ompl_ext.arrays import Floats


class Guide:
    """The paths of the present reference, the one that is followed, and the car's nearest sample on it.

    The point of the car that is led is `lead` m ahead of its centre, and behind it where the car backs up.
    """

    def __init__(self, model: Model, lead: float, window: int) -> None:
        self._model, self._lead, self._window = model, lead, window
        self._reference: Reference | None = None
        self._paths: tuple[Path, ...] = ()
        self._part = self._near = 0

    def __deepcopy__(self, memo: object) -> Guide:
        """Model, reference and paths are never written to: a copy shares them."""
        return copy.copy(self)

    @property
    def path(self) -> Path:
        """The path that is followed."""
        return self._paths[self._part]

    @property
    def is_last(self) -> bool:
        """Whether nothing follows this path."""
        return self._part == len(self._paths) - 1

    def take(self, reference: Reference, time: float) -> None:
        """Follow a reference; of a new one the part that is planned for `time` (s), from where the car should be."""
        if reference is self._reference:
            return
        self._reference, self._paths = reference, paths_of(reference, self._model, self._lead)
        self._begin(0, time)
        self.keep_time(time)

    def keep_time(self, time: float) -> None:
        """Go on to the part that is planned for `time` (s)."""
        while not self.is_last and time >= self.path.time[-1]:
            self._begin(self._part + 1, time)

    def go_on(self, time: float) -> None:
        """Go on to the next part."""
        self._begin(self._part + 1, time)

    def locate(self, state: Floats) -> Place:
        """The place beside the point of the car that is led, searched from the previous one on."""
        model, lead = self._model, self._lead * self.path.direction
        theta = float(state[model.theta])
        x, y = float(state[model.x]) + lead * math.cos(theta), float(state[model.y]) + lead * math.sin(theta)
        place = self.path.place(x, y, self._near, self._window)
        self._near = place.index
        return place

    def _begin(self, part: int, time: float) -> None:
        self._part = part
        self._near = self.path.sample(self.path.distance_at(time))
