"""`kraft record` without a terminal: from its options to a folder of logs."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, Diagnostic, InputError, Problems, out_of_range
from kraft.files import check_new_folder
from kraft.planning.compilation import ensure_compiled
from kraft.planning.workspace import vehicle_of_task
from kraft.recording.manoeuvres import Manoeuvre, read_commands
from kraft.scenario import Scenario, load_scenario
from kraft.text import MessageSink, counted
from kraft.trial.planning_vehicle import other_robot
from kraft.trial.warnings import far_camera
from kraft.vehicles import is_car
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.next_drives import COUNT_MAX, drives_for, load_prior
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.recording.recorder import Recorder, RunStart

    _Drive: TypeAlias = tuple[Manoeuvre, RunStart | None]

RUNS: Final = 10
"""Number of random runs by default."""
NEW: Final = "expected a new folder for the logs, or --resume to continue the recording in it"
PLANNED_RUNS: Final = 3
"""Number of recommended drives by default."""


@dataclass(frozen=True)
class RecordRequest:
    """Options of `kraft record` as written.

    `out` is a new folder, or with `resume` that of an interrupted recording.  `model` is that whose parameters the
    drives show, `bag` the file of a bag, or of several by number.
    """

    scenario: str = "training"
    out: Path = Path("logs")
    runs: int | None = None
    seed: int = 0
    vehicle: str | None = None
    model: str | None = None
    commands: tuple[Path, ...] = ()
    bag: Path | None = None
    resume: bool = False

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
    kept: bool = False
    """whether the folder had it already"""


@dataclass(frozen=True)
class RecordedRuns:
    """All runs, and the `model` that `kraft sysid` has to be told; None if it chooses one for such commands itself."""

    runs: tuple[RecordedRun, ...]
    model: str | None


@dataclass(frozen=True)
class _Inputs:
    """What a request names, loaded and checked; a manoeuvre for each file of commands."""

    scenario: Scenario
    vehicle: Vehicle
    prior: VehicleConfig | Vehicle | None
    files: Sequence[Path]
    manoeuvres: Sequence[Manoeuvre]


def request_of(
    scenario: str | None,
    out: Path,
    runs: int | None,
    seed: int | None,
    vehicle: str | None,
    model: str | None,
    commands: tuple[Path, ...],
    bag: Path | None,
    *,
    resume: bool,
) -> RecordRequest:
    """Request of options, of which those are None or empty that were left out: with `resume` as the folder has them.

    Raises:
        InputError: if the folder to resume does not exist or is damaged.
    """
    recorded = _recorded_arguments(out) if resume else {}
    return RecordRequest(
        recorded.get("scenario", RecordRequest.scenario) if scenario is None else scenario,
        out,
        recorded.get("runs") if runs is None and "commands" not in recorded else runs,
        recorded.get("seed", 0) if seed is None else seed,
        vehicle or recorded.get("vehicle"),
        model or recorded.get("for"),
        commands or tuple(map(Path, recorded.get("commands", ()))),
        bag,
        resume,
    )


def resume_command(request: RecordRequest) -> str:
    """Command that resumes the recording: the folder has the options, except for the bag."""
    bag = [] if request.bag is None else ["--bag", str(request.bag)]
    return shlex.join(["kraft", "record", "--out", str(request.out), *bag, "--resume"])


def _recorded_arguments(folder: Path) -> dict[str, Any]:
    """Arguments of an interrupted recording; none if it was interrupted before its first run."""
    from kraft.recording.resumption import finished_runs  # loads the simulator

    recorded = [dict(run.manifest["arguments"]) for run in finished_runs(folder).values()]
    return max(recorded, key=lambda arguments: arguments.get("runs", 0), default={})  # it may have got more runs


def record_logs(
    request: RecordRequest, report: MessageSink, on_run: Callable[[RecordedRun], None] | None = None
) -> RecordedRuns:
    """Record all runs; each is written when it ends, so that an interrupt keeps the finished ones.

    With `resume` the runs that the folder has are kept; `on_run` receives them too.

    Raises:
        InputError: with the problems of the request and of the files it names, before the first run; if the scenario
            has no free space for a run; with every difference of the folder to resume.
    """
    from kraft.recording.recorder import Recorder  # this loads the simulator

    inputs = _inputs(request)
    scenario, vehicle, files, prior = inputs.scenario, inputs.vehicle, inputs.files, inputs.prior
    drives: list[_Drive] = [(manoeuvre, None) for manoeuvre in inputs.manoeuvres]
    for text in (far_camera(scenario, anywhere=True), other_robot(scenario, vehicle)):
        if text:
            report(f"warning: {text}")
    ensure_compiled(vehicle, report, steps=not is_car(vehicle))
    if not files and (unused := unused_controls(model_of(vehicle))):
        report(f"warning: {unused}")
    recorder = Recorder(scenario, vehicle, request.seed)
    if prior is not None:
        drives = drives_for(prior, scenario, recorder, request.count, request.seed, report)
    runs = len(drives) or request.count
    arguments = _arguments(request, runs, files)
    kept = _kept_runs(request.out, recorder.described(arguments), drives, runs) if request.resume else {}
    done = []
    for number in range(1, runs + 1):
        drive = drives[number - 1] if drives else ()
        done.append(kept.get(number) or _record(request, inputs, recorder, arguments, drive, number, runs))
        if number in kept:
            _write_missing_bag(request, inputs, recorder, drive, number, runs)
        if on_run is not None:
            on_run(done[-1])
    if prior is not None and (lost := _cut_short(request, [(run, drives[k][0].end) for k, run in enumerate(done)])):
        report(lost)
    return RecordedRuns(tuple(done), _model_to_state(request, scenario, vehicle))


def _cut_short(request: RecordRequest, runs: Sequence[tuple[RecordedRun, float]]) -> str:
    """What to say of planned drives that ended before their planned end (s), and what to do; else empty."""
    ended = [f"after {run.duration:.1f} of {end:.1f} s" for run, end in runs if run.note]
    if not ended:
        return ""
    return (
        f"{len(ended)} of {counted(len(runs), 'planned drive')} ended early ({', '.join(ended)}): their paths were "
        f"planned with what {request.model} states, and the vehicle left them; a scenario with larger bounds "
        "leaves more room, and kraft record without --for drives manoeuvres that need no priors"
    )


def unused_controls(model: VehicleModel) -> str:
    """What to say of controls that neither drive the vehicle forward nor turn it, which no manoeuvre uses; else empty.

    Logs then do not show the parameters that they act on.
    """
    used = np.any([model.drive_control(*each) != model.rest for each in ((1, 0), (-1, 0), (1, 1), (1, -1))], axis=0)
    names = [name for name, is_used in zip(model.vehicle.controls, used, strict=True) if not is_used]
    if not names:
        return ""
    return (
        f"no manoeuvre uses {', '.join(names)}, which neither drives {model.vehicle.name} forward nor turns it: record "
        "drives of your own with --commands, or freeze the parameters that only it shows (kraft sysid --freeze)"
    )


def _model_to_state(request: RecordRequest, scenario: Scenario, vehicle: Vehicle) -> str | None:
    """Model that `kraft sysid` has to be told: it chooses one for the commands of a car and of two sides alone."""
    from kraft.sysid.command_units import SIDES  # loads the identification

    has_choice = is_car(vehicle) or set(vehicle.controls) == set(SIDES)
    return None if has_choice else request.vehicle or scenario.vehicle


def _record(
    request: RecordRequest,
    inputs: _Inputs,
    recorder: Recorder,
    arguments: Mapping[str, Any],
    drive: _Drive | tuple[()],
    number: int,
    runs: int,
) -> RecordedRun:
    """Drive a run and write it."""
    from kraft.recording.recorder import write_recording
    from kraft.robot.bag import bag_of_run, write_recording_bag

    recording = recorder.record(number, *drive)
    folder = write_recording(request.out, inputs.scenario, arguments, recording)
    if request.bag is not None:
        write_recording_bag(bag_of_run(request.bag, number, runs), inputs.scenario.task(), inputs.vehicle, recording)
    logged = len(recording.commands), len(recording.poses)
    return RecordedRun(folder, recording.manoeuvre.name, recording.end, *logged, recording.note, runs)


def _kept_runs(out: Path, described: Mapping[str, Any], drives: Sequence[_Drive], runs: int) -> dict[int, RecordedRun]:
    """Runs that the folder has, by number; what a kill left of another one is removed.

    Raises:
        InputError: with every problem and difference of the folder.
    """
    from kraft.recording.resumption import check_same_commands, check_same_recording, finished_runs, remove_unfinished

    finished = finished_runs(out)
    check_same_recording(finished.values(), described, runs)
    problems = Problems()
    for run in finished.values():
        if drives:
            problems.of(partial(check_same_commands, run, drives[run.number - 1][0]))
    problems.check()
    remove_unfinished(out)
    kept = {}
    for number, run in finished.items():
        manoeuvre, end, commands, poses, note = (
            run.manifest[key] for key in ("manoeuvre", "end", "commands", "poses", "note")
        )
        kept[number] = RecordedRun(run.folder, manoeuvre, end, commands, poses, note, runs, kept=True)
    return kept


def _write_missing_bag(
    request: RecordRequest,
    inputs: _Inputs,
    recorder: Recorder,
    drive: _Drive | tuple[()],
    number: int,
    runs: int,
) -> None:
    """Drive a run again if its bag is asked for and missing, as after a kill between the two, and write that."""
    from kraft.robot.bag import bag_of_run, write_recording_bag

    if request.bag is not None and not (path := bag_of_run(request.bag, number, runs)).exists():
        write_recording_bag(path, inputs.scenario.task(), inputs.vehicle, recorder.record(number, *drive))


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
    if not request.resume:
        problems.of(lambda: check_new_folder(out, NEW))
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
