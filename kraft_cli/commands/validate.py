"""`kraft validate`: check configuration files."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal


def validate(
    context: typer.Context,
    files: Annotated[
        list[str], typer.Argument(metavar="FILE", help="Scenario, vehicle, method, map, log mapping or plan files.")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> ExitStatus:
    """Check scenario, vehicle, method, map, log mapping and plan files and show every problem of each."""
    from kraft.text import counted
    from kraft_cli.work.validate import check_file

    terminal: Terminal = context.obj
    checked = [check_file(file) for file in files]
    problems = [problem for result in checked for problem in result.problems]
    if json:
        content = [{**asdict(result), "valid": not result.problems} for result in checked]
        terminal.json("kraft.validate/1", {"valid": not problems, "files": content})
        return ExitStatus.INVALID if problems else ExitStatus.DONE
    for result in checked:
        if not result.problems:
            terminal.data(f"{result.file}: valid {result.kind}")
    for problem in problems:
        terminal.problem(str(problem))
    if problems:
        wrong = sum(bool(result.problems) for result in checked)
        terminal.say(f"{counted(len(problems), 'problem')} in {counted(wrong, 'file')}")
    return ExitStatus.INVALID if problems else ExitStatus.DONE
