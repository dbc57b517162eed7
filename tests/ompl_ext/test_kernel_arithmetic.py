"""The same seed gives the same bytes in every process.

That it does so whatever instructions the processor has is tested where another processor's kernels are compiled anyhow:
`tests/cli/test_interrupts.py`.
"""

from __future__ import annotations

from support.planning_process import planned, planned_elsewhere


def test_another_process_makes_the_same_plan() -> None:
    assert planned_elsewhere()[0] == planned()
