"""A long drive over topics: whether a process grows, whether the clocks drift apart, and how late the ticks are."""

from __future__ import annotations

import itertools
import math
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Target, row
from benchmarks.rig import Rig
from kraft.robot.messages import POSE, stamped_pose

SCENE: Final = """
name: circuit
bounds: {x: [-5, 5], y: [-5, 5]}
obstacles:
  - {name: block, box: {center: [0, 0], size: [3, 3]}}
  - {name: east, circle: {center: [3.4, 1.0], radius: 0.25}}
  - {name: south, circle: {center: [-1.0, -3.2], radius: 0.25}}
start: {x: -3.5, y: -1.0, heading_deg: 90}
goal: {center: [4.5, 4.5], radius: 0.2}
vehicle: mushr
sensing: {preset: planar, camera: [0, 0, 6], rate_hz: 30}
trial: {timeout: 86400}
"""
CORNERS: Final = ((-3.0, 3.2), (3.0, 3.2), (3.2, -3.0), (-3.2, -3.0))
"""Goals in turn (m), instead of that of the scene; the next one is sent before the car reaches one."""
NEAR: Final = 1.5
"""Distance to a goal at which the next one is sent, m."""
SETTLING: Final = 0.2
"""Share of the drive after which the growth of memory is measured."""
GROWTH: Final = 20.0
"""Growth of the memory of a process in an hour that counts as none, MB."""
DRIFT: Final = 0.01
"""Difference that counts as none between the times of the controller and of the robot that passed, s."""
LATE: Final = 0.003


@dataclass
class Samples:
    """Memory of the processes by time, and the time of the controller less that of the world."""

    times: list[float] = field(default_factory=list)
    memory: dict[str, list[float]] = field(default_factory=dict)
    ahead: list[float] = field(default_factory=list)

    def growth(self, name: str) -> float:
        """Slope of the memory of a process after it has settled, MB in an hour."""
        first = int(SETTLING * len(self.times))
        hours, memory = np.array(self.times[first:]) / 3600.0, self.memory[name][first:]
        return float(np.polyfit(hours, memory, 1)[0])

    @property
    def drift(self) -> float:
        """Change of the difference of the times between the first and the last tenth of the drive, s."""
        tenth = max(1, len(self.ahead) // 10)
        return float(np.median(self.ahead[-tenth:]) - np.median(self.ahead[:tenth]))


def run(effort: Effort) -> Report:
    """Drive round a block for a long time."""
    with tempfile.TemporaryDirectory() as name:
        samples, ticks, collided, laps = drive(Path(name), effort.endurance)
    late = [100.0 * sum(value > LATE for value in ticks) / max(1, len(ticks))]
    rows = [row("collisions", "", [float(collided)], Target(0.0, of="worst")), row("rounds", "", [laps / len(CORNERS)])]
    rows += [row(f"memory of {name}", "MB", samples.memory[name]) for name in samples.memory]
    rows += [row(f"growth of {name}", "MB/h", [samples.growth(name)], Target(GROWTH)) for name in samples.memory]
    rows += [row("drift of the clocks", "ms", [1000.0 * abs(samples.drift)], Target(1000.0 * DRIFT)),
             row("ticks over 3 ms late", "%", late, Target(0.1))]  # fmt: skip
    notes = [f"{effort.endurance:g} s round a block with adaptive-kraft over rosbridge; the first fifth settles."]
    return Report("endurance", rows, {}, notes)


def drive(folder: Path, seconds: float) -> tuple[Samples, list[float], bool, int]:
    """One drive: samples, lateness of its ticks (s), whether it collided, and the number of corners passed."""
    (folder / "circuit.yaml").write_text(SCENE, encoding="utf-8")
    samples, passed = Samples(), 0
    with Rig(folder, str(folder / "circuit.yaml"), more="goal: {topic: /goal}", give_up=30.0) as rig:
        rig.link.advertise("/goal", POSE)
        goals = itertools.cycle(CORNERS)
        goal = next(goals)
        rig.drive_until(0.5)
        rig.link.publish("/goal", stamped_pose(time.time_ns(), "map", (*goal, 0.0)))
        began, due = rig.world.world.time, 0.0
        while (elapsed := rig.world.world.time - began) < seconds and rig.result is None:
            if rig.process.poll() is not None:
                raise RuntimeError(f"the drive ended by itself: {rig.process.communicate()} {rig.events[-5:]}")
            if math.dist(rig.world.world.pose[:2], goal) < NEAR:
                goal, passed = next(goals), passed + 1
                rig.link.publish("/goal", stamped_pose(time.time_ns(), "map", (*goal, 0.0)))
            if elapsed >= due:
                due += max(1.0, seconds / 180.0)
                _sample(rig, samples, elapsed)
            time.sleep(0.05)
        collided = rig.world.world.collision is not None
        if rig.result is not None and not collided:
            raise RuntimeError(f"the drive ended by itself: {rig.result} {rig.events[-3:]}")
        late = [float(step[-2]) for step in rig.rows("steps")]
    return samples, late, collided, passed


def _sample(rig: Rig, samples: Samples, elapsed: float) -> None:
    samples.times.append(elapsed)
    pids = {"planner": rig.process.pid} | {name: rig.pid(name) for name in ("control", "guard", "display")}
    for name, pid in pids.items():
        samples.memory.setdefault(name, []).append(_memory(pid))
    samples.ahead.append(_last_time(rig.folder / "out" / "steps.csv") - rig.world.world.time)


def _last_time(table: Path) -> float:
    """First number of the last complete row of a table, without reading all of it."""
    with table.open("rb") as file:
        file.seek(max(0, table.stat().st_size - 2000))
        return float(file.read().rpartition(b"\n")[0].rpartition(b"\n")[2].split(b",")[0])


def _memory(pid: int) -> float:
    """Memory that belongs to a process alone, MB."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
        if line.startswith("Private_Dirty:"):
            return int(line.split()[1]) / 1000.0
    raise RuntimeError(f"the memory of process {pid} is unknown")
