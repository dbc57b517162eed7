"""Collects what is found in a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from kraft.logs.log import Finding


@dataclass
class Findings:
    """What was found so far, in the order in which it was found."""

    found: list[Finding] = field(default_factory=list)

    def add(self, kind: str, count: int, text: str) -> None:
        """Note a finding; one that was not found even once is none."""
        finding = Finding(kind, int(count), text)
        if count and finding not in self.found:  # commands and poses may share their rows
            self.found.append(finding)

    def as_tuple(self) -> tuple[Finding, ...]:
        """Return all of them."""
        return tuple(self.found)


def count(number: int | Sequence[object], one: str, many: str = "") -> str:
    """Say a number of things: ``1 row``, ``3 rows``."""
    n = number if isinstance(number, int) else len(number)
    return f"{n} {one if n == 1 else many or one + 's'}"
