"""When the controller asks the planner for the next decision: earlier, the longer the latest ones have taken."""

from __future__ import annotations

import math
import statistics
from collections import deque
from typing import Final

RECENT: Final = 5
"""Number of decisions whose duration tells how early the next one has to be asked for.

Fewer would miss that decisions alternate between quick and slow ones; after more, one slow decision would let all plans
begin from old poses for long.
"""
HURRY: Final = 1.3
"""How much earlier than the slowest of them it is asked for: the next one may take longer than all of them."""
LEAD_MAX: Final = 0.6
"""Share of a cycle before its beginning that is the earliest time to ask: the rest is for the search."""
LATEST: Final = 0.5
"""Share of the present lead before a cycle begins, below which it is left out: a decision would come too late."""
KEPT: Final = 1000
"""Number of the latest decisions of which the median duration is told: minutes of a drive, in bounded memory."""


class DecisionRequests:
    """Which cycle the planner is asked to decide, and when.

    Times are those at which commands that are sent now act, s of the drive: cycles begin by this clock.

    Args:
        cycle: duration of a cycle, s.
        lead: least time before a cycle begins at which its decision is asked for, s.
    """

    def __init__(self, cycle: float, lead: float) -> None:
        self._cycle, self._least = cycle, lead
        self._lead, self._next = lead, 0
        self._asked: float | None = None  # time of the request that is not answered yet
        self._delays: deque[float] = deque(maxlen=KEPT)

    def is_due(self, now: float) -> bool:
        """Whether to ask now: not while the planner works on the last request."""
        return self._asked is None and now >= self._next * self._cycle - self._lead

    @property
    def following(self) -> int:
        """Least number of a cycle that may still be asked for."""
        return self._next

    def ask(self, now: float) -> int:
        """Note a request; returns the number of the cycle to decide.  Those that begin too soon are left out."""
        number = max(self._next, math.ceil((now + LATEST * self._lead) / self._cycle))
        self._asked, self._next = now, number + 1
        return number

    def answered(self, now: float) -> None:
        """Note that the answer to the last request has arrived."""
        assert self._asked is not None, "an answer has a request"
        self._delays.append(now - self._asked)
        self._asked = None
        slowest = HURRY * max(list(self._delays)[-RECENT:])
        self._lead = min(max(self._least, slowest), LEAD_MAX * self._cycle)

    def waited(self, now: float) -> float:
        """Time for which the planner has not answered, s; 0 if nothing is asked."""
        return 0.0 if self._asked is None else now - self._asked

    @property
    def median_delay(self) -> float:
        """Median time from a request to its answer, s; not a number before the first answer."""
        return statistics.median(self._delays) if self._delays else math.nan
