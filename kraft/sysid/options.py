"""What a command line may say about an identification, and what it means."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from kraft.errors import Diagnostic, InputError
from kraft.parameter_items import parse_parameters
from kraft.sysid.settings import Extras, Noise, Settings
from kraft.text import suggestion

GRAPHS: Final[tuple[Literal["fast", "paper"], ...]] = ("fast", "paper")


@dataclass(frozen=True)
class Options:
    """Options as they were written; names may stand in one text with commas, `values` are ``name=value``."""

    freeze: tuple[str, ...] = ()
    extras: str = "auto"
    graph: str = "fast"
    pose_noise: str | None = None
    values: tuple[str, ...] = ()


def settings_of(options: Options) -> Settings:
    """Make settings of what was written; whether the names exist depends on the vehicle and is checked there.

    Raises:
        InputError: with every option that cannot be read.
    """
    problems: list[Diagnostic] = []
    noise, values = None, {}
    try:
        values = parse_parameters(options.values)
    except InputError as error:
        problems += error.diagnostics
    if options.pose_noise is not None:
        noise = _noise(options.pose_noise, problems)
    graph = next((known for known in GRAPHS if known == options.graph), None)
    if graph is None:
        problems.append(Diagnostic("--graph", f"is {options.graph!r}", suggestion(options.graph, GRAPHS)))
    if problems or graph is None:
        raise InputError(problems)
    frozen, extras = _names(options.freeze), _extras(options.extras)
    return Settings(noise=noise, frozen=frozen, values=values, extras=extras, graph=graph)


def _extras(text: str) -> Extras:
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


def _noise(text: str, problems: list[Diagnostic]) -> Noise | None:
    try:
        position, yaw = map(float, text.split(","))
    except ValueError:
        position = yaw = math.nan
    if 0.0 < position < math.inf and 0.0 < yaw < math.inf:
        return Noise(position, yaw)
    expected = "expected standard deviations of position (m) and yaw (rad), as in 0.01,0.02"
    problems.append(Diagnostic("--pose-noise", f"is {text!r}", expected))
    return None
