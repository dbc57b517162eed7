"""Rows of a stream as numbers, in ascending time; what is left out becomes a finding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.log import Array, Findings
from kraft.logs.streams import Stream
from kraft.logs.table import Flags, Rows

BACKWARD_MAX: Final = 0.2
"""Largest share of rows that run backwards in time; a file with more holds several recordings."""
TIED_MAX: Final = 0.5
"""Largest share of rows with another value at the time stamp of the row before; a clock with more is too coarse."""
VALUE_MAX: Final = 1e30
"""Largest plausible value in any unit; larger ones are corrupt bytes."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows of a stream.

    Attributes:
        what: commands, poses, ...
        stream: stream of the samples.
        times: strictly ascending, shape (n,), s.
        values: SI units and radians, shape (n, channels).
        index: row of each sample in the table, shape (n,).
    """

    what: str
    stream: Stream
    times: Array
    values: Array
    index: Rows

    def __len__(self) -> int:
        return len(self.times)

    def where(self, i: int) -> str:
        """Row of sample ``i``, as text."""
        return self.stream.table.where(int(self.index[i]))

    def keep(self, flags: Flags) -> Samples:
        """Return the flagged samples."""
        return Samples(self.what, self.stream, self.times[flags], self.values[flags], self.index[flags])

    def shifted(self, origin: float) -> Samples:
        """Return the samples with times from ``origin`` on, s."""
        return Samples(self.what, self.stream, self.times - origin, self.values, self.index)

    def diagnostic(self, problem: str, expected: str, i: int | None = None, code: Code = Code.DATA) -> Diagnostic:
        """Make a diagnostic for all of them or for one."""
        return self.stream.table.diagnostic(problem, expected, None if i is None else int(self.index[i]), code)

    def refuse(self, problem: str, expected: str, i: int | None = None, code: Code = Code.DATA) -> InputError:
        """Make an error for all of them or for one."""
        return InputError([self.diagnostic(problem, expected, i, code)])


def read_samples(what: str, stream: Stream, findings: Findings, rows: str = "") -> Samples:
    """Read the samples of a stream; findings about times name them ``rows``, if given, instead of ``what``.

    Raises:
        InputError: if there are no samples, or if time runs backwards too often.
    """
    index = np.flatnonzero(stream.present())
    samples = Samples(what, stream, stream.times()[index], stream.values()[index], index)
    return _forward(_numbers(samples, findings), findings, rows or what)


def _numbers(samples: Samples, findings: Findings) -> Samples:
    cells = np.column_stack([samples.times, samples.values])
    finite = np.abs(cells) < VALUE_MAX  # neither NaN nor infinite, and its square is finite
    good: Flags = np.all(finite, axis=1)
    if not good.any():
        columns = [c.column for c in (samples.stream.time, *samples.stream.channels)]
        empty = [name for name, bad in zip(columns, ~np.any(finite, axis=0), strict=True) if bad]
        problem = f"{samples.what}: no row has numbers in all of {', '.join(columns)}"
        problem += f"; {', '.join(empty)} has none at all" if empty else ""
        raise samples.refuse(problem, "expected numbers", 0 if len(samples) else None)
    if not good.all():
        first, bad = int(np.argmin(good)), int(np.sum(~good))
        text = f"{bad} of {len(good)} {samples.what} are not numbers (NaN), first in {samples.where(first)}; left out"
        findings.add("nan", bad, text)
    return samples.keep(good)


def _forward(samples: Samples, findings: Findings, rows: str) -> Samples:
    times, few = samples.times, max(1.0, BACKWARD_MAX * len(samples))
    wrong: Flags = times < np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]])
    ahead: Flags = times > np.concatenate([np.minimum.accumulate(times[::-1])[::-1][1:], [np.inf]])
    if wrong.any():
        how, first = "runs backwards", int(np.argmax(wrong))
        by = times[first - 1] - times[first]
        if ahead.sum() < wrong.sum() and ahead.sum() <= few:  # a damaged stamp, after which all others seem to go back
            how, wrong, first = "jumps ahead and back", ahead, int(np.argmax(ahead))
        bad = int(np.sum(wrong))
        fact = f"time {how} in {bad} of {len(samples)} {rows}"
        if bad > few:
            expected = "expected ascending time stamps; put each recording into a file of its own"
            raise samples.refuse(f"{fact}, first by {by:.6g} s", expected, first)
        findings.add("backward", bad, f"{fact}, first in {samples.where(first)}; left out")
        samples = samples.keep(~wrong)
    twice = np.diff(samples.times, prepend=-np.inf) <= 0.0
    other = np.any(np.diff(samples.values, axis=0, prepend=np.nan) != 0.0, axis=1)
    tied = twice & other  # a recorder may repeat a whole row
    if tied.sum() > max(1.0, TIED_MAX * len(samples)):
        column = samples.stream.time.column
        fact = f"{int(tied.sum())} of {len(samples)} {rows} have the {column} of the one before, and other numbers"
        expected = "expected a time stamp of its own for each row: is this clock rounded, or another column its rest?"
        raise samples.refuse(fact, expected, int(np.argmax(tied)))
    if twice.any():
        first, bad = int(np.argmax(twice)), int(np.sum(twice))
        fact = f"{bad} of {len(times)} {rows} have the time stamp of the one before"
        findings.add("duplicate", bad, f"{fact}, first in {samples.where(first)}; left out")
    return samples.keep(~twice)
