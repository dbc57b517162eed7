"""Tables of a drive that are complete up to the last moments, whatever ends the process."""

from __future__ import annotations

import csv
import io
import queue
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from kraft.errors import InputError
from kraft.files import LineFile, unwritable
from ompl_ext.vehicle import Vehicle

EVENTS: Final = ["time", "event"]


class DriveTables:
    """Writes rows of tables in a thread; each table is a file ``NAME.csv``, made with its first row.

    The drive goes on if nothing can be written any more: `problem` says why, the tables end with their last whole rows.
    """

    def __init__(self, folder: Path | None, headings: Mapping[str, Sequence[str]]) -> None:
        """Write nothing if there is no folder."""
        self._folder, self._headings = folder, headings
        self._rows: queue.SimpleQueue[tuple[str, Sequence[Any]] | None] = queue.SimpleQueue()
        self._tables: dict[str, LineFile] = {}
        self._thread = threading.Thread(target=self._write, name="tables", daemon=True)
        self.problem = ""

    def __enter__(self) -> DriveTables:
        """Begin to write."""
        if self._folder is not None:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                self.problem = str(unwritable(self._folder, error))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits and close the files."""
        self._rows.put(None)
        self._thread.join()

    def row(self, name: str, *values: Any) -> None:
        """Write a row of a table."""
        self._rows.put((name, values))

    def _write(self) -> None:
        while (row := self._rows.get()) is not None:
            if self._folder is None or self.problem:
                continue
            try:
                self._append(self._folder, *row)
            except InputError as error:
                self.problem = str(error)
        for table in self._tables.values():
            try:
                table.sync()
            except InputError as error:
                self.problem = self.problem or str(error)
            table.close()

    def _append(self, folder: Path, name: str, values: Sequence[Any]) -> None:
        if name not in self._tables:
            self._tables[name] = LineFile(folder / f"{name}.csv")
            self._tables[name].append(_line(self._headings[name]))
        self._tables[name].append(_line(values))


def _line(values: Sequence[Any]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(values)
    return text.getvalue().encode()


def add_event(folder: Path | None, time: float, text: str) -> tuple[str, ...]:
    """Add what happened at a time (s) for a controller that was killed; why that was not possible, else nothing."""
    if folder is None:
        return ()
    path = folder / "events.csv"
    try:
        with path.open("ab") as file:
            rows = [] if file.tell() else [EVENTS]
            file.write(b"".join(_line(row) + b"\n" for row in (*rows, (f"{time:.3f}", text))))
    except OSError as error:
        return (str(unwritable(path, error)),)
    return ()


def headings(vehicle: Vehicle) -> dict[str, list[str]]:
    """Headings of the tables that the controller writes."""
    return {
        "steps": ["time", *(f"estimate_{name}" for name in vehicle.state),
                  *(f"command_{name}" for name in vehicle.controls), "cycle", "stopping", "pose_age",
                  "late", "work"],
        "observations": ["time", "arrival", "x", "y", "theta"],
        "events": EVENTS,
    }  # fmt: skip
