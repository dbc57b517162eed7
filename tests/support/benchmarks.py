"""What the tests read of a benchmark's report."""

from __future__ import annotations

from benchmarks.report import Report


def quantities(report: Report) -> dict[str, float]:
    """Median of each quantity."""
    return {each.quantity: each.median for each in report.rows}
