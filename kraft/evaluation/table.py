"""Tables of a summary: one for each entry, and one for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from kraft.evaluation.journal import OUTCOMES
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import Result, Summary
from kraft.text import decimals, percent


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


COLUMNS: Final = {
    "method": 9,
    "succ": 9,
    "coll": 9,
    "timeout": 8,
    "score": 8,
    "failed": 8,
    "T_ex s": 7,
    "95 % CI": 5,
    "paper S/C/T": 6,
    "paper T_ex": 4,
    "p": 3,
    "cont": 2,
    "delta": 1,
    "emerg": 1,
    "regr": 1,
    "clear m": 1,
    "plan ms p50/p99": 1,
    "missed": 2,
    "cmd ms p50/p99": 1,
    "late": 2,
}

# What the columns hold whose heading does not say it: one line each below the tables in a terminal
MEANINGS: Final = {
    "T_ex s": "mean time of the successful trials",
    "95 % CI": "Wilson's interval of the success rate",
    "paper S/C/T": "successes, collisions, timeouts in the paper",
    "paper T_ex": "mean time in the paper",
    "p": "exact McNemar test against kraft on the same seeds",
    "cont": "cycles that began with a contingency",
    "delta": "ticks at which the true car was as near to its prediction as the clearance; no promise of a fixed one",
    "emerg": "contingencies that nothing verified",
    "regr": "plans that cost over 0.5 s more than what was left of the last one",
    "clear m": "smallest true distance to an obstacle",
    "plan ms p50/p99": "planning time of a cycle",
    "missed": "cycles that exceeded their planning time",
    "cmd ms p50/p99": "time that the controller took for a command",
    "late": "commands that took longer than the time between two of them",
}

TIME_OF_ALL: Final = "; over all entries only methods that succeed in the same entries can be compared by it"
"""What the meaning of ``T_ex s`` says besides below a table of all entries."""


def tables(summary: Summary) -> list[Table]:
    """One table for each entry; what cannot occur in any row has no column."""
    results = summary.results
    replans = any(result.replans for result in results)
    occurs = {
        "paper S/C/T": any(result.paper for result in results),
        "paper T_ex": any(result.paper and result.paper.t_ex is not None for result in results),
        "p": any(result.against for result in results),
        "score": any(result.scoring for result in results),
        "failed": summary.failed > 0,
        "missed": summary.realtime,
        "cmd ms p50/p99": any(result.command_p50 is not None for result in results),
        "late": any(result.late_commands for result in results),
        "delta": any(result.measures.clearance.ticks for result in results),
        "emerg": replans,
        "regr": replans,
    }
    names = [name for name in COLUMNS if occurs.get(name, True)]
    found = []
    for entry in summary.entries:
        cells = [_cells(result) for result in summary.of_entry(entry)]
        rows = tuple(tuple(row[name] for name in names) for row in cells)
        found.append(Table(entry, tuple(names), rows, tuple(COLUMNS[name] for name in names)))
    return found


def totals(summary: Summary) -> Table | None:
    """Table of all entries together, with a row for each method; None of a single entry.

    Times are of the successful trials of all entries, so only methods that succeed in the same ones can be compared.
    """
    if len(summary.entries) < 2:
        return None
    scored = bool(labels(summary))
    names = ["method", "succ", "coll", "timeout", *(["score"] if scored else [])]
    names += [*(["failed"] if summary.failed else []), "T_ex s", "95 % CI", "cont"]
    rows = []
    for method in dict.fromkeys(result.method for result in summary.results):
        cells = _total(summary.of_method(method))
        rows.append(tuple(cells[name] for name in names))
    return Table("all entries", tuple(names), tuple(rows), tuple(COLUMNS[name] for name in names))


def _total(results: Sequence[Result]) -> dict[str, str]:
    """Cells of a method over several entries."""
    sums = {name: sum(getattr(result, name) for result in results) for name in (*OUTCOMES, "contingencies", "trials")}
    times = [result.t_ex * result.success for result in results if result.t_ex is not None]
    return {
        "method": results[0].title,
        "succ": str(sums["success"]),
        "coll": str(sums["collision"]),
        "timeout": str(sums["timeout"]),
        "failed": str(sums["failed"]),
        "score": decimals(_mean_score(results), 3),
        "T_ex s": decimals(sum(times) / sums["success"] if times else None, 2),
        "95 % CI": _interval(wilson(sums["success"], sums["trials"])),
        "cont": str(sums["contingencies"]),
    }


def _interval(shares: tuple[float, float]) -> str:
    """Interval of a share: ``76-99%``."""
    low, high = shares
    return f"{low:.0%}-{high:.0%}".replace("%-", "-")


def _mean_score(results: Sequence[Result]) -> float | None:
    """Mean score of all trials of entries that are scored; None without such trials."""
    scored = [(result.score, result.trials) for result in results if result.score is not None]
    trials = sum(number for _, number in scored)
    return sum(score * number for score, number in scored) / trials if trials else None


def overview(summary: Summary) -> Table:
    """One table for all entries, with a column for each method, and its totals in the last row.

    A cell has the numbers of successes, collisions, timeouts and, if any trial failed, failed trials, and, if entries
    are scored, the mean score of all trials.
    """
    titles = {result.method: result.title for result in summary.results}
    by_cell = summary.by_cell
    counted = ("success", "collision", "timeout", *(("failed",) if summary.failed else ()))

    def cell(results: Sequence[Result]) -> str:
        numbers = "/".join(str(sum(getattr(result, name) for result in results)) for name in counted)
        score = _mean_score(results)
        return numbers if score is None else f"{numbers}  {score:.3f}"

    rows = [
        (short, *(cell([by_cell[entry, method]]) if (entry, method) in by_cell else "-" for method in titles))
        for entry, short in _short_names(summary).items()
    ]
    last = [cell(summary.of_method(method)) for method in titles]
    counts = "succ/coll/timeout" + ("/failed" if summary.failed else "")
    heading = (counts + ("  score" if labels(summary) else ""), *titles.values())
    return Table("", heading, (*rows, ("all", *last)), (9,) * len(heading))


def labels(summary: Summary) -> list[str]:
    """What the scores of the entries are of."""
    return list(dict.fromkeys(result.scoring.label for result in summary.results if result.scoring))


def _short_names(summary: Summary) -> dict[str, str]:
    """Name of each entry, in which the keys have their last part alone if that is unique: ``noise_scale=2``."""
    last = {key: key.rpartition(".")[2] for result in summary.results for key in result.settings}
    unique = {key: name for key, name in last.items() if list(last.values()).count(name) == 1}
    found = {}
    for entry in summary.entries:
        words = entry.split(" ")
        found[entry] = " ".join(
            f"{unique[key]}={value}" if equals and key in unique else word
            for word in words
            for key, equals, value in [word.partition("=")]
        )
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
    escaped = [cell.replace("|", "\\|") for cell in cells]
    return f"| {' | '.join(escaped)} |"


def _cells(result: Result) -> dict[str, str]:
    paper, against = result.paper, result.against
    kept = result.measures.clearance.coverage
    return {
        "method": result.title,
        "succ": str(result.success),
        "coll": str(result.collision),
        "timeout": str(result.timeout),
        "failed": str(result.failed),
        "score": decimals(result.score, 3),
        "T_ex s": decimals(result.t_ex, 2),
        "95 % CI": _interval(result.interval),
        "paper S/C/T": f"{paper.success}/{paper.collision}/{paper.timeout}" if paper else "-",
        "paper T_ex": decimals(paper.t_ex if paper else None, 2),
        "p": f"{against.p:.2g}" if against else "-",
        "cont": str(result.contingencies),
        "delta": percent(kept),
        "emerg": str(result.measures.emergencies) if result.replans else "-",
        "regr": str(sum(result.measures.regressions.values())) if result.measures.compared else "-",
        "clear m": decimals(result.min_clearance, 3),
        "plan ms p50/p99": f"{decimals(result.planning_p50, 1)}/{decimals(result.planning_p99, 1)}",
        "missed": str(result.missed),
        "cmd ms p50/p99": f"{decimals(result.command_p50, 2)}/{decimals(result.command_p99, 2)}",
        "late": str(result.late_commands),
    }
