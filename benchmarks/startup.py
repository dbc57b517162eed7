"""`kraft plan` as a user runs it: time and memory of the process, the first run ever, and the same bytes every time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.scenes import SCENES
from kraft.planning.compilation import ensure_compiled
from kraft.planning.plan import plan_task
from kraft.planning.plan_file import NAME, Origin, plan_text
from kraft.planning.search import Budget
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario

LAUNCHER = Path(__file__).with_name("launch.py")
MEGABYTE = 1e6
ITERATIONS, SEED = 5000, 7  # of plans that must be the same bytes


@dataclass(frozen=True)
class Run:
    """A finished process: wall-clock time (s), largest resident memory (bytes), what it said, its exit code."""

    seconds: float
    memory: int
    said: str
    code: int


def run(effort: Effort) -> Report:
    """Measure `kraft plan turns`, and compare plan files of many processes."""
    ensure_compiled(vehicle_of_task(load_scenario("turns").task()), lambda text: print(text, file=sys.stderr))
    warm = [kraft("plan", "turns") for _ in range(effort.processes + 1)][1:]  # the first one reads files from disk
    problems = [each.said for each in warm if each.code != 0]
    rows = [
        row("kraft plan turns", "s", [each.seconds for each in warm], Target(2.0)),
        row("kraft plan turns: memory", "MB", [each.memory / MEGABYTE for each in warm], Target(300.0)),
    ]
    if effort.first_run:
        first = first_run()
        rows.append(row("kraft plan turns: first run ever", "s", [first.seconds], Target(20.0)))
        says = "compil" in first.said
        rows.append(row("first run says that it compiles (1: it does)", "", [says], Target(1, most=False)))
        problems += [first.said] if first.code != 0 else []
    for name in SCENES:
        rows += same_bytes(name, effort.processes)
    notes = [
        "From starting the process to its exit, with all that Python imports; the kernel cache is warm but for the",
        "first run ever. Memory is the largest resident set, of one process.",
        f"Same bytes: seed {SEED}, {ITERATIONS:,} iterations, plan files of different processes and of this one.",
        *(f"FAILED: {problem.strip()}" for problem in problems),
    ]
    return Report("startup", rows, notes=notes)


def kraft(*arguments: str, cache: Path | None = None) -> Run:
    """Run `kraft` in a process of its own."""
    environment = dict(os.environ)
    if cache is not None:
        environment["KRAFT_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-S", str(LAUNCHER), sys.executable, "-m", "kraft_cli", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return Run(**json.loads(done.stdout))


def first_run() -> Run:
    """`kraft plan turns` with nothing compiled."""
    with tempfile.TemporaryDirectory() as empty:
        return kraft("plan", "turns", cache=Path(empty))


def same_bytes(scenario: str, processes: int) -> list[Row]:
    """How many different plan files processes write, and this one, planning twice."""
    reference = in_process(scenario)
    texts = {reference, in_process(scenario)}
    with tempfile.TemporaryDirectory() as folder:
        for k in range(processes):
            out = Path(folder) / str(k)
            budget = ("--iterations", str(ITERATIONS), "--seed", str(SEED))
            done = kraft("plan", scenario, *budget, "--out", str(out))
            texts.add((out / NAME).read_text(encoding="utf-8") if done.code == 0 else f"failed: {done.said}")
    quantity = f"{scenario}: different plan files in {processes + 2} runs"
    return [row(quantity, "files", [len(texts)], Target(1))]


def in_process(scenario: str) -> str:
    """What `kraft plan --out` writes, made in this process."""
    task = load_scenario(scenario).task()
    task = replace(task, planning=task.planning.with_budget(iterations=ITERATIONS))
    vehicle = vehicle_of_task(task)
    result = plan_task(task, vehicle, Budget(ITERATIONS), SEED)
    return plan_text(task, vehicle, result, Origin(scenario, task.vehicle))
