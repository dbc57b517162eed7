"""A drive over topics, as two processes: how it ends beside a trial, and how well the controller keeps to its clock."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.rig import free_port
from kraft.trial.result import TrialSpec
from kraft.trial.trial import run_trial

SCENES: Final = ("turns", "boxes", "bump", "slope", "slip", "movable")
METHOD: Final = "adaptive-kraft"
LATE: Final = 0.003
TIMEOUT: Final = 240.0
FILE: Final = """name: bench
transport: {transport}
pose: {{topic: /pf/pose/odom, type: nav_msgs/msg/Odometry, rate_hz: 30, level_camera: true}}
command: {{topic: /drive, type: ackermann_msgs/msg/AckermannDriveStamped}}
"""


@dataclass(frozen=True)
class Pair:
    """How one drive ended for the simulated robot and for kraft, and its ticks: lateness, duration (s)."""

    world: dict[str, Any]
    drive: dict[str, Any]
    late: list[float]
    work: list[float]


def run(effort: Effort) -> Report:
    """Drive every scene over both transports, and as trials in real time."""
    rows: list[Row] = []
    table = [["scene", "transport", "success", "collision", "timeout", "mean time (s)"]]
    late: list[float] = []
    work: list[float] = []
    for scene in SCENES[: max(1, min(len(SCENES), effort.drives))]:
        trials = [run_trial(replace(TrialSpec.load(scene, METHOD, seed=seed), realtime=True))
                  for seed in range(effort.drives)]  # fmt: skip
        table.append(_line(scene, "none", [{"outcome": t.outcome.value, "t_s": t.time} for t in trials]))
        for transport in ("rosbridge", "ros2"):
            pairs = [drive(scene, transport, seed) for seed in range(effort.drives)]
            table.append(_line(scene, transport, [pair.world for pair in pairs]))
            late += [value for pair in pairs for value in pair.late]
            work += [value for pair in pairs for value in pair.work]
    share = [100.0 * sum(value > LATE for value in late) / max(len(late), 1)]
    rows.append(row("ticks over 3 ms late", "%", share, Target(0.1)))
    rows.append(row("lateness of a tick", "ms", [1000.0 * value for value in late]))
    rows.append(row("tick begins to command sent", "ms", [1000.0 * value for value in work], Target(2.0)))
    notes = [f"{METHOD}; two processes on this machine, `kraft world` and `kraft drive`, in real time."]
    return Report("robot", rows, {"how drives end": table}, notes)


def _line(scene: str, transport: str, ends: list[dict[str, Any]]) -> list[str]:
    counts = [sum(end["outcome"] == name for end in ends) for name in ("success", "collision", "timeout")]
    times = [end["t_s"] for end in ends if end["outcome"] == "success"]
    mean = f"{sum(times) / len(times):.1f}" if times else "-"
    return [scene, transport, *map(str, counts), mean]


def drive(scene: str, transport: str, seed: int) -> Pair:
    """One drive of two processes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if transport == "ros2":
            settings = f"{{kind: ros2, domain: {1 + seed % 200}, interface: lo}}"
        else:
            settings = f'{{kind: rosbridge, url: "ws://localhost:{free_port()}"}}'
        (folder / "robot.yaml").write_text(FILE.format(transport=settings), encoding="utf-8")
        common = [scene, "--robot", str(folder / "robot.yaml"), "--seed", str(seed), "--json"]
        with ExitStack() as ends:
            world = _kraft("world", *common)
            ends.callback(_end, world)
            driver = _kraft("drive", *common, "--method", METHOD, "--out", str(folder / "out"))
            ends.callback(_end, driver)
            driven, _ = driver.communicate(timeout=TIMEOUT)
            simulated, _ = world.communicate(timeout=TIMEOUT)
        with (folder / "out" / "steps.csv").open(encoding="utf-8", newline="") as file:
            steps = list(csv.DictReader(file))
        late, work = ([float(step[name]) for step in steps] for name in ("late", "work"))
        return Pair(json.loads(simulated), json.loads(driven), late, work)


def _kraft(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "kraft_cli", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def _end(process: subprocess.Popen[str]) -> None:
    """End a process that may have ended by itself, and close what was read of it."""
    with process:
        process.kill()
