"""Summary of an evaluation: the columns of the paper's tables with intervals and tests."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from kraft.evaluation.experiment import Experiment
from kraft.evaluation.journal import Key, TrialRow, elapsed, success_times
from kraft.evaluation.paper import PaperRow, paper_row
from kraft.evaluation.statistics import McNemar, mcnemar, percentile, while_driving, wilson
from kraft.scenario import Score
from kraft.text import finite
from kraft.trial.measures import BAND, Measures, pooled

SCHEMA: Final = "kraft.eval/1"
FILE: Final = "summary.json"
REFERENCE: Final = "kraft"
"""The method that the others are compared with."""
MANY: Final = 8
"""Largest number of entries of which each has a table of its own in a terminal, and an open section in the report."""


@dataclass(frozen=True)
class RowName:
    """Entry, scenario, settings, method, the method's title, and the entry's score of a row of a results table.

    `bound` is a lower bound of the time to the goal, s; None in older evaluations.  `of_paper` is whether the paper has
    this method in this scenario.
    """

    entry: str
    scenario: str
    settings: Mapping[str, Any]
    method: str
    title: str
    score: Score | None = None
    bound: float | None = None
    of_paper: bool = True


@dataclass(frozen=True)
class Result:
    """Row of a results table.

    Attributes:
        entry: name of the entry of the suite; that of the scenario without a suite and without varied keys.
        settings: values of the scenario's keys that were set.
        trials: number of trials, including failed ones.
        interval: Wilson's 95 % interval of the success rate.
        bound: lower bound of the time to the goal, s: the shortest path at top speed.
        t_ex: mean duration of the successful trials, s.
        contingencies: number of contingencies in all trials.
        min_clearance: smallest true distance to an obstacle in all trials, m.
        first_plan_p50: median of the time of the first plan, before the vehicle drives, ms.
        planning_p50, planning_p99: percentiles of the planning time over all later cycles of all trials, ms.
        missed: number of cycles that exceeded their planning time.
        command_p50, command_p99: percentiles of the time of the controller's commands in all trials, ms; None in older
            evaluations.
        late_commands: number of commands that took longer than the time between two of them.
        causes: number of collisions and timeouts by their cause, the most frequent first; not those of trials without
            one, which older evaluations recorded.
        measures: measures of what the method promised, over all trials.
        scoring: how the scenario is scored; None for most.
        score: mean score of all trials; None without scoring.
        against: comparison with the method `kraft` on the same seeds; None for itself and where it was not run.
        paper: result in the paper; None where keys were set, or something else is not as bundled.
    """

    entry: str
    scenario: str
    settings: Mapping[str, Any]
    method: str
    title: str
    trials: int
    success: int
    collision: int
    timeout: int
    failed: int
    interval: tuple[float, float]
    bound: float | None
    t_ex: float | None
    contingencies: int
    cycles: int
    min_clearance: float | None
    first_plan_p50: float | None
    planning_p50: float | None
    planning_p99: float | None
    missed: int
    command_p50: float | None
    command_p99: float | None
    late_commands: int
    causes: Mapping[str, int]
    measures: Measures
    scoring: Score | None
    score: float | None
    against: McNemar | None
    paper: PaperRow | None

    @property
    def replans(self) -> bool:
        """Whether the method replans: then its decisions can be compared."""
        return self.measures.compared > 0 or self.cycles > self.trials


@dataclass(frozen=True)
class Summary:
    """All rows in the order of the experiment.

    `wall` is the time for which the evaluation ran, s, over all commands that resumed it.
    """

    trials: int
    seed: int
    realtime: bool
    wall: float
    results: tuple[Result, ...]

    @property
    def entries(self) -> list[str]:
        """Names of the entries, in their order."""
        return list(dict.fromkeys(result.entry for result in self.results))

    @property
    def failed(self) -> int:
        """Number of failed trials."""
        return sum(result.failed for result in self.results)

    @property
    def by_cell(self) -> dict[tuple[str, str], Result]:
        """Each row by the names of its entry and method."""
        return {(result.entry, result.method): result for result in self.results}

    def of_entry(self, entry: str) -> list[Result]:
        """Rows of an entry, in the order of the methods."""
        return [result for result in self.results if result.entry == entry]

    def of_method(self, method: str) -> list[Result]:
        """Rows of a method, in the order of the entries."""
        return [result for result in self.results if result.method == method]


def summarise(experiment: Experiment, rows: Mapping[Key, TrialRow], wall: float) -> Summary:
    """Summarise the finished trials of an experiment."""
    titles = distinct_titles({cell.method.name: cell.method.title for cell in experiment.cells})
    names = [
        RowName(
            cell.entry.name,
            cell.scenario.name,
            cell.entry.settings,
            cell.method.name,
            titles[cell.method.name],
            cell.scenario.trial.score,
            None if (seconds := experiment.bounds.get(cell.entry.name)) is None else round(seconds, 6),
            cell.of_paper,
        )
        for cell in experiment.cells
    ]
    return tabulate(names, experiment.seeds, rows, wall, realtime=experiment.realtime)


def distinct_titles(titles: Mapping[str, str]) -> dict[str, str]:
    """Title of each method by its name; where several have the same title, each with its name."""
    counts = Counter(titles.values())
    return {name: title if counts[title] == 1 else f"{title} ({name})" for name, title in titles.items()}


def tabulate(
    names: Sequence[RowName], seeds: range, rows: Mapping[Key, TrialRow], wall: float, *, realtime: bool = False
) -> Summary:
    """Summarise finished trials in the rows `names`; `wall` is the duration of the evaluation (s)."""
    results = []
    for name in names:
        mine = _rows(seeds, rows, name.entry, name.method)
        theirs = _rows(seeds, rows, name.entry, REFERENCE) if name.method != REFERENCE else []
        ours, others = _successes(mine), _successes(theirs)
        against = mcnemar(ours, others) if ours.keys() & others.keys() else None
        results.append(_result(name, mine, against))
    return Summary(len(seeds), seeds.start, realtime, wall, tuple(results))


def evaluation_json(summary: Summary, warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Content of the ``kraft.eval/1`` object, without its schema; `warnings` are those before the first trial."""
    return {
        "trials": summary.trials,
        "seed": summary.seed,
        "realtime": summary.realtime,
        "wall_s": round(summary.wall, 3),
        "failed": summary.failed,
        "warnings": list(warnings),
        "results": [_result_json(result) for result in summary.results],
    }


