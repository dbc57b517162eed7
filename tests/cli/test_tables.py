"""Tables of the command line without an evaluation behind them."""

from __future__ import annotations

import io
from pathlib import Path

from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.comparison_table import ROWS_MAX
from kraft.evaluation.journal import OUTCOMES
from kraft_cli.tables import show_comparison
from kraft_cli.terminal import Terminal


def same_drives(method: str) -> PairedRow:
    """Row of a method whose only drive is the same in both evaluations."""
    counts = dict.fromkeys(OUTCOMES, 0) | {"success": 1}
    return PairedRow(
        entry="turns", scenario="turns", method=method, title=method, pairs=1, counts=(counts, counts), gained=0, lost=0,
        p=1.0, both=1, time_difference=0.0, time_interval=None, time_p=None, time_groups=1, digests=1, identical=1,
        same_scenario=True,
    )  # fmt: skip


def test_many_methods_in_one_entry_that_all_drive_the_same_are_compared_without_a_table() -> None:
    rows = tuple(same_drives(f"method-{k}") for k in range(ROWS_MAX + 1))
    terminal = Terminal(io.StringIO(), io.StringIO())
    show_comparison(terminal, Comparison((Path("a"), Path("b")), rows, (), (), ((), ()), (0, 0)))
    assert isinstance(terminal.out, io.StringIO)
    assert f"{len(rows)} rows whose drives are all the same have no line above" in terminal.out.getvalue()
