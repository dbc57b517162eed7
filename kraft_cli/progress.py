"""Progress and interrupts of `kraft eval`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from kraft.elapsed import loading
from kraft.evaluation import Experiment, Observer, TrialRow
from kraft.evaluation.journal import Key
from kraft.text import counted
from kraft.trial.result import outcome_text
from kraft_cli.signals import Stopped
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


class Interrupts:
    """Handler of the signals that end an evaluation: the first one while trials run requests a stop, others raise."""

    def __init__(self, terminal: Terminal) -> None:
        self.trials_run = False
        self.awaited = "the running trials"
        self.received = 0  # number of the signal that requested the stop
        self._terminal = terminal

    def handle(self, number: int) -> None:
        """Request a stop, or raise `Stopped`."""
        if self.received or not self.trials_run:
            raise Stopped(number)
        self.received = number
        self._terminal.problem(f"waiting for {self.awaited}; interrupt again to abort them")


class Progress(Observer):
    """Bars for the rows in progress, a line for each finished row; without a terminal a line for each trial."""

    def __init__(self, terminal: Terminal, interrupts: Interrupts) -> None:
        self._terminal, self._interrupts = terminal, interrupts
        self._counts: dict[tuple[str, str], Counter[str]] = {}
        self._trials = self._total = self._done = 0
        self._bars: Bars | None = None
        self._tasks: dict[tuple[str, str], TaskID] = {}
        self._loading = ExitStack()

    def __enter__(self) -> Progress:
        """Print that modules are loaded and files are checked if that takes long, until the first message."""
        self._loading.enter_context(loading(self._terminal.info))
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        """Remove the bars."""
        self.close()

    def close(self) -> None:
        """Remove the bars."""
        self._loading.close()
        if self._bars is not None:
            self._bars.stop()
            self._bars = None

    def stop_requested(self) -> bool:
        """Whether an interrupt has requested a stop."""
        return self._interrupts.received != 0

    def log(self, text: str) -> None:
        """Print a message above the bars."""
        self._loading.close()
        if self._bars is not None:
            self._bars.console.print(text)
        else:
            self._terminal.info(text)

    def warn(self, text: str) -> None:
        """Print a warning, even if ``-q`` is given; no bars are there before the first trial."""
        self._loading.close()
        self._terminal.problem(f"warning: {text}")

    def started(self, experiment: Experiment, folder: Path | None, rows: Mapping[Key, TrialRow]) -> None:
        """Count the finished trials, and start the bars."""
        self._loading.close()
        self._interrupts.trials_run = True
        self._counts = {cell.key: Counter() for cell in experiment.cells}
        self._trials, self._total = experiment.trials, experiment.trials * len(experiment.cells)
        for row in rows.values():
            self._counts[row.key[:2]][row.outcome] += 1
        self._done = len(rows)
        self._note_end()
        there = f", {self._done} of them finished already" if rows else ""
        self._terminal.info(f"{counted(self._total, 'trial')}{there}; results in {folder}")
        if self._terminal.interactive and not self._terminal.quiet:
            self._bars = self._new_bars()

    def trial_ended(self, row: TrialRow) -> None:
        """Update the counts, and print a line or move the bars."""
        self._done += 1
        self._note_end()
        key = row.key[:2]
        counts = self._counts[key]
        counts[row.outcome] += 1
        if self._bars is None:
            self._terminal.info(
                f"{self._done}/{self._total}  {row.key[0]} {row.method} seed {row.seed}: {_result(row)}"
            )
        else:
            self._advance(self._bars, key, counts)

    def _note_end(self) -> None:
        """After the last trial an interrupt waits for the results instead."""
        if self._done == self._total:
            self._interrupts.awaited = "the results to be written"

    def _new_bars(self) -> Bars:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        columns = (TextColumn("{task.description}"), BarColumn(None), MofNCompleteColumn(), TimeRemainingColumn())
        console = Console(file=self._terminal.err, highlight=False, markup=False)
        bars = Bars(*columns, console=console, transient=True)
        self._tasks[("", "")] = bars.add_task("all", total=self._total, completed=self._done)
        bars.start()
        return bars

    def _advance(self, bars: Bars, key: tuple[str, str], counts: Counter[str]) -> None:
        bars.advance(self._tasks[("", "")])
        text = f"{' '.join(key)}  succ {counts['success']} coll {counts['collision']} timeout {counts['timeout']}"
        if counts["failed"]:
            text += f" failed {counts['failed']}"
        if counts.total() == self._trials:
            if key in self._tasks:
                bars.remove_task(self._tasks.pop(key))
            bars.console.print(text)
            return
        if key not in self._tasks:
            self._tasks[key] = bars.add_task(text, total=self._trials)
        bars.update(self._tasks[key], description=text, completed=counts.total())


def _result(row: TrialRow) -> str:
    if row.outcome == "failed":
        return f"failed: {row.error}"
    return outcome_text(row.outcome, row.obstacle, row.t_s)
