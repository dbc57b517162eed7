"""`kraft doctor`: report whether this machine has everything that kraft needs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal


def doctor(
    context: typer.Context,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Check the topics of a robot too (kraft list robots).",
            autocompletion=completion.robots,
        ),
    ] = None,
    remove_kernels: Annotated[
        int | None,
        typer.Option(
            metavar="DAYS",
            help="First remove compiled kernels of other versions of kraft or other processors that are unused for "
            "DAYS days.",
        ),
    ] = None,
    json: Json = False,
) -> ExitStatus:
    """Check the installation, and the topics of a robot.

    Python, packages, processor, kernel cache and rendering.
    """
    from kraft_cli.work import doctor as work

    terminal: Terminal = context.obj
    if remove_kernels is not None:
        terminal.info(work.remove_kernels(remove_kernels))
    findings = work.examine()
    if robot is not None:
        findings += work.examine_robot(robot)
    missing = [finding.subject for finding in findings if finding.state == "missing"]
    if json:
        terminal.json("kraft.doctor/1", {"ok": not missing, "findings": [asdict(f) for f in findings]})
    else:
        terminal.table(("CHECK", "STATE", "DETAIL"), [(f.subject, f.state, f.detail) for f in findings])
        if missing:
            terminal.error(f"missing: {', '.join(missing)}")
    return ExitStatus.MISSING if missing else ExitStatus.DONE
