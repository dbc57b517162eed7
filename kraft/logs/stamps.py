"""Which stamp of a bag's messages counts: the sender's in the header, or the recorder's where those disagree."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from kraft.logs.choice import Choice, Stream
from kraft.logs.table import LOG_TIME, STAMP

STAMP_TOLERANCE: Final = 1.0
"""How far the clocks of the senders and of the recorder may be apart, s."""


def on_one_clock(choice: Choice) -> Choice:
    """Take the recorder's stamps for all streams if the senders' of some are by another clock than those of the rest.

    Only what was chosen is judged: a latched topic that nobody reads may be hours old.  A clock that the mapping file
    names is kept.
    """
    streams = [stream for _, stream in choice.streams() if stream.table.topic]
    lags = [_lag(stream) for stream in streams if stream.time.column in (STAMP, LOG_TIME)]
    if not lags or max(lags) - min(lags) <= STAMP_TOLERANCE:
        return choice
    note = f"the stamps in the headers are up to {max(map(abs, lags)):.3g} s off"
    dead_man = choice.dead_man
    return replace(
        choice,
        commands=tuple(_by_recorder(stream, note) for stream in choice.commands),
        poses=_by_recorder(choice.poses, note),
        dead_man=None if dead_man is None else _by_recorder(dead_man, note),
    )


def _lag(stream: Stream) -> float:
    """How far a stream's clock is from the recorder's, s."""
    return float(np.median(stream.times() - stream.table.columns[LOG_TIME]))


def _by_recorder(stream: Stream, note: str) -> Stream:
    if stream.time.place is not None:
        return stream
    return replace(stream, time=replace(stream.time, column=LOG_TIME, note=note))
