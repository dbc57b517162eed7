"""Arguments and options of `kraft sysid`: what they mean, and every check that reads no logs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.files import check_all
from kraft.logs.discover import check_paths
from kraft.logs.mapping import load_mapping
from kraft.sysid.base_vehicle import BaseVehicle, load_base_vehicle
from kraft.sysid.data import check_holdout
from kraft.sysid.interface import GRAPHS, AuxiliarySelection, Noise, Settings
from kraft.sysid.model_choice import models_of_cars
from kraft.sysid.selection import check_free_parameters, check_settings
from kraft.sysid.terms import has_terms
from kraft.sysid.vehicle_file import check_vehicle_target
from kraft.text import suggestion
from kraft_cli.work.next_drives import NextRequest, check_next
from kraft_cli.work.parameters import parse_parameters
from kraft_cli.work.sysid_logs import has_two_sides

AUTO: Final = "auto"
"""Model whose terms are chosen by what they predict."""
TWO_SIDES: Final = "differential"
"""Model with terms of a robot with two driven sides."""
HORIZON_MIN, HORIZON_MAX = 0.5, 10.0
OPTIONS: Final = {"auxiliary": "extras", "frozen": "freeze", "values": "param"}
"""Options of the command for fields of `Settings` that have another name."""


@dataclass(frozen=True)
class SysidRequest:
    """Arguments and options of the command, as written.

    Attributes:
        logs: files and folders with logs.
        model: `auto`, a bundled vehicle, a vehicle file or code.
        holdout: fraction of the logs to hold out; None for the default.
        out: vehicle file to write.
        plot: page to draw.
        mapping: mapping file.
        freeze: names of parameters, separated by commas.
        extras: which auxiliary parameters: `auto`, `plan`, `none`, or names separated by commas.
        graph: form of the factor graph, one of `GRAPHS`.
        pose_noise: standard deviations of position (m) and yaw (rad), as in ``0.01,0.02``.
        param: initial values, each as ``name=value``.
        horizon: time over which a model with terms to choose is to predict well, s.
        next: number of drives to recommend; None for none.
        area: free area for them, as in ``6,4``; None for that of the logs.
        commands: new folder for their commands.
    """

    logs: tuple[Path, ...]
    model: str = AUTO
    holdout: float | None = None
    out: Path | None = None
    plot: Path | None = None
    mapping: Path | None = None
    freeze: tuple[str, ...] = ()
    extras: str = "auto"
    graph: str = "fast"
    pose_noise: str | None = None
    param: tuple[str, ...] = ()
    horizon: float = 3.0
    next: int | None = None
    area: str | None = None
    commands: Path | None = None


def checked(request: SysidRequest) -> tuple[BaseVehicle, Settings]:
    """The vehicle and the settings, after every check that reads no logs.

    Raises:
        InputError: with the problems of all checks.
    """
    problems = Problems()
    reference = _reference(request)
    base = problems.of(lambda: load_base_vehicle(reference))
    settings = _parse_settings(request, base, problems.found)
    out, plot, mapping = request.out, request.plot, request.mapping
    checks: list[Callable[[], object]] = [
        lambda: None if base is None else _check_settings(base, settings),
        lambda: check_paths(request.logs),
        lambda: None if mapping is None else load_mapping(mapping),
        lambda: check_holdout(request.holdout),
        lambda: None if out is None else check_vehicle_target(out),
    ]
    if plot is not None:
        from kraft.plot import check_picture

        checks.append(partial(check_picture, plot))
    checks.append(lambda: _check_next(request))
    problems.of(lambda: check_all(*checks))
    problems.check()
    assert base is not None, "every problem was raised"
    return base, settings


def _reference(request: SysidRequest) -> str:
    """The initial vehicle; without a model the one with terms for the commands that the logs have."""
    if request.model != AUTO:
        return request.model
    try:
        return TWO_SIDES if has_two_sides(request.logs, request.mapping) else models_of_cars()[0]
    except InputError:  # of the mapping file, which is checked beside the other options
        return models_of_cars()[0]


def _check_next(request: SysidRequest) -> None:
    """Check the options of recommended drives."""
    if request.next is not None:
        check_next(NextRequest(request.next, request.area, request.commands))
        return
    problems = [
        Diagnostic(
            name, "is given, but no drives are requested", "expected --next too", code=Code.CONFLICT, argument=True
        )
        for name, given in (("area", request.area), ("commands", request.commands))
        if given is not None
    ]
    if problems:
        raise InputError(problems)


def _check_settings(base: BaseVehicle, settings: Settings) -> None:
    """Check that the settings fit the vehicle.

    Raises:
        InputError: with every option that does not.
    """
    try:
        check_settings(base.definition, settings)
        check_free_parameters(base.definition, settings)
    except InputError as error:
        raise InputError(_at_option(d) for d in error.diagnostics) from None


def _at_option(diagnostic: Diagnostic) -> Diagnostic:
    """Same problem, reported at the option of the command instead of at the field of `Settings`."""
    option = OPTIONS.get(diagnostic.file, diagnostic.file)
    if option == "param" and diagnostic.path:
        return replace(diagnostic, file=f"--param {diagnostic.path}", path="", argument=False)
    return replace(diagnostic, file=option)


def _parse_settings(request: SysidRequest, base: BaseVehicle | None, problems: list[Diagnostic]) -> Settings:
    """The settings as far as they can be read; other options are added to `problems`.  A vehicle file is for planning.

    Without `base` the vehicle is not known.
    """
    values = parse_parameters(request.param, problems)
    noise = None if request.pose_noise is None else _parse_noise(request.pose_noise, problems)
    graph = next((known for known in GRAPHS if known == request.graph), None)
    if graph is None:
        problems.append(
            Diagnostic(
                "graph", f"is {request.graph!r}", suggestion(request.graph, GRAPHS), code=Code.UNKNOWN, argument=True
            )
        )
    if not HORIZON_MIN <= request.horizon <= HORIZON_MAX:
        expected = f"expected a time from {HORIZON_MIN:g} to {HORIZON_MAX:g} s"
        problems.append(Diagnostic("horizon", f"is {request.horizon:g}", expected, argument=True))
    auxiliary = _parse_extras(request.extras)
    terms = base is not None and has_terms(base.definition)
    if request.out is not None and auxiliary == "auto" and (request.model == AUTO or not terms):
        auxiliary = "plan"
    return Settings(
        horizon=request.horizon,
        noise=noise,
        frozen=_names(request.freeze),
        values=values,
        auxiliary=auxiliary,
        graph=graph or "fast",
    )


def _parse_extras(text: str) -> AuxiliarySelection:
    match _names((text,)):
        case ("auto",):
            return "auto"
        case ("plan",):
            return "plan"
        case ("none",):
            return "none"
        case names:
            return names


def _names(texts: Sequence[str]) -> tuple[str, ...]:
    parts = (part.strip() for text in texts for part in text.split(","))
    return tuple(dict.fromkeys(part for part in parts if part))


def _parse_noise(text: str, problems: list[Diagnostic]) -> Noise | None:
    try:
        position, yaw = map(float, text.split(","))
    except ValueError:
        position = yaw = math.nan
    if 0.0 < position < math.inf and 0.0 < yaw < math.inf:
        return Noise(position, yaw)
    expected = "expected standard deviations of position (m) and yaw (rad), as in 0.01,0.02"
    problems.append(Diagnostic("pose_noise", f"is {text!r}", expected, code=Code.SYNTAX, argument=True))
    return None
