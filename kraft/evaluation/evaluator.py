"""`evaluate`: run trials of methods in scenarios and summarise them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kraft.config.document import frozen
from kraft.driving.needs import needs_of
from kraft.errors import Code, Diagnostic, Problems, Unreachable, out_of_range
from kraft.evaluation.cluster import Cluster
from kraft.evaluation.experiment import METHODS, SUITE, TRIALS, Experiment, MethodLike, experiment_of
from kraft.evaluation.folder import NEW, Folder, check_exists, check_resumable, create, reopen, write_results
from kraft.evaluation.job import Executor
from kraft.evaluation.journal import Key, TrialRow
from kraft.evaluation.processes import Processes, check_script
from kraft.evaluation.report import CommandLine
from kraft.evaluation.suite import ScenarioLike, SettingsLike, Sweeps, entries_of
from kraft.evaluation.summary import Summary, summarise
from kraft.files import check_new_folder
from kraft.planning.compilation import Needs, ensure_all_compiled
from kraft.planning.feasibility import check_reachable
from kraft.text import MessageSink, counted, no_messages
from kraft.trial.warnings import WARNINGS
from ompl_ext.cores import usable_cores


class Observer:
    """Receives the progress of an evaluation and may stop it; this base class ignores everything."""

    def log(self, text: str) -> None:
        """Receive a message for the user."""

    def warn(self, text: str) -> None:
        """Receive what is probably a mistake in the trials, before the first of them; by default a message."""
        self.log(f"warning: {text}")

    def started(self, experiment: Experiment, folder: Path | None, rows: Mapping[Key, TrialRow]) -> None:
        """Receive what is about to run; `rows` are finished trials of the resumed folder."""

    def trial_ended(self, row: TrialRow) -> None:
        """Receive a finished trial, which is already in the journal."""

    def stop_requested(self) -> bool:
        """Whether to start no more trials; called several times a second."""
        return False


class Messages(Observer):
    """Passes messages on and ignores everything else."""

    def __init__(self, log: MessageSink) -> None:
        """Pass messages to `log`."""
        self._log = log

    def log(self, text: str) -> None:
        """Pass a message on."""
        self._log(text)


@dataclass(frozen=True)
class Evaluation:
    """Rows of an evaluation in the order of its trials, and their summary; not `complete` if it was stopped."""

    experiment: Experiment
    folder: Path | None
    rows: tuple[TrialRow, ...]
    summary: Summary
    complete: bool


def evaluate(
    scenarios: Sequence[ScenarioLike] | None = None,
    methods: Sequence[MethodLike] = METHODS,
    trials: int = TRIALS,
    seed: int = 0,
    jobs: int | None = None,
    out: str | Path | None = None,
    *,
    suite: str | Path | None = None,
    settings: SettingsLike = (),
    vary: Sweeps = (),
    vehicle: str | Path | None = None,
    resume: bool = False,
    realtime: bool = False,
    cluster: str | None = None,
    observer: Observer | None = None,
    log: MessageSink | None = None,
    arguments: Mapping[str, Any] | None = None,
    command_line: CommandLine | None = None,
) -> Evaluation:
    """Run every method in every entry with the seeds `seed`, ... `seed + trials - 1`, the same for all.

    Entries are scenarios, or those of a suite, with some of their keys set.

    Apart from measured times the result does not depend on `jobs`, on `cluster` or on the order in which trials end.
    A script that calls this needs ``if __name__ == "__main__":``, because worker processes import it.

    Args:
        scenarios: names, paths or loaded scenarios.
        methods: names, paths or loaded methods.
        trials: number of trials of each method in each entry, at most 100,000.
        seed: seed of the first trial.
        jobs: number of worker processes, by default one for each usable core.
        out: results folder; None writes nothing.
        suite: name or path of a suite that replaces `scenarios`; without both the suite ``paper``.
        settings: values of the scenarios' dotted keys, as in ``{"sensing.noise_scale": 2}``.
        vary: several values for a key; each value makes an entry of its own, as in ``{"sensing.rate_hz": [5, 30]}``.
        vehicle: planning model that replaces those of the methods and scenarios.
        resume: continue the evaluation in the folder `out`; it may get more trials and more methods, and those that it
            has stay as they are.
        realtime: limit planning by wall-clock time instead of iterations; the trials are then not repeatable.
        cluster: address of a Dask scheduler that replaces the worker processes.
        observer: receives the progress and may stop the evaluation.
        log: receives messages, as ``print`` does: warnings, and what is compiled, which takes up to a minute; an
            observer receives them itself.
        arguments: the user's arguments, recorded in the manifest.
        command_line: makes the commands on the report page that repeat a trial; without it the page has none.

    Raises:
        InputError: with every problem of the arguments; if the folder cannot be written, or if the resumed folder
            belongs to another evaluation.  Finished trials stay in the folder.  If the program is read from stdin:
            worker processes cannot import it.
        TypeError: if scenarios, methods, settings, values to vary, suite or vehicle are of another type, or both
            `observer` and `log` are given.
        Unreachable: with every unreachable goal, before the folder is made.
        MissingError: if a part of the installation is missing.
        Defect: if workers do not start.  A defect inside a trial fails that trial only.
    """
    if observer is not None and log is not None:
        raise TypeError("log: expected none beside an observer, which receives the messages")
    observer = observer or Messages(log or no_messages)
    recorded = frozen(dict(arguments or {}))  # before a folder is made
    experiment = check_arguments(
        scenarios, methods, trials, seed, jobs, out, suite=suite, settings=settings, vary=vary, vehicle=vehicle,
        resume=resume, realtime=realtime, log=observer.log,
    )  # fmt: skip
    if resume and out is not None:
        check_resumable(Path(out), experiment, recorded)
    if cluster is None:
        check_script()
    executor: Executor = Cluster(cluster) if cluster is not None else Processes(jobs or usable_cores())
    warnings = tuple(_warnings(experiment))
    for text in warnings:
        observer.warn(text)
    if cluster is not None and jobs is not None:
        observer.warn(f"jobs: {jobs} has no effect with a cluster, whose workers state their threads themselves")
    _ensure_compiled(experiment, observer.log)
    experiment = replace(experiment, bounds=_least_times(experiment), warnings=warnings)
    if out is None:
        return _run_experiment(experiment, executor, None, observer, command_line)
    folder = (reopen if resume else create)(Path(out), experiment, recorded)
    with closing(folder.journal):
        return _run_experiment(experiment, executor, folder, observer, command_line)


def check_arguments(
    scenarios: Sequence[ScenarioLike] | None,
    methods: Sequence[MethodLike],
    trials: int,
    seed: int,
    jobs: int | None,
    out: str | Path | None,
    *,
    suite: str | Path | None = None,
    settings: SettingsLike = (),
    vary: Sweeps = (),
    vehicle: str | Path | None = None,
    resume: bool = False,
    realtime: bool = False,
    log: MessageSink = no_messages,
) -> Experiment:
    """Experiment of arguments of `evaluate`; `log` gets messages about kernels that the checks compile.

    Raises:
        InputError: with every problem of the arguments.
    """
    problems = Problems()
    if jobs is not None:
        problems.found += out_of_range("jobs", jobs, 1)
    if resume and out is None:
        expected = "expected the folder of the evaluation to resume"
        diagnostic = Diagnostic("resume", "is given without a folder", expected, code=Code.MISSING, argument=True)
        problems.found.append(diagnostic)
    if out is not None:
        problems.of(lambda: check_exists(Path(out)) if resume else check_new_folder(Path(out), NEW))
    if scenarios is not None and suite is not None:
        problem, expected = "is given together with scenarios", "expected either one"
        problems.found.append(Diagnostic("suite", problem, expected, code=Code.CONFLICT, argument=True))
        problems.of(lambda: entries_of(scenarios, settings=settings, vary=vary))
    experiment = problems.of(
        lambda: experiment_of(
            scenarios or (), methods, suite=SUITE if scenarios is None and suite is None else suite,
            settings=settings, vary=vary, vehicle=vehicle, trials=trials, seed=seed, realtime=realtime, log=log,
        )
    )  # fmt: skip
    problems.check()
    assert experiment is not None, "every problem was raised"
    return experiment


def _warnings(experiment: Experiment) -> Iterator[str]:
    """Each warning with the first entry that it concerns, and how many others there are."""
    for warning in WARNINGS:
        texts = ((cell.entry.name, warning(cell.scenario, cell.method, cell.vehicle)) for cell in experiment.cells)
        found = {name: text for name, text in texts if text}
        if not found:
            continue
        name, text = next(iter(found.items()))
        more = f"; the same in {counted(len(found) - 1, 'other entry')}" if len(found) > 1 else ""
        yield f"{name}: {text}{more}"


def _ensure_compiled(experiment: Experiment, log: MessageSink) -> None:
    """Compile what the trials need once here, not by every worker during a trial."""
    experiment.check_available()
    needs: dict[str, Needs] = {}
    for cell in experiment.cells:
        before = needs.get(cell.reference)
        vehicle = cell.vehicle if before is None else before.vehicle
        found = needs_of(cell.method, vehicle, cell.scenario.goal)
        needs[cell.reference] = found if before is None else before | found
    ensure_all_compiled(needs.values(), log)


def _least_times(experiment: Experiment) -> dict[str, float]:
    """Lower bound of the time to the goal of each entry (s), that of the fastest model.

    Raises:
        Unreachable: with every unreachable goal.
    """
    found: list[Diagnostic] = []
    bounds: dict[str, float] = {}
    for cell in {(cell.entry.name, cell.reference): cell for cell in experiment.cells}.values():
        try:
            seconds = check_reachable(cell.scenario.task(), cell.vehicle)
            bounds[cell.entry.name] = min(seconds, bounds.get(cell.entry.name, seconds))
        except Unreachable as error:
            found += error.diagnostics
    if found:
        raise Unreachable(found)
    return bounds


def _run_experiment(
    experiment: Experiment,
    executor: Executor,
    folder: Folder | None,
    observer: Observer,
    command_line: CommandLine | None,
) -> Evaluation:
    began = time.perf_counter() - (folder.wall if folder else 0.0)
    rows = dict(folder.rows) if folder else {}
    if folder and folder.incomplete_line:
        observer.log(f"{folder.journal.path}: the last line is incomplete; its trial is repeated")
    observer.started(experiment, folder.path if folder else None, rows)
    todo = [each for each in experiment.jobs() if each.key not in rows]
    with closing(executor.run(todo, observer.stop_requested, observer.log)) as ended:  # type: ignore[type-var]
        for row in ended:
            row = row.after(time.perf_counter() - began)  # noqa: PLW2901
            if folder:
                folder.journal.append(row)
            row = row.model_copy(update={"replay": None})  # noqa: PLW2901  (it is on the disk now, and large)
            rows[row.key] = row
            observer.trial_ended(row)
    ordered = tuple(rows[each.key] for each in experiment.jobs() if each.key in rows)
    summary = summarise(experiment, rows, time.perf_counter() - began)
    complete = len(ordered) == sum(1 for _ in experiment.jobs())
    if folder and complete:
        write_results(folder, experiment, rows, summary, command_line)
    return Evaluation(experiment, folder.path if folder else None, ordered, summary, complete)
