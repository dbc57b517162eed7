"""Server of a results folder on the loopback address: the page, and the replays that do not fit into it."""

from __future__ import annotations

import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from kraft.errors import InputError
from kraft.evaluation.journal import Key
from kraft.evaluation.report.entry import replay_part
from kraft.evaluation.report.page import page
from kraft.evaluation.report.results import CommandLine, Results, read_results

ADDRESS: Final = "127.0.0.1"
PARTS: Final = ("drive", "trees")
DIGITS: Final = 12
"""Most digits of a seed: Python refuses to read numbers of thousands of digits."""


class ReportServer(ThreadingHTTPServer):
    """Server of a results folder at a free port; the page is made again for each visit, also while trials run.

    ``/`` is the page, ``/replay/drive/turns/kraft/5`` and ``/replay/trees/turns/kraft/5`` are the parts of a replay:
    entry, method and seed of its trial name it also in a page that was made before the evaluation got more trials.
    Requests for other hosts are refused, so that a page of the web cannot read the folder through a name of its own.
    """

    daemon_threads = True

    def __init__(self, folder: Path, command_line: CommandLine | None = None) -> None:
        """Read the folder and listen.

        Raises:
            InputError: if the folder is not a results folder or is damaged.
        """
        self.folder, self.command_line = folder, command_line
        self.results = read_results(folder, command_line)
        super().__init__((ADDRESS, 0), _Handler)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{ADDRESS}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error of a request; a visitor who closes the page early is none."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def read(self) -> Results:
        """Read the folder again.

        Raises:
            InputError: if it is damaged now.
        """
        self.results = read_results(self.folder, self.command_line)
        return self.results

    def part(self, key: Key, part: str) -> str | None:
        """Part of a replay; None without."""
        return replay_part(self.results.replays, key, part) if key in self.results.numbers else None


class _Handler(BaseHTTPRequestHandler):
    server: ReportServer

    def do_GET(self) -> None:
        if self.headers.get("Host") not in [f"{name}:{self.server.server_port}" for name in (ADDRESS, "localhost")]:
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        match self.path.split("?")[0].strip("/").split("/"):
            case [""]:
                self._page()
            case ["replay", part, entry, method, seed] if part in PARTS and seed.isdecimal() and len(seed) <= DIGITS:
                self._replay((unquote(entry), unquote(method), int(seed)), part)
            case _:
                self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: object) -> None:
        """Write no line for each request."""

    def _page(self) -> None:
        try:
            self._answer(page(self.server.read(), served=True), "text/html")
        except InputError as error:
            self._answer(str(error), "text/plain", HTTPStatus.INTERNAL_SERVER_ERROR)

    def _replay(self, key: Key, part: str) -> None:
        try:
            text = self.server.part(key, part)
        except InputError as error:
            self._answer(str(error), "text/plain", HTTPStatus.INTERNAL_SERVER_ERROR)
            return
        if text is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._answer(text, "text/plain")

    def _answer(self, text: str, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)
