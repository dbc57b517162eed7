"""Interface of all controllers."""

from __future__ import annotations

from typing import Protocol

from kraft.driving.messages import Estimate, Reference
from ompl_ext.arrays import Floats


class Controller(Protocol):
    """Tracks a reference; each call may pass a new one."""

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) to send at the estimate's time, within the actuators' bounds."""
