"""Results of an evaluation as the report needs them: manifest, finished trials and summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Protocol, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation import journal
from kraft.evaluation.experiment import Experiment
from kraft.evaluation.journal import Key, Replays, TrialRow
from kraft.evaluation.manifest import MANIFEST, read_manifest, scenario_content
from kraft.evaluation.summary import FILE as SUMMARY
from kraft.evaluation.summary import RowName, Summary, distinct_titles, recorded_wall, tabulate, wall_of
from kraft.scenario import Scenario, Score, load_scenario
from kraft.text import counted, grouped, slugs

EXPECTED = "expected the results folder of a kraft eval"


VERSIONS: Final = ("kraft", "mujoco", "python")
"""Programs whose versions the page has."""

ANCHORS = (
    "overview", "causes", "methods", "sweeps", "trials", "entries", "replay", "data", "stage", "plots"
)  # fmt: skip
"""Anchors of the page itself, which no entry may have."""
ANCHORED = ("filter-", "replay-", "trials-", "show")
"""Beginnings of further ones, and of addresses that open something else."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class RecordedCell(_Part):
    """Cell of the experiment as the manifest records it.

    Older manifests have no title, no entries, and the paper's results wherever the names are those of the paper.
    """

    entry: str = ""
    base: str = ""
    scenario: str
    reference: str = ""
    set: dict[str, Any] = {}
    method: str
    title: str = ""
    of_paper: bool = True
    score: Score | None = None

    @property
    def name(self) -> str:
        """Name of the entry; in older manifests that of the scenario."""
        return self.entry or self.scenario


class Hashed(_Part):
    """Hash of the resolved scenario."""

    sha256: str


class Manifest(_Part):
    """Parts of `manifest.json` that the report uses."""

    arguments: dict[str, Any]
    began: str
    trials: int = Field(ge=1)
    seed: int
    realtime: bool
    bounds_s: dict[str, float] = {}
    warnings: tuple[str, ...] = ()
    rows: tuple[RecordedCell, ...] = Field(min_length=1)
    scenarios: dict[str, Hashed]
    vehicles: dict[str, Any]
    versions: dict[str, str]

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        """Check that every row has its scenario, and that the versions of the page are there."""
        missing = {cell.name for cell in self.rows} - self.scenarios.keys() | set(VERSIONS) - self.versions.keys()
        if missing:
            raise ValueError(f"{', '.join(sorted(missing))} is missing")
        return self

    @property
    def seeds(self) -> range:
        """Seeds of the trials, the same in every row."""
        return range(self.seed, self.seed + self.trials)

    @property
    def names(self) -> list[RowName]:
        """Name of every row."""
        titles = distinct_titles({cell.method: cell.title or cell.method for cell in self.rows})
        return [
            RowName(
                cell.name,
                cell.scenario,
                cell.set,
                cell.method,
                titles[cell.method],
                cell.score,
                self.bounds_s.get(cell.name),
                cell.of_paper,
            )
            for cell in self.rows
        ]


