"""`kraft record` without a terminal: from its options to a folder of logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kraft.errors import Code, Diagnostic, InputError, Problems, out_of_range
from kraft.files import check_new_folder
from kraft.planning.compilation import ensure_compiled
from kraft.planning.workspace import vehicle_of_task
from kraft.recording.manoeuvres import Manoeuvre, read_commands
from kraft.scenario import Scenario, load_scenario
from kraft.trial.far_camera import far_camera
from kraft.trial.planning_vehicle import other_robot
from kraft.vehicles import is_car
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.next_drives import COUNT_MAX, drives_for, load_prior
from ompl_ext.vehicle import Vehicle

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


@dataclass(frozen=True)
class _Inputs:
    """What a request names, loaded and checked; a manoeuvre for each file of commands."""

    scenario: Scenario
    vehicle: Vehicle
    prior: VehicleConfig | None
    files: Sequence[Path]
    manoeuvres: Sequence[Manoeuvre]


def record_logs(
    request: RecordRequest, report: Callable[[str], None], on_run: Callable[[RecordedRun], None] | None = None
) -> tuple[RecordedRun, ...]:
    """Record all runs; each is written when it ends, so that an interrupt keeps the finished ones.

    Raises:
        InputError: with the problems of the request and of the files it names, before the first run; if the scenario
            has no free space for a run.
    """
    from kraft.recording.recorder import Recorder, write_recording  # these load the simulator
    from kraft.robot.bag import bag_of_run
    from kraft.robot.bag import write_recording as write_bag

    inputs = _inputs(request)
    scenario, vehicle, files, prior = inputs.scenario, inputs.vehicle, inputs.files, inputs.prior
    drives: list[tuple[Manoeuvre, Place | None]] = [(manoeuvre, None) for manoeuvre in inputs.manoeuvres]
    for text in (far_camera(scenario, anywhere=True), other_robot(scenario, vehicle)):
        if text:
            report(f"warning: {text}")
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


def _inputs(request: RecordRequest) -> _Inputs:
    """Load what the request names.

    Raises:
        InputError: with the problems of all options and files.
    """
    from kraft.robot.bag import check_bag

    problems = Problems()
    problems.found += _option_problems(request)
    out, bag, named, model = request.out, request.bag, request.vehicle, request.model
    scenario = problems.of(lambda: load_scenario(request.scenario))
    vehicle = None
    if named is not None:
        vehicle = problems.of(lambda: load_vehicle(named))
    elif scenario is not None:
        vehicle = problems.of(lambda: vehicle_of_task(scenario))
    problems.of(lambda: check_new_folder(out, "expected a new folder for the logs"))
    if bag is not None:
        problems.of(lambda: check_bag(bag))
    prior = None if model is None else problems.of(lambda: load_prior(model, vehicle))
    files = problems.of(lambda: _command_files(request.commands)) or []
    read = [problems.of(partial(read_commands, path, vehicle.controls)) for path in files if vehicle is not None]
    problems.check()
    assert scenario is not None, "every problem was raised"
    assert vehicle is not None, "every problem was raised"
    return _Inputs(scenario, vehicle, prior, files, [manoeuvre for manoeuvre in read if manoeuvre is not None])


def _option_problems(request: RecordRequest) -> list[Diagnostic]:
    """Problems of the options that name no file."""
    problems = [*out_of_range("runs", request.count, 1), *out_of_range("seed", request.seed, 0)]
    if request.model is not None and request.count > COUNT_MAX:
        expected = f"expected a number of at most {COUNT_MAX} with --for"
        problems.append(Diagnostic("runs", f"is {request.runs}", expected, argument=True))
    for name, given in (("for", request.model), ("runs", request.runs)):
        if request.commands and given is not None:
            expected = "expected one of the two: files of commands state what is driven"
            problems.append(Diagnostic(name, "is given with --commands", expected, code=Code.CONFLICT, argument=True))
    return problems


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
        InputError: with every path that does not exist, and every folder that has none.
    """
    files: list[Path] = []
    problems = []
    for path in paths:
        found = sorted(path.rglob("commands.csv")) if path.is_dir() else [path]
        if not path.exists():
            expected = "expected a file of commands, or the folder of kraft sysid --commands"
            problems.append(Diagnostic(str(path), "does not exist", expected, code=Code.NOT_FOUND))
        elif not found:
            expected = "expected the folder of kraft sysid --commands"
            problems.append(Diagnostic(str(path), "has no commands.csv in it", expected, code=Code.NOT_FOUND))
        files += found
    if problems:
        raise InputError(problems)
    return files
