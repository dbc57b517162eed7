"""Run benchmarks, print their tables, and write results.json."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.machine import describe
from benchmarks.report import Report
from kraft.driving.method import load_method
from kraft.errors import InputError

TOPICS = (
    "planner",
    "peers",
    "peers_table",
    "tuning",
    "commands",
    "predictions",
    "scaling",
    "maps",
    "goals",
    "polish",
    "callbacks",
    "startup",
    "safety",
    "world",
    "drive",
    "theorem",
    "estimated",
    "knowledge",
    "estimates",
    "changes",
    "arenas",
    "worlds",
    "headings",
    "sysid",
    "disturbances",
    "structures",
    "experiment",
    "open_loop",
    "sensing",
    "robot",
    "faults",
    "endurance",
)
NEEDS_OUT = ("peers",)
CHOSEN = ("estimated", "knowledge", "estimates", "changes", "arenas", "worlds", "headings")
"""Topics that drive with a method of one's choice."""


def main(arguments: list[str] | None = None) -> int:
    """Run what the command line asks for; 1 if a target was missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help=f"of {', '.join(TOPICS)}; all if none is given")
    parser.add_argument("--quick", action="store_true", help="measure little, to see that everything works")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), metavar="DIR", help="for the results")
    parser.add_argument("--method", default=FULL.method, help=f"that drives in {', '.join(CHOSEN)} (%(default)s)")
    given = parser.parse_args(arguments)
    if unknown := [topic for topic in given.topics if topic not in TOPICS]:
        parser.error(f"there is no topic {', '.join(unknown)}; expected {', '.join(TOPICS)}")
    try:
        load_method(given.method)
    except InputError as error:
        parser.error(str(error))
    effort = replace(QUICK if given.quick else FULL, method=given.method)
    given.out.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {"machine": describe(), "quick": given.quick, "topics": {}}
    if given.topics and (file := given.out / "results.json").is_file():
        earlier = json.loads(file.read_text(encoding="utf-8"))
        if conditions(earlier) != conditions(content):
            parser.error(f"{file} is of another machine, other versions or another effort; expected another --out")
        content["topics"] = earlier["topics"]  # but for those that are measured now
    warn_if_busy(content["machine"])
    reports = []
    for topic in given.topics or TOPICS:
        report, took = run_topic(topic, effort, given.out)
        print(report.text(), flush=True)
        reports.append(report)
        content["topics"][topic] = {**report.as_json(), "seconds": round(took, 1)}
        (given.out / "results.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row.met is not False for report in reports for row in report.rows) else 1


def conditions(content: dict[str, Any]) -> Any:
    """What results must have in common to be in one file: all of the machine but its load and the arguments."""
    same = {key: value for key, value in content["machine"].items() if key not in ("load", "arguments")}
    return same, content["quick"]


def run_topic(topic: str, effort: Effort, out: Path) -> tuple[Report, float]:
    """A topic's report and how long it took (s)."""
    print(f"measuring {topic} ...", file=sys.stderr, flush=True)
    module, began = importlib.import_module(f"benchmarks.{topic}"), time.perf_counter()
    report = module.run(effort, out) if topic in NEEDS_OUT else module.run(effort)
    return report, time.perf_counter() - began


def warn_if_busy(machine: dict[str, Any]) -> None:
    """Say so if other work is running: times are then not what the machine can do."""
    load = machine["load"][0]
    if load > 0.5:
        print(f"the machine is busy (load {load}): times are worse than they could be", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
