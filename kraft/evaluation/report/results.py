"""A results folder as the report reads it: the manifest, the trials there are, and the table made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation import journal, manifest
from kraft.evaluation.experiment import Experiment
from kraft.evaluation.row import Key, TrialRow
from kraft.evaluation.summary import FILE as SUMMARY
from kraft.evaluation.summary import Name, Summary, tabulate
from kraft.scenario import Scenario, load_scenario
from kraft.text import grouped

EXPECTED = "expected the folder of a kraft eval"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Cell(_Part):
    """A row of a table; what wrote the folder may have been too old to give it a title."""

    scenario: str
    method: str
    title: str = ""


class Hashed(_Part):
    """What a scenario was understood as, by its hash."""

    sha256: str


class Manifest(_Part):
    """The parts of `manifest.json` that the report shows."""

    arguments: dict[str, Any]
    began: str
    trials: int = Field(ge=1)
    seed: int
    realtime: bool
    rows: tuple[Cell, ...] = Field(min_length=1)
    scenarios: dict[str, Hashed]
    vehicles: dict[str, Any]
    versions: dict[str, str]

    @property
    def seeds(self) -> range:
        """Seeds of the trials, the same in every row."""
        return range(self.seed, self.seed + self.trials)

    @property
    def names(self) -> list[Name]:
        """Scenario, method and title of every row."""
        return [(cell.scenario, cell.method, cell.title or cell.method) for cell in self.rows]


class CommandLine(Protocol):
    """Makes the command that repeats a trial."""

    def __call__(self, scenario: str, method: str, vehicle: str | None, seed: int, video: str | None = None) -> str:
        """The command; `scenario`, `method` and `vehicle` are names or paths, `video` is a file for its film."""
        ...


@dataclass(frozen=True)
class Results:
    """An evaluation that was run, or a part of it.

    `known` are the scenarios as they were driven; one that changed since then, or is gone, is not among them.
    With `command_line` the page has commands that repeat the trials.
    """

    manifest: Manifest
    rows: Mapping[Key, TrialRow]
    summary: Summary
    known: Mapping[str, Scenario]
    command_line: CommandLine | None = None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        content: Mapping[str, Any],
        rows: Mapping[Key, TrialRow],
        summary: Summary,
        command_line: CommandLine | None = None,
    ) -> Results:
        """Of an experiment that was just run; `content` is its manifest."""
        known = {cell.scenario.name: cell.scenario for cell in experiment.cells}
        return cls(Manifest.model_validate(content), rows, summary, known, command_line)

    @property
    def scenarios(self) -> list[str]:
        """Names of the scenarios, in their order."""
        return list(dict.fromkeys(cell.scenario for cell in self.manifest.rows))

    @property
    def methods(self) -> dict[str, str]:
        """Titles of the methods by their names, in their order."""
        return {method: title for _, method, title in self.manifest.names}

    @property
    def expected(self) -> int:
        """How many trials were asked for."""
        return len(self.manifest.rows) * self.manifest.trials

    @property
    def title(self) -> str:
        """What was run, in a line."""
        counts = [(len(self.rows), "trial"), (len(self.scenarios), "scenario"), (len(self.methods), "method")]
        return ", ".join(grouped(count, noun) for count, noun in counts)

    def of_cell(self, scenario: str, method: str | None = None) -> Sequence[TrialRow]:
        """Trials of a scenario, by method and seed."""
        methods = [method] if method else list(self.methods)
        keys = ((scenario, name, seed) for name in methods for seed in self.manifest.seeds)
        return [self.rows[key] for key in keys if key in self.rows]

    def command(self, row: TrialRow, video: str | None = None) -> str | None:
        """The command that repeats a trial, and films it into `video`; None without `command_line`."""
        if self.command_line is None:
            return None
        scenario = _references(self.manifest, "scenarios", self.scenarios).get(row.scenario, row.scenario)
        method = _references(self.manifest, "methods", list(self.methods)).get(row.method, row.method)
        vehicle = self.manifest.arguments.get("vehicle")
        return self.command_line(scenario, method, str(vehicle) if vehicle else None, row.seed, video)


def read_results(folder: Path, command_line: CommandLine | None = None) -> Results:
    """Read a results folder, whether or not the evaluation came to its end.

    Raises:
        InputError: if it is none, or damaged.
    """
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "there is no such folder"
        raise InputError.of(str(folder), problem, EXPECTED, Code.NOT_FOUND)
    file = folder / manifest.NAME
    if not file.exists():
        raise InputError.of(str(folder), f"has no {manifest.NAME}", EXPECTED, Code.NOT_FOUND)
    content = manifest.read_manifest(file)
    if content["schema"] != manifest.SCHEMA:
        problem = f"has the schema {content['schema']!r}"
        raise InputError.of(str(file), problem, f"expected {manifest.SCHEMA!r}", Code.MISMATCH)
    try:
        found = Manifest.model_validate(content)
    except ValidationError as error:
        where = ".".join(str(part) for part in error.errors()[0]["loc"])
        expected = "expected a manifest as kraft eval writes it"
        raise InputError([Diagnostic(str(file), "is damaged", expected, path=where, code=Code.SYNTAX)]) from None
    trials = {(cell.scenario, cell.method, seed) for cell in found.rows for seed in found.seeds}
    rows = journal.read_journal(folder / journal.NAME, trials).rows
    summary = tabulate(found.names, found.seeds, rows, _wall(folder), realtime=found.realtime)
    return Results(found, rows, summary, _unchanged(found), command_line)


def _wall(folder: Path) -> float:
    """How long the evaluation took, s, as its summary says; 0 if it did not come to its end."""
    try:
        return float(json.loads((folder / SUMMARY).read_bytes())["wall_s"])
    except FileNotFoundError:
        return 0.0
    except (OSError, ValueError, KeyError, TypeError):
        expected = "expected what kraft eval writes there; going on with the evaluation makes it again"
        raise InputError.of(str(folder / SUMMARY), "is damaged", expected, Code.SYNTAX) from None


def _unchanged(found: Manifest) -> dict[str, Scenario]:
    """The scenarios that can be loaded and are what they were."""
    known = {}
    for name, reference in _references(found, "scenarios", list(found.scenarios)).items():
        try:
            scenario = load_scenario(reference)
        except InputError:
            continue  # the page says that there is no picture, and why
        if manifest.scenario_entry(scenario)["sha256"] == found.scenarios[name].sha256:
            known[name] = scenario
    return known


def _references(found: Manifest, kind: str, names: Sequence[str]) -> dict[str, str]:
    """What was written on the command line for each name; the name itself where nothing was recorded."""
    written = found.arguments.get(kind)
    if not isinstance(written, list) or len(written) != len(names):
        return {name: name for name in names}
    return {name: str(reference) for name, reference in zip(names, written, strict=True)}
