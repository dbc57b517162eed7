"""What every controller can do."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.messages import Estimate, Reference
from ompl_ext.arrays import Floats


class Controller(Protocol):
    """Tracks a reference; a new one may come with any call."""

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) to send at the estimate's time, within the actuators' bounds."""
