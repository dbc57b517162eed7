"""Tables for a terminal and plain lines for a pipe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from rich.console import Console

    from kraft.evaluation import Summary, TrialRow
    from kraft.evaluation.comparison import Comparison
    from kraft.evaluation.table import Table

NUMBERS = "0123456789+-"
"""First characters of cells that are numbers, or are in place of one."""
LISTED = 10
"""Most unsuccessful trials that are listed, of methods that mostly succeed."""
LISTED_OTHERS = 3
"""Most of those of other methods, which are listed if there are no such trials."""
REMARK_MANY = "The tables of the entries, with intervals and measures, are in report.html and summary.json."


def show_rows(terminal: Terminal, rows: Sequence[tuple[str, str]], *, good: bool) -> None:
    """Print labels and values; on a terminal the colour of `result` depends on `good`."""
    from rich import box
    from rich.table import Table as Grid

    if not terminal.out.isatty():
        width = max(len(label) for label, _ in rows)
        for label, value in rows:
            terminal.data(f"{label:<{width}}  {value}")
        return
    grid = Grid(box=box.ROUNDED, show_header=False, border_style="dim")
    grid.add_column(style="dim")
    grid.add_column(overflow="fold")
    for label, value in rows:
        grid.add_row(label, value, style=("bold green" if good else "bold yellow") if label == "result" else None)
    _console(terminal).print(grid)


def show_tables(terminal: Terminal, summary: Summary) -> None:
    """Print a table for each entry, or one table for many; on a terminal with as many columns as fit."""
    from kraft.evaluation import labels, overview, tables
    from kraft.evaluation.summary import MANY
    from kraft.evaluation.table import MEANINGS, TIME_OF_ALL, totals

    for label in labels(summary):
        terminal.data(f"score: {label}; 0.5 at best, 0 for collisions and timeouts")
    if len(summary.entries) > MANY:
        _show_overview(terminal, overview(summary))
        terminal.data(REMARK_MANY)
        return
    together = totals(summary)
    meanings = MEANINGS | ({"T_ex s": MEANINGS["T_ex s"] + TIME_OF_ALL} if together else {})
    _show_all(terminal, [*tables(summary), *([together] if together else [])], meanings)


def show_unsuccessful(terminal: Terminal, rows: Sequence[TrialRow], folder: Path | None) -> None:
    """Print collisions and timeouts of methods that mostly succeed, else a few of the others; and how many more.

    Those of methods that rarely fail are first.  Each has its link on the page in the folder of the results.
    """
    from kraft.evaluation.report.entry import trial_link
    from kraft.text import counted
    from kraft.trial.result import outcome_text

    found = [row for row in rows if row.outcome in ("collision", "timeout")]
    if not found:
        return
    counts, page = Counter(row.method for row in found), (folder or Path()) / "report.html"
    trials = Counter(row.method for row in rows)
    found.sort(key=lambda row: counts[row.method])
    shown = [row for row in found if 2 * counts[row.method] < trials[row.method]][:LISTED] or found[:LISTED_OTHERS]
    cells = [
        (
            *map(str, row.key),
            outcome_text(row.outcome, row.obstacle, row.t_s, digits=1),
            "-" if row.cause is None else row.cause.kind,
            f"{page}{trial_link(row.key)}",
        )
        for row in shown
    ]
    terminal.data("")
    terminal.data(f"{counted(len(found), 'trial')} did not succeed")
    if terminal.out.isatty():
        console = _console(terminal)
        for entry, method, seed, outcome, cause, replay in cells:  # wrapped: columns would be left out
            console.print(f"{entry}, {method}, seed {seed}: {outcome} ({cause})", overflow="fold")
            terminal.data(f"  {replay}")  # in one piece: a line break would end the link
    else:
        terminal.table(("entry", "method", "seed", "outcome", "cause", "replay"), cells)
    if len(found) > len(shown):
        terminal.data(f"and {len(found) - len(shown)} more, which the page has")


def show_comparison(terminal: Terminal, comparison: Comparison) -> None:
    """Print what is compared, the tables, and below them what was found and what differs."""
    from kraft.evaluation.comparison_findings import findings
    from kraft.evaluation.comparison_table import MEANINGS, comparison_tables, folders, remarks

    for line in folders(comparison):
        terminal.data(line)
    terminal.data("")
    _show_all(terminal, comparison_tables(comparison), MEANINGS)
    terminal.data("")
    for lines in (findings(comparison), remarks(comparison)):
        for line in lines:
            terminal.data(line)


def _show_all(terminal: Terminal, tables: Sequence[Table], meanings: Mapping[str, str]) -> None:
    """Print tables, on a terminal with as many columns as fit, and below them what the shown columns hold."""
    shown: set[str] = set()
    left_out: dict[str, None] = {}
    for table in tables:
        if terminal.out.isatty():
            fitted = _rich(terminal, table)
            shown.update(fitted)
            left_out.update(dict.fromkeys(name for name in table.heading if name not in fitted))
            continue
        if table.title:
            terminal.data(table.title)
        terminal.table(table.heading, table.rows)
        terminal.data("")
        shown.update(table.heading)
    _show_meanings(terminal, [(name, meaning) for name, meaning in meanings.items() if name in shown])
    if left_out:
        console = _console(terminal)
        text = f"no room for {', '.join(left_out)}: a wider terminal, a pipe and --json have them"
        console.print(text, style="dim", overflow="fold")


def _show_meanings(terminal: Terminal, meanings: Sequence[tuple[str, str]]) -> None:
    """Print what columns hold; on a terminal the lines are wrapped."""
    if not terminal.out.isatty():
        width = max((len(name) for name, _ in meanings), default=0)
        for name, meaning in meanings:
            terminal.data(f"{name:<{width}}  {meaning}")
        return
    from rich.table import Table as Grid

    grid = Grid.grid(padding=(0, 2))
    for name, meaning in meanings:
        grid.add_row(name, meaning)
    _console(terminal).print(grid, style="dim")


def _show_overview(terminal: Terminal, table: Table) -> None:
    """Print the table of many entries; on a terminal with as many methods beside each other as fit."""
    if not terminal.out.isatty():
        terminal.table(table.heading, table.rows)
        terminal.data("")
        return
    from rich import box
    from rich.table import Table as Grid

    console = _console(terminal)
    headings = [heading.replace(" ", "\n") for heading in table.heading]
    for columns in _fitting(table, headings, console.width):
        grid = Grid(box=box.ROUNDED, border_style="dim")
        grid.add_column(headings[0], overflow="fold")
        for k in columns:
            grid.add_column(headings[k], justify="right", no_wrap=True)
        for row in table.rows[:-1]:
            grid.add_row(row[0], *(row[k] for k in columns))
        grid.add_section()
        grid.add_row(table.rows[-1][0], *(table.rows[-1][k] for k in columns), style="bold")
        console.print(grid)


def _fitting(table: Table, headings: Sequence[str], width: int) -> list[list[int]]:
    """Columns of the methods, in groups that fit beside the names of the entries, which may be wrapped."""
    cells = [[*headings[k].split("\n"), *(row[k] for row in table.rows)] for k in range(len(headings))]
    widths = [max(map(len, column)) + 3 for column in cells]
    names = min(widths[0], max(20, width // 3)) + 1
    groups: list[list[int]] = [[]]
    for k in range(1, len(headings)):
        if groups[-1] and names + sum(widths[j] for j in [*groups[-1], k]) > width:
            groups.append([])
        groups[-1].append(k)
    return groups


def _rich(terminal: Terminal, table: Table) -> Sequence[str]:
    """Print as many columns as fit, and return their headings."""
    from rich import box
    from rich.table import Table as Grid

    console = _console(terminal)
    fitted = table.fitted(console.width - 4, gap=3)
    grid = Grid(
        title=table.title or None, box=box.ROUNDED, border_style="dim", title_justify="left", title_style="bold"
    )
    for number, heading in enumerate(fitted.heading):
        numbers = number > 0 and all(row[number][:1] in NUMBERS for row in fitted.rows)
        grid.add_column(heading, justify="right" if numbers else "left", no_wrap=True)
    for row in fitted.rows:
        grid.add_row(*row, style="bold" if row[0] == "KRAFT" else None)
    console.print(grid)
    return fitted.heading


def _console(terminal: Terminal) -> Console:
    """What tables and wrapped lines are printed with: text as it is, without markup."""
    from rich.console import Console  # loading it takes time

    return Console(file=terminal.out, highlight=False, markup=False)
