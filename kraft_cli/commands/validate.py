"""`kraft validate`: check configuration files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kraft_cli import completion
from kraft_cli.boundary import explain
from kraft_cli.commands.options import Json
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal, diagnostic_json

if TYPE_CHECKING:
    from kraft_cli.work.validate import FileReport


def validate(
    context: typer.Context,
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE",
            help="Scenario, vehicle, method, suite, map, mapping, plan or robot files.",
            autocompletion=completion.checked,
        ),
    ],
    json: Json = False,
) -> ExitStatus:
    """Check files and print every problem.

    Files of scenarios, vehicles, methods, suites, maps, mappings, plans and robots.
    """
    from kraft_cli.work.validate import check_file

    terminal: Terminal = context.obj
    reports = [check_file(file, terminal.info) for file in files]
    if json:
        content = [_file_json(report) for report in reports]
        terminal.json("kraft.validate/1", {"valid": all(report.valid for report in reports), "files": content})
    else:
        _print_problems(terminal, reports)
    for report in reports:
        if report.defect is not None:
            terminal.problem(f"{report.file}: cannot be checked")
            explain(terminal, report.defect)
    if any(report.defect is not None for report in reports):
        return ExitStatus.INTERNAL
    return ExitStatus.DONE if all(report.valid for report in reports) else ExitStatus.INVALID


def _print_problems(terminal: Terminal, reports: Sequence[FileReport]) -> None:
    from kraft.text import counted

    for report in reports:
        if report.valid:
            terminal.data(f"{report.file}: valid {report.kind}")
    # a suite has the problems of its scenarios, which may be among the files too
    problems = tuple(dict.fromkeys(problem for report in reports for problem in report.problems))
    for problem in problems:
        terminal.problem(str(problem))
    if problems:
        invalid = sum(bool(report.problems) for report in reports)
        terminal.info(f"{counted(len(problems), 'problem')} in {counted(invalid, 'file')}")


def _file_json(report: FileReport) -> dict[str, Any]:
    problems = [diagnostic_json(problem) for problem in report.problems]
    defect = None if report.defect is None else f"{type(report.defect).__name__}: {report.defect}"
    return {"file": report.file, "kind": report.kind, "problems": problems, "defect": defect, "valid": report.valid}
