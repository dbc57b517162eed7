"""Summary of an evaluation: the columns of the paper's tables with confidence intervals and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from kraft.evaluation.experiment import Experiment
from kraft.evaluation.paper import PaperRow, paper_row
from kraft.evaluation.row import Key, TrialRow
from kraft.evaluation.statistics import McNemar, mcnemar, percentile, wilson

SCHEMA: Final = "kraft.eval/1"
FILE: Final = "summary.json"
Name: TypeAlias = tuple[str, str, str]
"""Scenario, method and title of the method of a row."""
REFERENCE: Final = "kraft"
"""The method that the others are compared with."""
WALL_CLOCK: Final = ("wall_s", "planning_ms_p50", "planning_ms_p99", "missed_deadlines")
"""Keys of the JSON object with measured times; all others repeat."""


@dataclass(frozen=True)
class Result:
    """Row of a results table.

    Attributes:
        trials: number of trials, including failed ones.
        interval: Wilson's 95 % interval of the success rate.
        t_ex: mean duration of the successful trials, s.
        contingencies: number of contingencies in all trials.
        min_clearance: smallest true distance to an obstacle in all trials, m.
        planning_p50, planning_p99: percentiles of the planning time over all cycles of all trials, ms.
        missed: number of cycles that exceeded their planning time.
        against: comparison with the method `kraft` on the same seeds; None for itself and where it was not run.
        paper: result in the paper.
    """

    scenario: str
    method: str
    title: str
    trials: int
    success: int
    collision: int
    timeout: int
    failed: int
    interval: tuple[float, float]
    t_ex: float | None
    contingencies: int
    cycles: int
    min_clearance: float | None
    planning_p50: float | None
    planning_p99: float | None
    missed: int
    against: McNemar | None
    paper: PaperRow | None


@dataclass(frozen=True)
class Summary:
    """All rows in the order of the experiment; `wall` is the duration of the last run of the evaluation, s."""

    trials: int
    seed: int
    realtime: bool
    wall: float
    results: tuple[Result, ...]

    @property
    def failed(self) -> int:
        """Number of failed trials."""
        return sum(result.failed for result in self.results)


def summarise(experiment: Experiment, rows: Mapping[Key, TrialRow], wall: float) -> Summary:
    """Summarise the finished trials of an experiment."""
    names = [(*cell.key, cell.method.title) for cell in experiment.cells]
    return tabulate(names, experiment.seeds, rows, wall, realtime=experiment.realtime)


def tabulate(
    names: Sequence[Name], seeds: range, rows: Mapping[Key, TrialRow], wall: float, *, realtime: bool = False
) -> Summary:
    """Summarise finished trials in the rows `names`; `wall` is the duration of the evaluation (s)."""
    results = []
    for scenario, method, title in names:
        mine = _rows(seeds, rows, scenario, method)
        theirs = _rows(seeds, rows, scenario, REFERENCE) if method != REFERENCE else []
        against = mcnemar(_successes(mine), _successes(theirs)) if theirs else None
        results.append(_result(scenario, method, title, mine, against))
    return Summary(len(seeds), seeds.start, realtime, wall, tuple(results))


def evaluation_json(summary: Summary) -> dict[str, Any]:
    """Content of the ``kraft.eval/1`` object, without its schema."""
    return {
        "trials": summary.trials,
        "seed": summary.seed,
        "realtime": summary.realtime,
        "wall_s": round(summary.wall, 3),
        "failed": summary.failed,
        "results": [_result_json(result) for result in summary.results],
    }


def _rows(seeds: range, rows: Mapping[Key, TrialRow], scenario: str, method: str) -> list[TrialRow]:
    keys = ((scenario, method, seed) for seed in seeds)
    return [rows[key] for key in keys if key in rows]


def _successes(rows: Sequence[TrialRow]) -> dict[int, bool]:
    return {row.seed: row.outcome == "success" for row in rows}


def _result(scenario: str, method: str, title: str, rows: Sequence[TrialRow], against: McNemar | None) -> Result:
    outcomes = [row.outcome for row in rows]
    success = outcomes.count("success")
    durations = [row.t_s for row in rows if row.outcome == "success" and row.t_s is not None]
    planning = [value for row in rows for value in row.measured.planning_ms]
    clearances = [row.min_clearance_m for row in rows if row.min_clearance_m is not None]
    return Result(
        scenario=scenario,
        method=method,
        title=title,
        trials=len(rows),
        success=success,
        collision=outcomes.count("collision"),
        timeout=outcomes.count("timeout"),
        failed=outcomes.count("failed"),
        interval=wilson(success, len(rows)),
        t_ex=sum(durations) / len(durations) if durations else None,
        contingencies=sum(row.contingencies for row in rows),
        cycles=sum(row.cycles for row in rows),
        min_clearance=min(clearances, default=None),
        planning_p50=percentile(planning, 0.5),
        planning_p99=percentile(planning, 0.99),
        missed=sum(row.measured.missed for row in rows),
        against=against,
        paper=paper_row(scenario, method),
    )


def _result_json(result: Result) -> dict[str, Any]:
    paper, against = result.paper, result.against
    return {
        "scenario": result.scenario,
        "method": result.method,
        "trials": result.trials,
        "success": result.success,
        "collision": result.collision,
        "timeout": result.timeout,
        "failed": result.failed,
        "success_ci95": list(result.interval),
        "t_ex_s": result.t_ex,
        "contingencies": result.contingencies,
        "cycles": result.cycles,
        "min_clearance_m": result.min_clearance,
        "planning_ms_p50": result.planning_p50,
        "planning_ms_p99": result.planning_p99,
        "missed_deadlines": result.missed,
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
