"""The time of long work that tells nothing itself is told while it goes on."""

from __future__ import annotations

import io
import threading

import pytest

from kraft import elapsed
from kraft.elapsed import LOADING, elapsed_time
from kraft.text import no_messages
from kraft_cli.progress import Interrupts, Progress
from kraft_cli.terminal import Terminal


def test_the_time_and_what_goes_on_are_told_until_the_work_ends() -> None:
    told, twice = list[str](), threading.Event()

    def report(text: str) -> None:
        told.append(text)
        if len(told) == 2:
            twice.set()

    with elapsed_time(report, lambda: f"working on part {len(told) + 1}", interval=0.01):
        assert twice.wait(30.0)
    count = len(told)
    assert told[:2] == ["  0 s: working on part 1", "  0 s: working on part 2"]
    assert not [thread for thread in threading.enumerate() if thread.name == "elapsed time"]
    assert len(told) == count


def test_short_work_tells_nothing() -> None:
    told = list[str]()
    with elapsed_time(told.append, "working", interval=30.0):
        no_messages("work")
    assert told == []


def test_an_evaluation_that_loads_for_long_says_so_until_its_first_message(monkeypatch: pytest.MonkeyPatch) -> None:
    class Noticed(io.StringIO):
        said = threading.Event()

        def write(self, text: str) -> int:
            if LOADING in text:
                self.said.set()
            return super().write(text)

    monkeypatch.setattr(elapsed, "LOADING_INTERVAL", 0.01)
    terminal = Terminal(err=Noticed())
    with Progress(terminal, Interrupts(terminal)) as shown:
        assert Noticed.said.wait(30.0)
        shown.log("compiling")
        assert not [thread for thread in threading.enumerate() if thread.name == "elapsed time"]
