"""Main function of the `kraft` command."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import typer

from kraft_cli.app import GLOBAL_FLAGS, app
from kraft_cli.boundary import guarded
from kraft_cli.completion import VARIABLE, complete
from kraft_cli.exit_status import ExitStatus
from kraft_cli.readable_names import check_names
from kraft_cli.terminal import Terminal


def main(argv: Sequence[str] | None = None, terminal: Terminal | None = None) -> int:
    """Run one command line and return its exit code; ``argv`` excludes the name of the program."""
    arguments = _flags_first(list(sys.argv[1:] if argv is None else argv))
    terminal = terminal or Terminal()
    terminal.traceback = "--traceback" in arguments  # before parsing, so that it applies to errors in the arguments too

    def command() -> ExitStatus:
        check_names(arguments)
        program = _program()
        if instruction := os.environ.get(VARIABLE):
            return complete(program, terminal, instruction)
        with program.make_context("kraft", arguments, obj=terminal) as context:
            result = program.invoke(context)
        return ExitStatus.DONE if result is None else ExitStatus(result)

    return int(guarded(terminal, command))


@cache
def _program() -> Any:
    """Commands and options, made once: that takes half the time of a short command."""
    return typer.main.get_command(app)


def _flags_first(arguments: list[str]) -> list[str]:
    """Move the global flags to the front, so that they have the same effect before and after the command."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    flags = [a for a in arguments[:end] if a in GLOBAL_FLAGS]
    return [*flags, *(a for a in arguments[:end] if a not in GLOBAL_FLAGS), *arguments[end:]]
