"""What the tests of evaluations share: results without measured times, an observer that stops, refusals, a full disk."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from kraft.errors import Code, InputError
from kraft.evaluation import Observer, TrialRow

WALL_CLOCK = (
    "wall_s",
    "first_plan_ms_p50",
    "planning_ms_p50",
    "planning_ms_p99",
    "missed_deadlines",
    "command_ms_p50",
    "command_ms_p99",
    "late_commands",
)
"""Keys of the JSON object of an evaluation with measured times; all others repeat."""
KEYS = {
    "scenario", "method", "trials", "success", "collision", "timeout", "success_ci95", "t_ex_s", "contingencies",
    "planning_ms_p50", "planning_ms_p99", "paper",
}  # fmt: skip


@contextmanager
def refused(*expected: tuple[Path | str, Code]) -> Iterator[None]:
    """Expect an InputError whose diagnostics have these places and codes, in this order."""
    with pytest.raises(InputError) as caught:
        yield
    assert [(each.place, each.code) for each in caught.value.diagnostics] == [(str(p), c) for p, c in expected]


def places(err: str) -> list[str]:
    """Places of the diagnostics on stderr: what stands before the first colon and space of each line."""
    return [line.split(": ", 1)[0] for line in err.splitlines()]


class StoppingObserver(Observer):
    """Requests a stop after some trials and records the messages."""

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
    """Sorted trials with their replays and the summary, without measured times."""
    lines = [json.dumps(without_clock(json.loads(line))) for line in (out / "trials.jsonl").read_text().splitlines()]
    lines += set((out / "replays.jsonl").read_text().splitlines())  # a repeated trial has its replay twice
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
