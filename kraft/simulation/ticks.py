"""When something that happens at a rate is due, in steps of the physics."""

from __future__ import annotations


def steps_of(duration: float, dt: float) -> int:
    """Number of physics steps of `dt` s nearest to a duration (s)."""
    return round(duration / dt)


class Ticks:
    """Events at a rate (1/s), each at the physics step of `dt` s nearest to its time; `number` of them are over."""

    def __init__(self, rate: float, dt: float) -> None:
        self._period, self.number = 1.0 / (rate * dt), 0

    @property
    def due(self) -> int:
        """Physics step of the next event."""
        return round(self.number * self._period)
