"""OMPL's own benchmark of the same planners: its log, and the database that Planner Arena reads, made by its tool."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from ompl import base as ob
from ompl import control as oc
from ompl import tools
from ompl import util as ou

from benchmarks.effort import Effort
from benchmarks.report import number, silenced
from benchmarks.scenes import SCENES, Scene, scene
from benchmarks.search import costs_over_time
from kraft.evaluation.ompl_benchmark import make_database
from ompl_ext.planner import DIRT
from ompl_ext.system import SimpleSetup

DATABASE = "planner_arena.db"
DURATION, EDGES, STATES = "solution duration REAL", "edges INTEGER", "graph states INTEGER"
TIME, BEST = "time REAL", "best duration REAL"
Properties = dict[str, str]


class Recorder:
    """Takes down, after each run, what OMPL's benchmark does not ask of planners."""

    def __init__(self, setup: SimpleSetup) -> None:
        self._setup, self._steps = setup, setup.steps
        self.runs: list[Properties] = []
        self.progress: list[list[Properties]] = []

    def __call__(self, planner: ob.Planner, _: object) -> None:
        """OMPL's event after a run; the run it hands over is a copy, so what is noted here is entered later."""
        steps, self._steps = self._setup.steps - self._steps, self._setup.steps
        solved = self._setup.haveExactSolutionPath()
        found = {DURATION: f"{self._setup.getSolutionPath().length():.9g}" if solved else "nan"}
        curve: list[Properties] = []
        if isinstance(planner, DIRT):
            found |= {EDGES: str(planner.edges), STATES: str(len(planner.tree().parents))}
            curve = [{TIME: f"{t:.9g}", BEST: f"{cost:.9g}"} for t, cost in costs_over_time(planner)]
        else:
            found["propagation steps INTEGER"] = str(steps)
        self.runs.append(found)
        self.progress.append(curve)


def write_log(effort: Effort, out: Path) -> list[str]:
    """Run OMPL's benchmark on every scene, write `<scene>.log` and the database into `out`; returns remarks."""
    logs = []
    for name in SCENES:
        logs.append(out / f"{name}.log")
        benchmark_scene(scene(name), effort, logs[-1])
    database = out / DATABASE
    make_database(database, logs)
    return [f"OMPL benchmark logs and {DATABASE} in {out}:", *(f"  {line}" for line in contents(database))]


def benchmark_scene(query: Scene, effort: Effort, log: Path) -> None:
    """OMPL's benchmark of all planners on one scene."""
    ou.setLogLevel(ou.LOG_NONE)
    setup = query.setup()
    si = setup.getSpaceInformation()
    benchmark = tools.Benchmark(setup, query.name)
    dirt = DIRT(si)
    for planner in (dirt, oc.RRT(si), oc.EST(si), oc.KPIECE1(si)):
        benchmark.addPlanner(planner)
    recorder = Recorder(setup)
    benchmark.setPostRunEvent(recorder)
    request = tools.Request(
        maxTime=effort.seconds, runCount=effort.repeats, displayProgress=False, saveConsoleOutput=False
    )
    with silenced():
        benchmark.benchmark(request)
    experiment = benchmark.getRecordedExperimentData()
    enter(recorder, experiment)
    for parameter, value in dirt.params().getParams().items():
        experiment.planners[0].common[parameter] = value
    log.unlink(missing_ok=True)
    benchmark.saveResultsToFile(str(log))
    ou.setLogLevel(ou.LOG_WARN)
    if not log.is_file():  # OMPL writes elsewhere, and says that it succeeded
        raise OSError(f"OMPL could not write its benchmark log {log}")


def enter(recorder: Recorder, experiment: tools.CompleteExperiment) -> None:
    """Write what was recorded into OMPL's own record, from which it makes its log."""
    runs, progress = iter(recorder.runs), iter(recorder.progress)
    for planner in experiment.planners:
        for run in planner.runs:
            for name, value in next(runs).items():
                run[name] = value
        curves = [next(progress) for _ in planner.runs]
        if any(curves):
            planner.progressPropertyNames = sorted([TIME, BEST])  # values are written in the order of their names
            planner.runsProgressData = curves


def contents(database: Path) -> list[str]:
    """What the database holds, asked of the database."""
    query = """SELECT e.name, c.name, COUNT(*), AVG(r.solved), AVG(r.solution_duration), AVG(r.graph_states),
                      (SELECT COUNT(*) FROM progress p JOIN runs q ON p.runid = q.id
                       WHERE q.plannerid = c.id AND q.experimentid = e.id)
               FROM runs r JOIN plannerConfigs c ON r.plannerid = c.id JOIN experiments e ON r.experimentid = e.id
               GROUP BY e.id, c.id ORDER BY e.id, c.id"""
    with sqlite3.connect(database) as connection:
        rows = connection.execute(query).fetchall()
    connection.close()
    return [
        f"{scene_name} {planner.removeprefix('control_')}: {runs} runs, {solved:.0%} solved, "
        f"mean duration {number(duration or float('nan'))} s, {number(round(states))} states, {points} progress points"
        for scene_name, planner, runs, solved, duration, states, points in rows
    ]