class CommandLine(Protocol):
    """Function that makes the command that repeats a trial."""

    def __call__(
        self,
        scenario: str,
        method: str,
        vehicle: str | None,
        seed: int,
        video: str | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> str:
        """Make the command.

        `scenario`, `method` and `vehicle` are names or paths, `video` is the file of a film, `settings` are values of
        the scenario's keys.
        """
        ...


@dataclass(frozen=True)
class Results:
    """Finished trials of an evaluation, complete or not.

    `known` are the scenarios, by entry, that can still be loaded and are unchanged since the evaluation.  With
    `command_line` the page has commands that repeat the trials; without `replays` it has none of these.
    """

    manifest: Manifest
    rows: Mapping[Key, TrialRow]
    summary: Summary
    known: Mapping[str, Scenario]
    command_line: CommandLine | None = None
    replays: Replays | None = None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        content: Mapping[str, Any],
        rows: Mapping[Key, TrialRow],
        summary: Summary,
        command_line: CommandLine | None = None,
        replays: Replays | None = None,
    ) -> Results:
        """Results of an experiment that was just run; `content` is its manifest."""
        known = {cell.entry.name: cell.scenario for cell in experiment.cells}
        return cls(Manifest.model_validate(content), rows, summary, known, command_line, replays)

    @cached_property
    def entries(self) -> dict[str, RecordedCell]:
        """A row of each entry by the entry's name, in their order."""
        found: dict[str, RecordedCell] = {}
        for cell in self.manifest.rows:
            found.setdefault(cell.name, cell)
        return found

    @cached_property
    def methods(self) -> dict[str, str]:
        """Titles of the methods by their names, in their order."""
        return {name.method: name.title for name in self.manifest.names}

    @property
    def expected(self) -> int:
        """Number of trials of the complete evaluation."""
        return len(self.manifest.rows) * self.manifest.trials

    @property
    def title(self) -> str:
        """Numbers of trials, scenarios or entries of a suite, and methods, in words."""
        plain = all(cell.name == cell.scenario for cell in self.manifest.rows)
        entries = len(self.entries), "scenario" if plain else "entry"
        counts = [(len(self.rows), "trial"), entries, (len(self.methods), "method")]
        return ", ".join(grouped(count, noun) for count, noun in counts)

    def of_cell(self, entry: str, method: str | None = None) -> Sequence[TrialRow]:
        """Finished trials of an entry, or of a method in it, ordered by method and seed."""
        methods = [method] if method else list(self.methods)
        keys = ((entry, name, seed) for name in methods for seed in self.manifest.seeds)
        return [self.rows[key] for key in keys if key in self.rows]

    @cached_property
    def numbers(self) -> dict[Key, int]:
        """Number of each trial of the complete evaluation, in their order."""
        keys = ((cell.name, cell.method, seed) for cell in self.manifest.rows for seed in self.manifest.seeds)
        return {key: number for number, key in enumerate(keys)}

    def command(self, row: TrialRow, video: str | None = None) -> str | None:
        """Command that repeats a trial, and films it into `video`; None without `command_line`."""
        if self.command_line is None:
            return None
        scenario = self._scenarios.get(row.key[0], row.scenario)
        method = self._methods.get(row.method, row.method)
        vehicle = self.manifest.arguments.get("vehicle")
        settings = self.entries[row.key[0]].set
        return self.command_line(scenario, method, str(vehicle) if vehicle else None, row.seed, video, settings)

    @cached_property
    def slugs(self) -> dict[str, str]:
        """Each entry's name as an anchor and as a part of a file's name."""
        taken = {self._anchor(name): name for name in self.entries}
        return {taken[name]: slug for name, slug in slugs(taken).items()}

    def _anchor(self, entry: str) -> str:
        """Name of an entry, or if that is an anchor of the page, one that no other entry has."""
        if entry not in ANCHORS and not entry.startswith(ANCHORED):
            return entry
        anchor = f"entry-{entry}"
        while anchor in self.entries:
            anchor = f"entry-{anchor}"
        return anchor

    @cached_property
    def _scenarios(self) -> dict[str, str]:
        """Name or path of the scenario of each entry."""
        return _scenario_references(self.manifest)

    @cached_property
    def _methods(self) -> dict[str, str]:
        """Name or path of each method."""
        return _references(self.manifest, "methods", list(self.methods))


@dataclass(frozen=True)
class RecordedTrials:
    """What a results folder has recorded.

    `manifest` is what the report needs of the manifest, `content` all of it; `rows` are the finished trials.
    """

    manifest: Manifest
    content: dict[str, Any]
    rows: dict[Key, TrialRow]

    @property
    def missing(self) -> int:
        """Number of trials that have not run yet."""
        return len(self.manifest.rows) * self.manifest.trials - len(self.rows)


