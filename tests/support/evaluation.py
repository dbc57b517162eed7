"""What the tests of evaluations share: results without what the clock says, a observer that stops, a full disk."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kraft.evaluation import Observer, TrialRow
from kraft.evaluation.summary import WALL_CLOCK

KEYS = {
    "scenario", "method", "trials", "success", "collision", "timeout", "success_ci95", "t_ex_s", "contingencies",
    "planning_ms_p50", "planning_ms_p99", "paper",
}  # fmt: skip


class StoppingObserver(Observer):
    """Stops after some trials and remembers what was said."""

    def __init__(self, after: int = 10**6) -> None:
        self.after, self.rows, self.messages = after, list[TrialRow](), list[str]()

    def log(self, text: str) -> None:
        self.messages.append(text)

    def trial_ended(self, row: TrialRow) -> None:
        self.rows.append(row)

    def stop_requested(self) -> bool:
        return len(self.rows) >= self.after


def without_clock(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_clock(item) for key, item in value.items() if key not in (*WALL_CLOCK, "measured")}
    return [without_clock(item) for item in value] if isinstance(value, list) else value


def kept(out: Path) -> tuple[list[str], Any]:
    """Sorted trials and summary, without what the clock says."""
    lines = [json.dumps(without_clock(json.loads(line))) for line in (out / "trials.jsonl").read_text().splitlines()]
    return sorted(lines), without_clock(json.loads((out / "summary.json").read_text()))


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: the kernel refuses writes as it does on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