def measures_json(measures: Measures) -> dict[str, Any]:
    """Keys of the JSON objects for measures; those of a clearance are null for a method without one."""
    kept, consistency = measures.clearance, measures.consistency
    return {
        "delta_coverage": kept.coverage,
        "delta_coverage_plans": measures.plans.coverage,
        "delta_coverage_contingencies": measures.contingencies.coverage,
        "delta_mean_m": kept.delta_mean,
        "deviation_m": [
            dict(zip(("until_s", "p50", "p90", "p99", "max"), quantiles, strict=True))
            for quantiles in measures.deviation_quantiles((0.5, 0.9, 0.99, 1.0))
        ],
        "emergencies": measures.emergencies,
        "contingencies_in_hand": measures.in_hand,
        "regressions": sum(measures.regressions.values()),
        "regressions_by_reason": dict(measures.regressions),
        "cycles_compared": measures.compared,
        "messages_lost": measures.messages_lost,
        "watchdog_stops": measures.watchdog_stops,
        "consistency": {
            "poses": consistency.poses,
            "nees_mean": consistency.mean,
            "nees_band95": list(BAND),
            "nees_in_band": consistency.share,
        }
        if consistency is not None
        else None,
    }


def wall_of(recorded: float | None, rows: Iterable[TrialRow]) -> float:
    """Time for which an evaluation has run, s: until the last of its trials ended, or as its summary has `recorded`.

    A command that was killed wrote no summary, and older evaluations have no times of trials.
    """
    return max(recorded or 0.0, elapsed(rows))


