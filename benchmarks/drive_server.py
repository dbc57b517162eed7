"""Server of forks that run `kraft drive`, with everything imported and the compiled functions of MuSHR cars loaded.

Drives of benchmarks and tests thus take several seconds of processor time less each.
"""

from __future__ import annotations

import json
import os
import sys
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from kraft_cli.main import main


class DriveProcess:
    """The command line as a process of its own, in a session of its own if it is asked for."""

    def __init__(self, arguments: list[str], folder: Path, *, session: bool = False) -> None:
        self._out, self._errors = folder / "stdout.txt", folder / "stderr.txt"
        context = get_context("forkserver")
        context.set_forkserver_preload(["benchmarks.drive_preload"])
        self._process = context.Process(target=_run, args=(arguments, self._out, self._errors, session))
        before = os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # the server finds its modules there
        try:
            self._process.start()
        finally:
            del os.environ["PYTHONPATH"]
            if before is not None:
                os.environ["PYTHONPATH"] = before
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Exit code; None while the process runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """Exit code of the ended process."""
        return self._process.exitcode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """What the process has written until its end."""
        self._process.join(timeout)
        assert self._process.exitcode is not None, "it runs on"
        return self._out.read_text(encoding="utf-8"), self._errors.read_text(encoding="utf-8")

    def result(self, timeout: float | None = None) -> dict[str, Any]:
        """The JSON object that the process has written until its end."""
        content: dict[str, Any] = json.loads(self.communicate(timeout)[0])
        return content


def _run(arguments: list[str], out: Path, errors: Path, session: bool) -> None:
    if session:
        os.setsid()
    for path, stream in ((out, sys.stdout), (errors, sys.stderr)):
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(number, stream.fileno())
    sys.exit(main(arguments))
