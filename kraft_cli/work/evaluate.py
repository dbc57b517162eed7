"""An evaluation as it was asked for on a command line: what was left out, what to record, how to ask for it again."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation import manifest
from kraft.evaluation.evaluator import Evaluation, Observer, evaluate
from kraft.evaluation.experiment import METHODS, SCENARIOS, TRIALS
from kraft.evaluation.folder import check_exists, default_path
from kraft_cli.work.run import run_command


@dataclass(frozen=True)
class EvalRequest:
    """Options of `kraft eval` as they were written; None and empty for what was left out."""

    scenarios: tuple[str, ...] = ()
    trials: int | None = None
    methods: str | None = None
    vehicle: str | None = None
    seed: int | None = None
    jobs: int | None = None
    cluster: str | None = None
    out: Path | None = None
    resume: bool = False
    realtime: bool = False


DEFAULTS: Final = EvalRequest()
OPTION_FROM_MANIFEST: Final[dict[str, Callable[[Any], Any]]] = {
    "scenarios": lambda value: tuple(map(str, value)),
    "methods": lambda value: ",".join(map(str, value)),
    "vehicle": lambda value: None if value is None else str(value),
    "trials": int,
    "seed": int,
    "realtime": bool,
}
"""How each of a manifest's arguments becomes the option again."""
OPTIONAL: Final = ("vehicle", "realtime")
"""Options whose absence says something too."""


def complete_request(request: EvalRequest) -> EvalRequest:
    """Fill in where to write, and when going on, whatever was not said about what to run, from the folder.

    Raises:
        InputError: if there is no folder to go on with, or its manifest does not say it.
    """
    if request.resume:
        if request.out is None:
            raise InputError.of("--resume", "is given without --out", "expected the folder to go on with", Code.MISSING)
        check_exists(request.out)
        return _with_recorded_arguments(request, request.out / manifest.NAME)
    return replace(request, out=request.out or default_path(request.seed or 0))


def run_evaluation(request: EvalRequest, observer: Observer) -> Evaluation:
    """Run what is asked for; see `evaluate` for what is raised."""
    arguments = arguments_of(request)
    try:
        return evaluate(
            arguments["scenarios"],
            arguments["methods"],
            arguments["trials"],
            arguments["seed"],
            request.jobs,
            request.out,
            vehicle=request.vehicle,
            resume=request.resume,
            realtime=request.realtime,
            cluster=request.cluster,
            observer=observer,
            arguments=arguments,
            command_line=run_command,
        )
    except InputError as error:
        raise InputError(_with_resume(diagnostic, request) for diagnostic in error.diagnostics) from error


def _with_resume(diagnostic: Diagnostic, request: EvalRequest) -> Diagnostic:
    """The same problem; where it is that the folder exists, with the options that go on with it."""
    if diagnostic.code is not Code.EXISTS or diagnostic.file != str(request.out):
        return diagnostic
    return replace(diagnostic, expected=f"expected a new folder, or --out {request.out} --resume to go on with it")


def arguments_of(request: EvalRequest) -> dict[str, Any]:
    """What the manifest records: everything that defines the evaluation, defaults filled in."""
    methods = METHODS if request.methods is None else [name.strip() for name in request.methods.split(",")]
    return {
        "scenarios": list(request.scenarios or SCENARIOS),
        "methods": list(methods),
        "vehicle": request.vehicle,
        "trials": TRIALS if request.trials is None else request.trials,
        "seed": request.seed or 0,
        "realtime": request.realtime,
    }


def resume_command(request: EvalRequest) -> str:
    """The command that goes on with the evaluation."""
    words = ["kraft", "eval", *request.scenarios]
    options = {
        "--trials": request.trials,
        "--methods": request.methods,
        "--vehicle": request.vehicle,
        "--seed": request.seed,
        "--jobs": request.jobs,
        "--cluster": request.cluster,
    }
    for name, value in options.items():
        words += [] if value is None else [name, str(value)]
    words += ["--realtime"] if request.realtime else []
    return shlex.join([*words, "--out", str(request.out), "--resume"])


def _with_recorded_arguments(request: EvalRequest, path: Path) -> EvalRequest:
    """The request with what its folder was made with, wherever nothing was said; what was said is compared later."""
    if not path.exists():
        return request
    arguments = manifest.read_manifest(path).get("arguments")
    was = arguments if isinstance(arguments, dict) else {}
    found: dict[str, Any] = {}
    missing = []
    for name, read in OPTION_FROM_MANIFEST.items():
        if getattr(request, name) != getattr(DEFAULTS, name):
            continue
        try:
            found[name] = read(was[name])
        except (KeyError, TypeError, ValueError):
            missing.append(name)
    unknown = [name for name in missing if name not in OPTIONAL]
    if unknown:
        expected = "expected what kraft eval writes there; else say it again"
        raise InputError.of(f"{path}: arguments", f"does not state {', '.join(unknown)}", expected, Code.MISSING)
    return replace(request, **found)
