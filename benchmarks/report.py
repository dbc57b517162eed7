"""What a benchmark hands back, and the table that shows it."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np


@dataclass(frozen=True)
class Target:
    """A limit for the median or for the worst of the samples; `most` False means at least that much."""

    limit: float
    most: bool = True
    of: Literal["median", "worst"] = "median"

    def __str__(self) -> str:
        return f"{self.of} {'<=' if self.most else '>='} {number(self.limit)}"

    def met_by(self, value: float) -> bool:
        """Whether a value is on the right side of the limit."""
        return value <= self.limit if self.most else value >= self.limit

    def verdict(self, value: float) -> str:
        """Met or missed, and by how much of the limit."""
        word = "met" if self.met_by(value) else "MISSED"
        if self.limit == 0 or not math.isfinite(value):
            return word if self.met_by(value) else f"{word} by {number(abs(value - self.limit))}"
        ratio = value / self.limit
        if ratio == 1.0:
            return word
        if ratio > 2.0:
            return f"{word}, {number(ratio)} times it"
        return f"{word} by {abs(ratio - 1):.0%}"


@dataclass(frozen=True)
class Row:
    """A quantity and everything that was measured of it; `more` says whether more is better."""

    quantity: str
    unit: str
    samples: tuple[float, ...]
    target: Target | None = None
    more: bool = False

    @property
    def median(self) -> float:
        """Median of the samples, nan without any."""
        return float(np.median(self.samples)) if self.samples else math.nan

    @property
    def p90(self) -> float:
        """What nine of ten samples are at least as good as."""
        if not self.samples:
            return math.nan
        return float(np.quantile(self.samples, 0.1 if self.more else 0.9, method="lower" if self.more else "higher"))

    @property
    def worst(self) -> float:
        """The worst sample."""
        if not self.samples:
            return math.nan
        return min(self.samples) if self.more else max(self.samples)

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without one."""
        return None if self.target is None else self.target.met_by(self._judged)

    @property
    def _judged(self) -> float:
        return self.worst if self.target is not None and self.target.of == "worst" else self.median

    def cells(self) -> list[str]:
        """The row of the table."""
        target = str(self.target) if self.target else ""
        verdict = self.target.verdict(self._judged) if self.target else ""
        spread = [number(self.p90), number(self.worst)] if len(self.samples) > 1 else ["", ""]
        return [self.quantity, number(self.median), *spread, self.unit, str(len(self.samples)), target, verdict]

    def as_json(self) -> dict[str, Any]:
        """Everything, with infinities as None."""
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "median": finite(self.median),
            "p90": finite(self.p90),
            "worst": finite(self.worst),
            "target": str(self.target) if self.target else None,
            "met": self.met,
            "samples": [finite(value) for value in self.samples],
        }


def row(quantity: str, unit: str, samples: Iterable[float], target: Target | None = None, more: bool = False) -> Row:
    """A `Row`; where there is a target, that says which direction is better."""
    return Row(quantity, unit, tuple(float(x) for x in samples), target, more if target is None else not target.most)


@dataclass(frozen=True)
class Report:
    """Results of one topic: rows with targets, other tables (first row the heading), and remarks."""

    topic: str
    rows: list[Row]
    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The report as people read it."""
        heading = ["quantity", "median", "p90", "worst", "unit", "n", "target", "verdict"]
        parts = [f"== {self.topic} ==", aligned([heading, *(row.cells() for row in self.rows)])]
        for title, table in self.tables.items():
            parts += ["", title, aligned(table)]
        return "\n".join([*parts, *(f"  {note}" for note in self.notes), ""])

    def as_json(self) -> dict[str, Any]:
        """Everything that `text` shows, and the samples."""
        return {"rows": [row.as_json() for row in self.rows], "tables": self.tables, "notes": self.notes}


def aligned(table: Sequence[Sequence[str]]) -> str:
    """Columns of equal width, a rule under the heading; the first column to the left, numbers to the right."""
    widths = [max(len(line[k]) for line in table) for k in range(len(table[0]))]
    right = [k > 0 and all(_is_number(line[k]) for line in table[1:]) for k in range(len(widths))]
    lines = [
        "  ".join(
            cell.rjust(width) if aside else cell.ljust(width)
            for cell, width, aside in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in table
    ]
    return "\n".join("  " + line for line in [lines[0], "-" * len(lines[0]), *lines[1:]])


def number(value: float) -> str:
    """Four digits, thousands separated."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else "none"
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):,}"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def finite(value: float) -> float | None:
    """The value, or None if JSON cannot hold it."""
    return value if math.isfinite(value) else None


def _is_number(text: str) -> bool:
    return not text or text in {"-", "none"} or text.replace(",", "").replace(".", "").lstrip("-").rstrip("x").isdigit()


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what compiled code, OMPL's for instance, and Python print to standard output."""
    sys.stdout.flush()
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)
