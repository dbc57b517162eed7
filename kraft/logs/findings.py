"""Collects what is found in a log."""

from __future__ import annotations

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
