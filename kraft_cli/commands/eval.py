"""`kraft eval`: run many trials and print their tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft.elapsed import loading
from kraft_cli import completion
from kraft_cli.commands.options import Json, PlanningModel, defaulting
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft.evaluation import Evaluation

Scenarios = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="SCENARIO",
        help=defaulting("Bundled names or paths of files.", "those of the suite paper"),
        autocompletion=completion.scenarios,
    ),
]
Suite = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help="Scenarios of a suite (kraft list suites), with their keys set.",
        autocompletion=completion.suites,
    ),
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace the value of a key of all scenarios.")
]
Vary = Annotated[
    list[str] | None, typer.Option(metavar="KEY=V1,V2", help="Run the scenarios once with each value of a key.")
]
Trials = Annotated[
    int | None, typer.Option(metavar="N", help=defaulting("Trials of each method in each scenario.", "30"))
]
Methods = Annotated[
    str | None,
    typer.Option(
        metavar="A,B",
        help=defaulting("Methods (kraft list methods).", "the paper's seven"),
        autocompletion=completion.comma_separated(completion.methods),
    ),
]
Seed = Annotated[int | None, typer.Option(metavar="N", help=defaulting("Trial i has the seed N + i.", "0"))]
Jobs = Annotated[int | None, typer.Option(metavar="N", help=defaulting("Worker processes.", "one for each core"))]
ClusterAddress = Annotated[
    str | None, typer.Option("--cluster", metavar="ADDRESS", help="Run on the workers of a Dask scheduler.")
]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help=defaulting("New results folder.", "results/eval-TIME-seedN"))
]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Resume the evaluation in the folder of --out, also with more trials or methods."),
]
Realtime = Annotated[
    bool, typer.Option("--realtime", help="Limit planning by wall-clock time and count missed deadlines.")
]


def eval_(
    context: typer.Context,
    scenarios: Scenarios = None,
    suite: Suite = None,
    set_: Set = None,
    vary: Vary = None,
    trials: Trials = None,
    methods: Methods = None,
    vehicle: PlanningModel = None,
    seed: Seed = None,
    jobs: Jobs = None,
    cluster: ClusterAddress = None,
    out: Out = None,
    resume: Resume = False,
    realtime: Realtime = False,
    json: Json = False,
) -> ExitStatus:
    """Run methods in scenarios many times and compare them.

    Collisions are results, not errors.
    """
    terminal: Terminal = context.obj
    with loading(terminal.info):
        from kraft_cli.progress import Interrupts, Progress
        from kraft_cli.signals import handled
        from kraft_cli.work.evaluate import EvalRequest, complete_request, resume_command, run_evaluation

    request = complete_request(
        EvalRequest(
            tuple(scenarios or ()),
            suite,
            tuple(set_ or ()),
            tuple(vary or ()),
            trials,
            methods,
            vehicle,
            seed,
            jobs,
            cluster,
            out,
            resume,
            realtime,
        )
    )
    interrupts = Interrupts(terminal)
    with handled(interrupts.handle), Progress(terminal, interrupts) as progress:
        try:
            evaluation = run_evaluation(request, progress)
        except BaseException:
            progress.close()
            if interrupts.trials_run:
                terminal.problem(f"every finished trial is kept; to resume: {resume_command(request)}")
            raise
    if not evaluation.complete:
        terminal.problem(f"stopped; every finished trial is kept; to resume: {resume_command(request)}")
        return ExitStatus(128 + interrupts.received)
    if out is None and terminal.quiet and not json:  # nothing else says where the results are
        terminal.problem(f"results in {evaluation.folder}")
    return _print_results(terminal, evaluation, json)


def _print_results(terminal: Terminal, evaluation: Evaluation, json: bool) -> ExitStatus:
    from kraft.evaluation.journal import reason_of_failures
    from kraft.evaluation.summary import SCHEMA, evaluation_json
    from kraft.text import counted
    from kraft_cli.tables import show_tables, show_unsuccessful

    if json:
        warnings = evaluation.experiment.warnings
        content = {**evaluation_json(evaluation.summary, warnings), "folder": str(evaluation.folder)}
        terminal.json(SCHEMA, content)
    else:
        show_tables(terminal, evaluation.summary)
        show_unsuccessful(terminal, evaluation.rows, evaluation.folder)
        terminal.info(f"results in {evaluation.folder}; page: {evaluation.folder}/report.html")
        for text in evaluation.experiment.warnings:  # again: the lines of the trials are between
            terminal.info(f"warning: {text}")
    failed = [row for row in evaluation.rows if row.outcome == "failed"]
    for row in failed:
        terminal.problem(f"{row.key[0]}, {row.method}, seed {row.seed}: failed: {row.error}")
    if not failed:
        return ExitStatus.DONE
    defects = sum(row.is_defect for row in failed)
    why = reason_of_failures(len(failed), defects)
    way_on = "; mend it, and evaluate it in another folder" if defects < len(failed) else ""
    terminal.error(f"{len(failed)} of {counted(len(evaluation.rows), 'trial')} failed, {why}{way_on}")
    return ExitStatus.INTERNAL if defects else ExitStatus.INVALID
