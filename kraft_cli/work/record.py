"""`kraft record` without a terminal: from its options to a folder of logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from kraft.errors import Diagnostic, InputError
from kraft.planning.compilation import ensure_compiled
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario
from kraft.vehicles import is_car
from kraft.vehicles.load import load_vehicle

RUNS: Final = 10


@dataclass(frozen=True)
class RecordRequest:
    """Options of `kraft record` as written; `out` is a new folder, `bag` the file of a bag, or of several by number."""

    scenario: str = "training"
    out: Path = Path("logs")
    runs: int = RUNS
    seed: int = 0
    vehicle: str | None = None
    bag: Path | None = None


@dataclass(frozen=True)
class RecordedRun:
    """Recorded run: folder, manoeuvre, duration (s), numbers of logged commands and poses, and why it ended early."""

    folder: Path
    manoeuvre: str
    duration: float
    commands: int
    poses: int
    note: str


def record_logs(
    request: RecordRequest, report: Callable[[str], None], on_run: Callable[[RecordedRun], None] | None = None
) -> tuple[RecordedRun, ...]:
    """Record all runs; each is written when it ends, so that an interrupt keeps the finished ones.

    Raises:
        InputError: with the problems of the request and of the files it names, before the first run; if the scenario
            has no free space for a run.
    """
    problems = []
    if request.runs < 1:
        problems.append(Diagnostic("runs", f"is {request.runs}", "expected a number of at least 1", argument=True))
    if request.seed < 0:
        problems.append(Diagnostic("seed", f"is {request.seed}", "expected a number of at least 0", argument=True))
    if problems:
        raise InputError(problems)
    scenario = load_scenario(request.scenario)
    vehicle = vehicle_of_task(scenario) if request.vehicle is None else load_vehicle(request.vehicle)
    from kraft.recording.recorder import Recorder, check_log_folder, write_recording  # these load the simulator
    from kraft.robot.bag import bag_of_run, check_bag
    from kraft.robot.bag import write_recording as write_bag

    check_log_folder(request.out)
    if request.bag is not None:
        check_bag(request.bag)
    ensure_compiled(vehicle, report, steps=not is_car(vehicle))
    recorder = Recorder(scenario, vehicle, request.seed)
    arguments = {"scenario": request.scenario, "runs": request.runs, "seed": request.seed}
    if request.vehicle is not None:
        arguments["vehicle"] = request.vehicle
    done = []
    for number in range(1, request.runs + 1):
        recording = recorder.record(number)
        folder = write_recording(request.out, scenario, arguments, recording)
        if request.bag is not None:
            write_bag(bag_of_run(request.bag, number, request.runs), scenario.task(), vehicle, recording)
        logged = len(recording.commands), len(recording.poses)
        done.append(RecordedRun(folder, recording.manoeuvre.name, recording.end, *logged, recording.note))
        if on_run is not None:
            on_run(done[-1])
    return tuple(done)