def recorded_wall(folder: Path) -> float | None:
    """Duration of an evaluation in the summary of its folder, s; 0 without a summary, None if it is damaged."""
    try:
        return finite(float(json.loads((folder / FILE).read_bytes())["wall_s"]))
    except FileNotFoundError:
        return 0.0
    except (OSError, ValueError, OverflowError, RecursionError, KeyError, TypeError):
        return None


def _rows(seeds: range, rows: Mapping[Key, TrialRow], entry: str, method: str) -> list[TrialRow]:
    keys = ((entry, method, seed) for seed in seeds)
    return [rows[key] for key in keys if key in rows]


def _successes(rows: Sequence[TrialRow]) -> dict[int, bool]:
    return {row.seed: row.outcome == "success" for row in rows}


def _result(name: RowName, rows: Sequence[TrialRow], against: McNemar | None) -> Result:
    outcomes = [row.outcome for row in rows]
    success = outcomes.count("success")
    durations = success_times(rows)
    planning = while_driving(row.measured.planning_ms for row in rows)
    first_plans = [row.measured.planning_ms[0] for row in rows if row.measured.planning_ms]
    commands = [value / 1000.0 for row in rows for value in row.measured.command_us]
    scores = [name.score.of(row.success_time) for row in rows] if name.score else []
    clearances = [row.min_clearance_m for row in rows if row.min_clearance_m is not None]
    return Result(
        entry=name.entry,
        scenario=name.scenario,
        settings=name.settings,
        method=name.method,
        title=name.title,
        trials=len(rows),
        success=success,
        collision=outcomes.count("collision"),
        timeout=outcomes.count("timeout"),
        failed=outcomes.count("failed"),
        interval=wilson(success, len(rows)),
        bound=name.bound,
        t_ex=sum(durations) / len(durations) if durations else None,
        contingencies=sum(row.contingencies for row in rows),
        cycles=sum(row.cycles for row in rows),
        min_clearance=min(clearances, default=None),
        first_plan_p50=percentile(first_plans, 0.5),
        planning_p50=percentile(planning, 0.5),
        planning_p99=percentile(planning, 0.99),
        missed=sum(row.measured.missed for row in rows),
        command_p50=percentile(commands, 0.5),
        command_p99=percentile(commands, 0.99),
        late_commands=sum(row.measured.late_commands for row in rows),
        causes=dict(Counter(str(row.cause.kind) for row in rows if row.cause is not None).most_common()),
        measures=pooled(row.measures for row in rows),
        scoring=name.score,
        score=sum(scores) / len(scores) if scores else None,
        against=against,
        paper=paper_row(name.scenario, name.method) if name.of_paper and not name.settings else None,
    )


def _result_json(result: Result) -> dict[str, Any]:
    paper, against, scoring = result.paper, result.against, result.scoring
    return {
        "entry": result.entry,
        "scenario": result.scenario,
        "set": dict(result.settings),
        "method": result.method,
        "trials": result.trials,
        "success": result.success,
        "collision": result.collision,
        "timeout": result.timeout,
        "failed": result.failed,
        "success_ci95": list(result.interval),
        "t_ex_s": None if result.t_ex is None else round(result.t_ex, 6),
        "t_bound_s": result.bound,
        "contingencies": result.contingencies,
        "cycles": result.cycles,
        "min_clearance_m": result.min_clearance,
        "first_plan_ms_p50": result.first_plan_p50,
        "planning_ms_p50": result.planning_p50,
        "planning_ms_p99": result.planning_p99,
        "missed_deadlines": result.missed,
        "command_ms_p50": result.command_p50,
        "command_ms_p99": result.command_p99,
        "late_commands": result.late_commands,
        "causes": dict(result.causes),
        **measures_json(result.measures),
        "score": {"label": scoring.label, "optimal_time_s": scoring.optimal_time, "mean": result.score}
        if scoring
        else None,
        "mcnemar": {"gained": against.gained, "lost": against.lost, "p": against.p} if against else None,
        "paper": {
            "trials": paper.trials,
            "success": paper.success,
            "collision": paper.collision,
            "timeout": paper.timeout,
            "t_ex_s": paper.t_ex,
        }
        if paper
        else None,
    }
