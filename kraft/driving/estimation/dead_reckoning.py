"""A known state and the commands since then: where the model says the vehicle is now."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator

from ompl_ext.arrays import Floats

Advance = Callable[[Floats, Floats, float], Floats]
"""Takes a state (nx,), a control (nu,) and a duration (s) to the state after it."""


class Commands:
    """What was commanded when: each control (nu,) is held until the next; before the first one `rest`."""

    def __init__(self, rest: Floats) -> None:
        self._times: list[float] = [-math.inf]
        self._controls: list[Floats] = [rest.copy()]

    def add(self, time: float, control: Floats) -> None:
        """Hold `control` from `time` (s) on; times ascend, and of two controls at one time the later one counts."""
        if time < self._times[-1]:
            raise ValueError(f"commanded at {time} s after a command at {self._times[-1]} s")
        if time == self._times[-1]:
            self._controls[-1] = control.copy()
            return
        self._times.append(time)
        self._controls.append(control.copy())

    def between(self, begin: float, end: float) -> Iterator[tuple[Floats, float]]:
        """Controls held from `begin` to `end` (s), each with for how long (s)."""
        if begin < self._times[0]:
            raise ValueError(f"the commands before {self._times[0]} s are forgotten, {begin} s is asked for")
        k = bisect_right(self._times, begin) - 1
        while begin < end:
            until = min(self._times[k + 1], end) if k + 1 < len(self._times) else end
            yield self._controls[k], until - begin
            begin, k = until, k + 1

    def forget(self, before: float) -> None:
        """Drop what nobody needs who asks about `before` (s) and later."""
        k = bisect_right(self._times, before) - 1
        del self._times[:k], self._controls[:k]


class DeadReckoning:
    """Prediction from an anchor, a state at a time (s), along the commands.

    The latest prediction is kept, so that a vehicle that is not seen for long costs no more than one that is.
    """

    def __init__(self, advance: Advance, rest: Floats, time: float, state: Floats) -> None:
        self._advance = advance
        self.commands = Commands(rest)
        self.reset(time, state)

    def reset(self, time: float, state: Floats, keep: float = math.inf) -> None:
        """Predict from `state` at `time` (s) from now on; keep the commands since `keep` (s) if that is earlier."""
        self.time, self._state = time, state.copy()
        self._latest = self.time, self._state
        self.commands.forget(min(time, keep))

    def command(self, time: float, control: Floats) -> None:
        """Hold `control` (nu,) from `time` (s) on."""
        if time < self._latest[0]:
            self._latest = self.time, self._state
        self.commands.add(time, control)

    def at(self, time: float) -> Floats:
        """Predicted state at `time` (s); before the anchor it is the anchor's."""
        if time < self._latest[0]:
            self._latest = self.time, self._state
        begin, state = self._latest
        self._latest = max(begin, time), self.propagate(state, begin, time)
        return self._latest[1].copy()

    def propagate(self, state: Floats, begin: float, end: float) -> Floats:
        """State (nx,) that another `state` at `begin` leads to at `end` (s), as far back as commands are kept."""
        for control, duration in self.commands.between(begin, end):
            state = self._advance(state, control, duration)
        return state
