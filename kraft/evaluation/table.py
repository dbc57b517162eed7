"""Tables of a summary, one for each scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from kraft.evaluation.summary import Result, Summary
from kraft.text import decimals


@dataclass(frozen=True)
class Table:
    """Heading and cells; columns of low `importance` are left out first where the width is small."""

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    importance: tuple[int, ...]

    def fitted(self, width: int, gap: int = 2) -> Table:
        """Table with as many columns as fit in `width` characters."""
        widths = [max(len(row[k]) for row in (self.heading, *self.rows)) for k in range(len(self.heading))]
        kept = list(range(len(self.heading)))
        while len(kept) > 1 and sum(widths[k] + gap for k in kept) - gap > width:
            kept.remove(min(kept, key=lambda k: (self.importance[k], k)))
        return Table(
            self.title,
            tuple(self.heading[k] for k in kept),
            tuple(tuple(row[k] for k in kept) for row in self.rows),
            tuple(self.importance[k] for k in kept),
        )


_COLUMNS: Final = {
    "method": 9,
    "succ": 9,
    "coll": 9,
    "timeout": 8,
    "failed": 8,
    "T_ex s": 7,
    "95 % CI": 5,
    "paper S/C/T": 6,
    "paper T_ex": 4,
    "p": 3,
    "cont": 2,
    "clear m": 1,
    "plan ms p50/p99": 1,
    "missed": 2,
}


def tables(summary: Summary) -> list[Table]:
    """One table for each entry; failed trials and missed deadlines have columns only where they can occur."""
    left_out = {name for name, wanted in (("failed", summary.failed), ("missed", summary.realtime)) if not wanted}
    names = [name for name in _COLUMNS if name not in left_out]
    found = []
    for entry in dict.fromkeys(result.entry for result in summary.results):
        cells = [_cells(result) for result in summary.results if result.entry == entry]
        rows = tuple(tuple(row[name] for name in names) for row in cells)
        found.append(Table(entry, tuple(names), rows, tuple(_COLUMNS[name] for name in names)))
    return found


def markdown(summary: Summary) -> str:
    """All tables in Markdown."""
    return "\n\n".join(
        "\n".join(
            [f"**{table.title}**", "", _line(table.heading), _line(["---", *["---:"] * (len(table.heading) - 1)])]
            + [_line(row) for row in table.rows]
        )
        for table in tables(summary)
    )


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cells(result: Result) -> dict[str, str]:
    paper, against = result.paper, result.against
    low, high = result.interval
    return {
        "method": result.title,
        "succ": str(result.success),
        "coll": str(result.collision),
        "timeout": str(result.timeout),
        "failed": str(result.failed),
        "T_ex s": decimals(result.t_ex, 2),
        "95 % CI": f"{low:.0%}-{high:.0%}".replace("%-", "-"),
        "paper S/C/T": f"{paper.success}/{paper.collision}/{paper.timeout}" if paper else "-",
        "paper T_ex": decimals(paper.t_ex if paper else None, 2),
        "p": f"{against.p:.2g}" if against else "-",
        "cont": str(result.contingencies),
        "clear m": decimals(result.min_clearance, 3),
        "plan ms p50/p99": f"{decimals(result.planning_p50, 1)}/{decimals(result.planning_p99, 1)}",
        "missed": str(result.missed),
    }
