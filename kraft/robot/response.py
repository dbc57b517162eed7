"""Whether the vehicle turns to the side to which it is steered, as the poses show.

Steering that is mounted or scaled the other way round, and poses that are mirrored, look alike: the controller then
steers away from the plan, and nothing that is learned can make up for it.
"""

from __future__ import annotations

import math
from typing import Final

from kraft.robot.poses import Pose

TURN: Final = math.radians(40.0)
"""Turn by the commands after which the turn of the poses is compared with it, rad."""
OPPOSITE: Final = 0.4
"""Share of it by which the poses turn to the other side if something is the wrong way round."""
GAP: Final = 0.5
"""Time between two poses after which the comparison begins again, s."""


class Response:
    """Compares the turns by the commands and the model, without anything learned, with those of the poses.

    Turns to both sides add up with their signs, so that a lag of the steering matters little.  `trouble` says what is
    wrong; once found it stays, as the vehicle cannot be driven.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._commanded = self._seen = 0.0
        self._last: tuple[float, float] | None = None  # time of a pose, s, and its heading, rad

    def commanded(self, turn: float) -> None:
        """Add a turn (rad) that the commands lead to by the model."""
        self._commanded += turn

    def observed(self, time: float, pose: Pose) -> None:
        """Take a pose at a time (s)."""
        if self._last is None or time - self._last[0] > GAP:
            self._commanded = self._seen = 0.0
        else:
            self._seen += math.remainder(pose[2] - self._last[1], math.tau)
        self._last = time, pose[2]
        if abs(self._commanded) < TURN:
            return
        if self._seen * math.copysign(1.0, self._commanded) < -OPPOSITE * abs(self._commanded):
            seen, commanded = (round(math.degrees(each)) for each in (self._seen, self._commanded))
            self.trouble = (
                f"the poses turn by {seen:+d} degrees where the commands lead to {commanded:+d}: the steering is the "
                "wrong way round (command.steering.scale, or sides that are swapped), or the poses are mirrored"
            )
        self._commanded = self._seen = 0.0
