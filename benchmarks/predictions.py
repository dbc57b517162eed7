"""Predictions of the closed loop with fewer updates of the controls than commands: drives in pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from benchmarks import peers_table
from benchmarks.effort import Effort
from benchmarks.parallel import each
from benchmarks.report import Report, Row, number, row
from benchmarks.tuning import changed
from kraft.driving.control_settings import Predictive
from kraft.driving.method import load_method
from kraft.trial.result import Outcome

ROWS: Final = ("mppi", "nmpc", "dwa", "kraft-mppi", "kraft-nmpc")
SEED: Final = 1001
"""First seed; no setting was chosen with it."""


def run(effort: Effort) -> Report:
    """Drive every row in every entry of the suites, with an update for each command and as it is bundled."""
    peers_table.compile_all()
    total = 2 * len(ROWS) * len(peers_table.entries()) * effort.peer_tuning
    drives = each(partial(drive, seeds=effort.peer_tuning), range(total), effort.jobs)
    pairs = list(zip(drives[::2], drives[1::2], strict=True))
    rows = [each for name in ROWS for each in rows_of(name, [pair for pair in pairs if pair[0].name == name])]
    note = f"In all entries of the suites `paper` and `hard`, {effort.peer_tuning} seed(s) from {SEED}, {total} drives."
    return Report("predictions", rows, {"pairs": table_of(pairs)}, [note])


def drive(k: int, seeds: int) -> peers_table.Drive:
    """Drive number `k`: with all updates, then with fewer; seed after seed, entry after entry, row after row."""
    entries, (k, fewer) = peers_table.entries(), divmod(k, 2)
    name = ROWS[k // seeds // len(entries)]
    method = load_method(name)
    assert isinstance(method.controller, Predictive)
    if not fewer:
        method = changed(method, {"controller": {"predicted_hz": method.controller.rate_hz}})
    return peers_table.drive_method(method, entries[k // seeds % len(entries)], SEED + k % seeds, name)


Pair = tuple[peers_table.Drive, peers_table.Drive]


def rows_of(name: str, pairs: Sequence[Pair]) -> list[Row]:
    """Ratios of the times where both succeeded."""
    ratios = [fewer.time / all_.time for all_, fewer in pairs if both_succeed(all_, fewer)]
    return [row(f"{name}: time with fewer updates, as a share of that with all", "", ratios)]


def table_of(pairs: Sequence[Pair]) -> list[list[str]]:
    """A line for each row: outcomes with all updates and with fewer, and times where both succeeded."""
    lines = [["row", "drives", "success", "collision", "contingencies a drive", "mean time, s", "ratio, 95 %"]]
    for name in ROWS:
        mine = [pair for pair in pairs if pair[0].name == name]
        both = [pair for pair in mine if both_succeed(*pair)]
        times = [[each.time for each in drives] for drives in zip(*both, strict=True)] or [[], []]
        lines.append(
            [
                name,
                str(len(mine)),
                *(
                    " / ".join(str(sum(pair[k].outcome == outcome for pair in mine)) for k in range(2))
                    for outcome in (Outcome.SUCCESS, Outcome.COLLISION)
                ),
                " / ".join(number(float(np.mean([pair[k].contingencies for pair in mine]))) for k in range(2)),
                " / ".join(number(float(np.mean(each))) for each in times),
                " to ".join(map(number, interval_of(*times))),
            ]
        )
    return lines


def both_succeed(one: peers_table.Drive, other: peers_table.Drive) -> bool:
    """Whether their times may be compared."""
    return one.outcome == other.outcome == Outcome.SUCCESS


def interval_of(before: Sequence[float], after: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the ratio of the mean times, by the bootstrap over pairs."""
    random, count = np.random.default_rng(0), len(before)
    if count == 0:
        return math.nan, math.nan
    chosen = random.integers(0, count, (2000, count))
    ratios = np.array(after)[chosen].mean(axis=1) / np.array(before)[chosen].mean(axis=1)
    low, high = np.quantile(ratios, (0.025, 0.975))
    return float(low), float(high)
