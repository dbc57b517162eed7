"""Where trials run.  Everything else of an evaluation is the same wherever that is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol, TypeAlias

from kraft.evaluation.job import Job
from kraft.evaluation.row import TrialRow

Stop: TypeAlias = Callable[[], bool]
Say: TypeAlias = Callable[[str], None]

DEATHS: Final = 2
"""A trial whose worker died this often has failed."""


class Executor(Protocol):
    """Runs trials."""

    def run(self, jobs: Sequence[Job], stop: Stop, say: Say) -> Iterator[TrialRow]:
        """Yield the row of every job once, in whatever order they end.

        As soon as `stop()` is true no further trial is begun, and those that run are waited for.  Closing the
        iterator drops them.  A trial whose worker dies is begun again on another one, until it has died
        too often; then its row says so.

        Raises:
            InputError, MissingError: from a trial, see `kraft.evaluation.job.perform`, or if there is nowhere to run.
        """
        ...
