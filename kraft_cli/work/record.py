"""`kraft record` without a terminal: from its options to a folder of logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kraft.errors import Code, Diagnostic, InputError
from kraft.planning.compilation import ensure_compiled
from kraft.planning.workspace import vehicle_of_task
from kraft.recording.manoeuvres import Manoeuvre, read_commands
from kraft.scenario import load_scenario
from kraft.vehicles import is_car
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.next_drives import COUNT_MAX, drives_for, load_prior

if TYPE_CHECKING:
    from kraft.recording.recorder import Place

RUNS: Final = 10
"""Number of random runs by default."""
PLANNED_RUNS: Final = 3
"""Number of recommended drives by default."""


@dataclass(frozen=True)
class RecordRequest:
    """Options of `kraft record` as written.

    `out` is a new folder, `model` that whose parameters the drives show, `bag` the file of a bag, or of several by
    number.
    """

    scenario: str = "training"
    out: Path = Path("logs")
    runs: int | None = None
    seed: int = 0
    vehicle: str | None = None
    model: str | None = None
    commands: tuple[Path, ...] = ()
    bag: Path | None = None

    @property
    def count(self) -> int:
        """Number of runs, unless files of commands state what is driven."""
        default = RUNS if self.model is None else PLANNED_RUNS
        return default if self.runs is None else self.runs


@dataclass(frozen=True)
class RecordedRun:
    """Recorded run: folder, manoeuvre, duration (s), numbers of logged commands and poses, and why it ended early."""

    folder: Path
    manoeuvre: str
    duration: float
    commands: int
    poses: int
    note: str
    of: int
    """number of runs"""


def record_logs(
    request: RecordRequest, report: Callable[[str], None], on_run: Callable[[RecordedRun], None] | None = None
) -> tuple[RecordedRun, ...]:
    """Record all runs; each is written when it ends, so that an interrupt keeps the finished ones.

    Raises:
        InputError: with the problems of the request and of the files it names, before the first run; if the scenario
            has no free space for a run.
    """
    _check(request)
    scenario = load_scenario(request.scenario)
    vehicle = vehicle_of_task(scenario) if request.vehicle is None else load_vehicle(request.vehicle)
    from kraft.recording.recorder import Recorder, check_log_folder, write_recording  # these load the simulator
    from kraft.robot.bag import bag_of_run, check_bag
    from kraft.robot.bag import write_recording as write_bag

    check_log_folder(request.out)
    if request.bag is not None:
        check_bag(request.bag)
    prior = None if request.model is None else load_prior(request.model, vehicle)
    files = _command_files(request.commands)
    drives: list[tuple[Manoeuvre, Place | None]] = [(read_commands(path, vehicle.controls), None) for path in files]
    ensure_compiled(vehicle, report, steps=not is_car(vehicle))
    recorder = Recorder(scenario, vehicle, request.seed)
    if prior is not None:
        drives = drives_for(prior, scenario, recorder, request.count, request.seed, report)
    runs = len(drives) or request.count
    arguments = _arguments(request, runs, files)
    done = []
    for number in range(1, runs + 1):
        recording = recorder.record(number, *(drives[number - 1] if drives else ()))
        folder = write_recording(request.out, scenario, arguments, recording)
        if request.bag is not None:
            write_bag(bag_of_run(request.bag, number, runs), scenario.task(), vehicle, recording)
        logged = len(recording.commands), len(recording.poses)
        done.append(RecordedRun(folder, recording.manoeuvre.name, recording.end, *logged, recording.note, runs))
        if on_run is not None:
            on_run(done[-1])
    return tuple(done)


def _check(request: RecordRequest) -> None:
    """Raise an `InputError` with every problem of the options that needs no file."""
    problems = []
    if request.count < 1:
        problems.append(Diagnostic("runs", f"is {request.runs}", "expected a number of at least 1", argument=True))
    if request.model is not None and request.count > COUNT_MAX:
        expected = f"expected a number of at most {COUNT_MAX} with --for"
        problems.append(Diagnostic("runs", f"is {request.runs}", expected, argument=True))
    for name, given in (("for", request.model), ("runs", request.runs)):
        if request.commands and given is not None:
            expected = "expected one of the two: files of commands state what is driven"
            problems.append(Diagnostic(name, "is given with --commands", expected, code=Code.CONFLICT, argument=True))
    if request.seed < 0:
        problems.append(Diagnostic("seed", f"is {request.seed}", "expected a number of at least 0", argument=True))
    if problems:
        raise InputError(problems)


def _arguments(request: RecordRequest, runs: int, files: Sequence[Path]) -> dict[str, Any]:
    """Arguments for the manifest of a log; those that were not given are left out."""
    given: dict[str, Any] = {"scenario": request.scenario, "runs": runs, "seed": request.seed}
    if request.vehicle is not None:
        given["vehicle"] = request.vehicle
    if request.model is not None:
        given["for"] = request.model
    if files:
        given["commands"] = [str(path) for path in files]
    return given


def _command_files(paths: Sequence[Path]) -> list[Path]:
    """Files of commands: those given, and all `commands.csv` in the folders given.

    Raises:
        InputError: with every folder that has none.
    """
    files: list[Path] = []
    problems = []
    for path in paths:
        found = sorted(path.rglob("commands.csv")) if path.is_dir() else [path]
        if not found:
            expected = "expected the folder of kraft sysid --commands"
            problems.append(Diagnostic(str(path), "has no commands.csv in it", expected, code=Code.NOT_FOUND))
        files += found
    if problems:
        raise InputError(problems)
    return files
