"""An evaluation as it was asked for on a command line: what was left out, what to record, how to ask for it again."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kraft.errors import InputError
from kraft.evaluation import manifest
from kraft.evaluation.evaluator import Evaluation, Watch, evaluate
from kraft.evaluation.experiment import METHODS, SCENARIOS, TRIALS
from kraft.evaluation.folder import check_exists, default_path


@dataclass(frozen=True)
class Request:
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

    @property
    def unspecific(self) -> bool:
        """Whether nothing was said about what to run."""
        said = (self.trials, self.methods, self.vehicle, self.seed)
        return not self.scenarios and not self.realtime and all(value is None for value in said)


def complete(request: Request) -> Request:
    """Fill in where to write, and when going on, what to run if nothing was said about it.

    Raises:
        InputError: if there is no folder to go on with.
    """
    if request.resume:
        if request.out is None:
            raise InputError.of("--resume", "is given without --out", "expected the folder to go on with")
        check_exists(request.out)
        return _recorded(request, request.out / manifest.NAME) if request.unspecific else request
    return replace(request, out=request.out or default_path(request.seed or 0))


def carry_out(request: Request, watch: Watch) -> Evaluation:
    """Run what is asked for; see `evaluate` for what is raised."""
    arguments = arguments_of(request)
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
        watch=watch,
        arguments=arguments,
    )


def arguments_of(request: Request) -> dict[str, Any]:
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


def resume_command(request: Request) -> str:
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


def _recorded(request: Request, path: Path) -> Request:
    """The request with what its folder was made with."""
    if not path.exists():
        return request
    was = manifest.read_manifest(path).get("arguments")
    try:
        assert isinstance(was, dict)
        return replace(
            request,
            scenarios=tuple(map(str, was["scenarios"])),
            methods=",".join(map(str, was["methods"])),
            vehicle=None if was["vehicle"] is None else str(was["vehicle"]),
            trials=int(was["trials"]),
            seed=int(was["seed"]),
            realtime=bool(was["realtime"]),
        )
    except (AssertionError, KeyError, TypeError, ValueError):
        expected = "expected what kraft eval writes there; else say again what to run"
        raise InputError.of(f"{path}: arguments", "is damaged", expected) from None
