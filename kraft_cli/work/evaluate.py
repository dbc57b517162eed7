"""`kraft eval` without a terminal: from its options to an evaluation, and the command that resumes it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from kraft.config.overrides import parse_overrides, parse_sweeps
from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.evaluation.evaluator import Evaluation, Observer, check_arguments, evaluate
from kraft.evaluation.experiment import METHODS, SUITE, TRIALS
from kraft.evaluation.folder import check_empty, check_exists, default_path
from kraft.evaluation.manifest import MANIFEST, read_manifest
from kraft_cli.work.run import run_command


@dataclass(frozen=True)
class EvalRequest:
    """Options of `kraft eval` as written; None or empty where an option was left out."""

    scenarios: tuple[str, ...] = ()
    suite: str | None = None
    settings: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
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
    "suite": lambda value: None if value is None else str(value),
    "settings": lambda value: tuple(map(str, value)),
    "vary": lambda value: tuple(map(str, value)),
    "methods": lambda value: ",".join(map(str, value)),
    "vehicle": lambda value: None if value is None else str(value),
    "trials": int,
    "seed": int,
    "realtime": bool,
}
"""Conversion of each argument in a manifest to the option."""
OPTIONAL: Final = ("suite", "settings", "vary", "vehicle", "realtime")
"""Options that a manifest need not have."""


def complete_request(request: EvalRequest) -> EvalRequest:
    """Add the results folder, and when resuming, the options that were left out from the folder's manifest.

    Raises:
        InputError: if the folder to resume does not exist, or does not say what to resume.
    """
    if request.resume:
        if request.out is None:
            raise InputError.of(
                "--resume", "is given without --out", "expected the folder of the evaluation to resume", Code.MISSING
            )
        check_exists(request.out)
        return _with_recorded_arguments(request, request.out / MANIFEST)
    return replace(request, out=request.out or default_path(request.seed or 0))


def run_evaluation(request: EvalRequest, observer: Observer) -> Evaluation:
    """Run the evaluation of a request; see `evaluate` for its exceptions."""
    arguments = arguments_of(request)
    problems = Problems()
    settings = problems.of(lambda: parse_overrides(request.settings, "set"))
    vary = problems.of(lambda: parse_sweeps(request.vary, "vary"))
    if settings is None or vary is None:  # the other arguments are checked too
        trials, seed, suite = arguments["trials"], arguments["seed"], arguments["suite"]
        problems.of(
            lambda: check_arguments(
                arguments["scenarios"] or None, arguments["methods"], trials, seed, request.jobs, request.out,
                suite=suite, vehicle=request.vehicle, resume=request.resume,
            )
        )  # fmt: skip
        raise InputError(problems.found)
    try:
        return evaluate(
            arguments["scenarios"] or None,
            arguments["methods"],
            arguments["trials"],
            arguments["seed"],
            request.jobs,
            request.out,
            suite=arguments["suite"],
            settings=settings,
            vary=vary,
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
    """Diagnostic with the options that resume the folder, if the problem is that the folder exists.

    If files are not found while it is resumed, the diagnostic says what their paths are relative to.
    """
    if request.resume and diagnostic.code is Code.NOT_FOUND:
        began = "; if the evaluation began in another folder, resume it there: its paths are relative to that"
        return replace(diagnostic, expected=f"{diagnostic.expected}{began}")
    if diagnostic.code is not Code.EXISTS or diagnostic.file != str(request.out):
        return diagnostic
    return replace(diagnostic, expected=f"expected a new folder, or --out {request.out} --resume to continue this one")


def arguments_of(request: EvalRequest) -> dict[str, Any]:
    """Arguments that the manifest records: everything that defines the evaluation, with defaults."""
    methods = METHODS if request.methods is None else [name.strip() for name in request.methods.split(",")]
    return {
        "scenarios": list(request.scenarios),
        "suite": SUITE if request.suite is None and not request.scenarios else request.suite,
        "settings": list(request.settings),
        "vary": list(request.vary),
        "methods": list(methods),
        "vehicle": request.vehicle,
        "trials": TRIALS if request.trials is None else request.trials,
        "seed": request.seed or 0,
        "realtime": request.realtime,
    }


def resume_command(request: EvalRequest) -> str:
    """Command that resumes the evaluation."""
    return shlex.join([*_words(request), "--out", str(request.out), "--resume"])


def eval_command(request: EvalRequest) -> str:
    """Command of the evaluation, without its results folder."""
    return shlex.join(_words(request))


def _words(request: EvalRequest) -> list[str]:
    """Words of the command that defines the evaluation."""
    words = ["kraft", "eval", *request.scenarios]
    options = {
        "--suite": request.suite,
        "--trials": request.trials,
        "--methods": request.methods,
        "--vehicle": request.vehicle,
        "--seed": request.seed,
        "--jobs": request.jobs,
        "--cluster": request.cluster,
    }
    for name, value in options.items():
        words += [] if value is None else [name, str(value)]
    words += [word for text in request.settings for word in ("--set", text)]
    words += [word for text in request.vary for word in ("--vary", text)]
    words += ["--realtime"] if request.realtime else []
    return words


def _with_recorded_arguments(request: EvalRequest, path: Path) -> EvalRequest:
    """Request with options that were left out taken from the manifest; the others are compared later.

    Raises:
        InputError: if the manifest lacks an option, or if there is none and the request has no scenarios: those of the
            default suite may not be those with which the evaluation began.
    """
    if not path.exists():
        if not request.scenarios and request.suite is None:
            check_empty(path.parent)
            problem = f"has no {MANIFEST}, so that it does not say which evaluation to resume"
            expected = "expected the options of the evaluation again, with scenarios or --suite (default: paper)"
            raise InputError.of(str(path.parent), problem, expected, Code.MISSING)
        return request
    arguments = read_manifest(path).get("arguments")
    recorded = arguments if isinstance(arguments, dict) else {}
    found: dict[str, Any] = {}
    missing = []
    for name, read in OPTION_FROM_MANIFEST.items():
        if getattr(request, name) != getattr(DEFAULTS, name):
            continue
        try:
            found[name] = read(recorded[name])
        except (KeyError, TypeError, ValueError):
            missing.append(name)
    unknown = [name for name in missing if name not in OPTIONAL]
    if unknown:
        expected = "expected the arguments that kraft eval writes; otherwise give these options again"
        raise InputError.of(f"{path}: arguments", f"lacks {', '.join(unknown)}", expected, Code.MISSING)
    return replace(request, **found)
