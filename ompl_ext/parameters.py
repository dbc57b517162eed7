"""Planner parameters by OMPL's conventions: snake_case names, string values, suggested ranges.

OMPL's own ParamSet cannot be used from Python; this has the same methods.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass

from ompl_ext.kernels.tree_memory import MAX_NODES

Value = bool | int | float
_EXPECTED: dict[type, str] = {bool: "true or false", int: "an integer", float: "a number"}


@dataclass(frozen=True)
class Parameter:
    """Parameter with its bounds and the range, first:step:last, that OMPL's tools suggest."""

    name: str
    default: Value
    low: float
    high: float
    suggestion: str
    doc: str

    def parse(self, text: str) -> Value:
        """Value of `text`, which may also be a value.

        Raises:
            ValueError: the value is of another type or outside the bounds.
        """
        kind = type(self.default)
        words = {"true": 1.0, "false": 0.0} if kind is bool else {}
        try:
            number = words[str(text).lower()] if str(text).lower() in words else float(text)
        except (TypeError, ValueError):
            raise ValueError(f"{self.name} is {text!r}; expected {_EXPECTED[kind]} ({self.doc})") from None
        if not self.low <= number <= self.high or (kind is not float and number != int(number)):
            raise ValueError(
                f"{self.name} is {text}; expected {_EXPECTED[kind]} from {self.low:g} to {self.high:g} ({self.doc})"
            )
        return kind(number)


class ParamSet:
    """The parameters of one planner."""

    def __init__(self, parameters: tuple[Parameter, ...]) -> None:
        self._parameters = {parameter.name: parameter for parameter in parameters}
        self._values = {parameter.name: parameter.default for parameter in parameters}

    def __getitem__(self, name: str) -> Value:
        """Current value."""
        self._find(name)
        return self._values[name]

    def __setitem__(self, name: str, value: Value | str) -> None:
        self._values[name] = self._find(name).parse(str(value))

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def setParam(self, name: str, value: str) -> bool:  # noqa: N802 (OMPL's name)
        """Set a parameter from text; false, as in OMPL, if the name is unknown or the value is rejected."""
        try:
            self[name] = value
        except (KeyError, ValueError):
            return False
        return True

    def getParam(self, name: str) -> str:  # noqa: N802
        """Current value as text."""
        return str(self[name])

    def getParamNames(self) -> list[str]:  # noqa: N802
        """All names."""
        return list(self._values)

    def getParams(self) -> dict[str, str]:  # noqa: N802
        """All values as text."""
        return {name: str(value) for name, value in self._values.items()}

    def getRangeSuggestion(self, name: str) -> str:  # noqa: N802
        """Suggested range first:step:last."""
        return self._find(name).suggestion

    def describe(self, name: str) -> Parameter:
        """Default, bounds and description."""
        return self._find(name)

    def _find(self, name: str) -> Parameter:
        if name not in self._parameters:
            matches = difflib.get_close_matches(name, self._parameters, 1)
            hint = f"did you mean {matches[0]}?" if matches else f"there are {', '.join(self._parameters)}"
            raise KeyError(f"no parameter {name!r}; {hint}")
        return self._parameters[name]


DIRT_PARAMETERS = (
    Parameter("blossom", 0, 0, 32, "4:4:32", "candidate edges per visit; 0 takes 32 compiled and 4 with callbacks"),
    Parameter("child_extension", True, 0, 1, "0,1", "visit a child next if it is nearer to the goal than its parent"),
    Parameter("cycle", 0.0, 0, 1e3, "0.:.1:2.", "planning cycle (s): SAFETY of edges that cross its end; 0: off"),
    Parameter("goal_bias", 0.05, 0, 1, "0.:.05:1.", "share of the samples at the goal"),
    Parameter(
        "control_bound_bias",
        1.0,
        0,
        100,
        "0.:.25:2.",
        "how far sampled controls go beyond each bound, onto which they are moved, as a share of the range",
    ),
    Parameter("max_nodes", MAX_NODES, 100, 100_000_000, "100000:100000:10000000", "nodes that memory may grow to"),
    Parameter("polish", False, 0, 1, "0,1", "improve the best plan by local optimisation (compiled only)"),
    Parameter("pruning", False, 0, 1, "0,1", "remove nodes that cannot lead to a better plan"),
    Parameter("resolution", 0.01, 0, 10, "0.:.005:.1", "radius (m) below which a dominated region is closed"),
    Parameter("seed", 1, 0, 2**53, "1:1:100", "seed of the planner's generator; clear() selects the next one"),
    Parameter("threads", 1, 1, 64, "1:1:8", "trees that are grown at the same time (compiled only)"),
    Parameter(
        "top_speed",
        0.0,
        0,
        1e6,
        "0.:.1:10.",
        "largest decrease of the goal distance per second; 0: learned (callbacks only)",
    ),
    Parameter("use_callbacks", False, 0, 1, "0,1", "use OMPL's callbacks even for a compiled vehicle"),
)