def parts_of_manifest(file: Path, content: Mapping[str, Any]) -> Manifest:
    """Parts of a manifest that the report uses.

    Raises:
        InputError: with the first part that is missing or is not what kraft eval writes.
    """
    try:
        return Manifest.model_validate(content)
    except ValidationError as error:
        where = ".".join(str(part) for part in error.errors()[0]["loc"])
        expected = "expected the manifest that kraft eval writes"
        raise InputError([Diagnostic(str(file), "is damaged", expected, path=where, code=Code.SYNTAX)]) from None


def read_trials(folder: Path) -> RecordedTrials:
    """Read manifest and trials of a complete or unfinished evaluation.

    Raises:
        InputError: if the folder is not a results folder or is damaged.
    """
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "there is no such folder"
        raise InputError.of(str(folder), problem, EXPECTED, Code.NOT_FOUND)
    file = folder / MANIFEST
    if not file.exists():
        raise InputError.of(str(folder), f"has no {MANIFEST}", EXPECTED, Code.NOT_FOUND)
    content = read_manifest(file)
    found = parts_of_manifest(file, content)
    trials = {(cell.name, cell.method, seed) for cell in found.rows for seed in found.seeds}
    rows = journal.read_journal(folder / journal.NAME, trials)
    _check_complete(folder, rows, len(trials))
    return RecordedTrials(found, content, rows)


def read_results(folder: Path, command_line: CommandLine | None = None) -> Results:
    """Read a results folder of a complete or unfinished evaluation.

    Raises:
        InputError: if the folder is not a results folder or is damaged.
    """
    recorded = read_trials(folder)
    found, rows = recorded.manifest, recorded.rows
    wall = wall_of(_recorded_wall(folder), rows.values())
    summary = tabulate(found.names, found.seeds, rows, wall, realtime=found.realtime)
    replays = journal.Replays(folder / journal.REPLAYS)
    return Results(found, rows, summary, _unchanged(found), command_line, replays)


def _check_complete(folder: Path, rows: Mapping[Key, TrialRow], expected: int) -> None:
    """Check that a folder with a summary, which is written when the last trial has ended, has all trials.

    Raises:
        InputError: if it has fewer: lines of the journal were lost.
    """
    if len(rows) < expected and (folder / SUMMARY).exists():
        problem = f"has {len(rows)} of {counted(expected, 'trial')}, although {SUMMARY} says that all have ended"
        instead = "expected the lines of all trials; resuming the evaluation runs the lost ones again"
        raise InputError.of(str(folder / journal.NAME), problem, instead, Code.MISMATCH)


def _recorded_wall(folder: Path) -> float:
    """Duration of the evaluation in its summary, s; 0 if it is unfinished.

    Raises:
        InputError: if the summary is damaged.
    """
    wall = recorded_wall(folder)
    if wall is None:
        expected = "expected the summary that kraft eval writes; resuming the evaluation writes it again"
        raise InputError.of(str(folder / SUMMARY), "is damaged", expected, Code.SYNTAX)
    return wall


def _unchanged(found: Manifest) -> dict[str, Scenario]:
    """Scenarios that can be loaded and have the recorded hash."""
    known = {}
    settings = {cell.name: cell.set for cell in found.rows}
    for name, reference in _scenario_references(found).items():
        try:
            scenario = load_scenario(reference, settings[name])
        except InputError:
            continue  # the page states that it has no floor plan, and why
        if scenario_content(scenario)["sha256"] == found.scenarios[name].sha256:
            known[name] = scenario
    return known


def _scenario_references(found: Manifest) -> dict[str, str]:
    """Name or path of the scenario of each entry."""
    names = list(dict.fromkeys(cell.name for cell in found.rows))
    recorded = {cell.name: cell.reference for cell in found.rows if cell.reference}
    return {**_references(found, "scenarios", names), **recorded}


def _references(found: Manifest, kind: str, names: Sequence[str]) -> dict[str, str]:
    """Recorded argument for each name; the name itself where none was recorded."""
    written = found.arguments.get(kind)
    # arguments that were not read back from the file are frozen: their lists are tuples
    if not isinstance(written, list | tuple) or len(written) != len(names):
        return {name: name for name in names}
    return {name: str(reference) for name, reference in zip(names, written, strict=True)}
