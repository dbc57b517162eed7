"""Tables of a drive that are complete up to the last moments, whatever ends the process."""

from __future__ import annotations

import csv
import os
import queue
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO


class Journal:
    """Writes rows of tables in a thread; each table is a file ``NAME.csv``, made with its first row."""

    def __init__(self, folder: Path | None, headings: Mapping[str, Sequence[str]]) -> None:
        """Write nothing if there is no folder."""
        self._folder, self._headings = folder, headings
        self._rows: queue.SimpleQueue[tuple[str, Sequence[Any]] | None] = queue.SimpleQueue()
        self._files: dict[str, TextIO] = {}
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)

    def __enter__(self) -> Journal:
        """Begin to write."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
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
            if self._folder is not None:
                name, values = row
                file = self._file(self._folder, name)
                csv.writer(file, lineterminator="\n").writerow(values)
                file.flush()
        for file in self._files.values():
            os.fsync(file.fileno())
            file.close()

    def _file(self, folder: Path, name: str) -> TextIO:
        if name not in self._files:
            self._files[name] = (folder / f"{name}.csv").open("w", encoding="utf-8", newline="")
            csv.writer(self._files[name], lineterminator="\n").writerow(self._headings[name])
        return self._files[name]
