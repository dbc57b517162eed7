"""`kraft validate`: check configuration files."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft_cli.work.validate import FileReport


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
        terminal.json("kraft.validate/1", {"valid": not problems, "files": [_file_json(result) for result in checked]})
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


def _file_json(report: FileReport) -> dict[str, Any]:
    """One file with its problems; `argument` is about options and never true of a file."""
    problems = [{key: value for key, value in asdict(d).items() if key != "argument"} for d in report.problems]
    return {"file": report.file, "kind": report.kind, "problems": problems, "valid": not report.problems}
