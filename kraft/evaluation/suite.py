"""Suites: files that name the entries of an evaluation, each a scenario with some of its keys set.

`entries_of` makes the entries of an evaluation from scenarios or a suite, from keys that are set in all of them, and
from keys that are varied.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field, StringConstraints

from kraft.config import bundled
from kraft.config.document import Document, Value
from kraft.config.overrides import (
    Override,
    all_of_kind,
    overrides_of,
    plain_value,
    repeated,
    repeated_values,
    value_text,
)
from kraft.config.schema import Name, StrictModel, check, part
from kraft.config.source import Place, Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.files import path_from
from kraft.scenario import Scenario, load_scenario
from kraft.scenario.paths import value_here

EntryName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}$")]
ScenarioLike: TypeAlias = str | Path | Scenario
SettingsLike: TypeAlias = Mapping[str, Any] | Sequence[Override]
"""Values of dotted keys."""
Sweeps: TypeAlias = Mapping[str, Sequence[Any] | np.ndarray[Any, Any]] | Sequence[tuple[Override, ...]]
"""Several values for each dotted key."""


class EntryFile(StrictModel):
    """One entry of a suite."""

    name: EntryName
    """short name of letters, digits, -, _, + and ."""
    scenario: str
    """a scenario's name, or the path of its file relative to this file"""
    set: dict[str, Any] = Field(default_factory=dict)
    """values of the scenario's dotted keys: {sensing.noise_scale: 2}"""


class SuiteFile(StrictModel):
    """A suite: the entries of an evaluation."""

    name: Name
    """short name of letters, digits, - and _"""
    description: str = ""
    """one sentence for `kraft list suites`"""
    entries: Annotated[tuple[EntryFile, ...], Field(min_length=1)]
    """the entries {name, scenario, set}"""


@dataclass(frozen=True)
class Entry:
    """Entry of an evaluation.

    Attributes:
        name: unique in the evaluation.
        base: name before keys were varied; entries with the same base differ in the varied keys alone.
        reference: name or path of the scenario's file; empty for a scenario that was loaded before.
        scenario: the scenario with all its keys set.
        settings: values of the keys that were set, by dotted key, for a JSON file; paths in them begin at the working
            directory.
    """

    name: str
    base: str
    reference: str
    scenario: Scenario
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Draft:
    """Entry whose scenario is not loaded yet."""

    name: str
    scenario: ScenarioLike
    overrides: tuple[Override, ...] = ()

    def load(self) -> Entry:
        """Load the scenario and set its keys."""
        if isinstance(self.scenario, Scenario):
            if self.overrides:
                expected = "expected a name or a path, whose keys can be set"
                name = self.name or self.scenario.name
                raise InputError.of(name, "is a scenario that was loaded before", expected, Code.CONFLICT)
            name = self.name or self.scenario.name
            return Entry(name, name, "", self.scenario)
        scenario = load_scenario(self.scenario, self.overrides)
        settings = {each.key: plain_value(value_here(each)) for each in self.overrides}
        name = self.name or scenario.name
        return Entry(name, name, str(self.scenario), scenario, settings)


def load_suite(name_or_path: str | Path) -> list[Entry]:
    """Entries of a bundled suite (``hard``) or of a suite file.

    Raises:
        InputError: with every problem of the file and of the scenarios with their keys set.
    """
    return entries_of((), suite=name_or_path)


def entries_of(
    scenarios: Sequence[ScenarioLike],
    *,
    suite: str | Path | None = None,
    settings: SettingsLike = (),
    vary: Sweeps = (),
) -> list[Entry]:
    """Entries of an evaluation.

    Args:
        scenarios: names, paths or loaded scenarios; ignored if there is a suite.
        suite: name or path of a suite.
        settings: keys that are set in every entry.
        vary: keys that are varied; every entry is made once for each combination of their values.

    Raises:
        InputError: with every problem of the suite, the scenarios, the keys and their values.
    """
    common = overrides_of(settings)
    sweeps = _sweeps(vary) if isinstance(vary, Mapping) else all_of_kind(tuple, vary, "vary")
    problems = repeated([*common, *(sweep[0] for sweep in sweeps)])
    if problems:
        raise InputError(problems)
    drafts = _drafts(scenarios, problems) if suite is None else _suite_drafts(bundled.find("suite", suite), problems)
    entries: list[Entry] = []
    for draft in drafts:
        try:
            _check_apart(draft, common, sweeps)
            entries += list(_varied(replace(draft, overrides=(*draft.overrides, *common)), sweeps))
        except InputError as error:
            problems += error.diagnostics
    problems += repeated_names("scenario", (entry.name for entry in entries)) if suite is None else []
    if problems:
        raise InputError(problems)
    return entries


def _varied(draft: _Draft, sweeps: tuple[tuple[Override, ...], ...]) -> Iterator[Entry]:
    """Entry for each combination of the varied values, or one if nothing is varied.

    A key may need the value of a varied one, so no scenario is loaded without the varied values.
    """
    problems: list[Diagnostic] = []
    for values in itertools.product(*sweeps):
        try:
            entry = replace(draft, overrides=(*draft.overrides, *values)).load()
        except InputError as error:
            problems += error.diagnostics
            continue
        label = ", ".join(f"{each.key}={value_text(each.value)}" for each in values)
        yield replace(entry, name=f"{entry.name} {label}") if values else entry
    if problems:
        raise InputError(problems)


def _drafts(scenarios: Sequence[ScenarioLike], problems: list[Diagnostic]) -> list[_Draft]:
    """Entries of scenarios, not loaded; problems of the list are added to `problems`."""
    problems += list_problems("scenario", scenarios)
    if isinstance(scenarios, str | Path):
        return []
    return [_Draft("", scenario) for scenario in scenarios if scenario != ""]


def list_problems(noun: str, given: Sequence[object]) -> Iterator[Diagnostic]:
    """Problems of the argument that lists names, paths or objects: it is one name, is empty, or has an empty name.

    Raises:
        TypeError: if it is no list, or another iterable that can be read only once.
    """
    if isinstance(given, str | Path):
        expected = f"expected a list of {noun}s, as in [{str(given)!r}]"
        yield Diagnostic(f"{noun}s", f"is the text {str(given)!r}", expected, code=Code.TYPE, argument=True)
        return
    if not isinstance(given, Collection):
        raise TypeError(f"{noun}s: expected a list of {noun}s, not {type(given).__name__}")
    if len(given) == 0:
        expected = f"expected at least one {noun}"
        yield Diagnostic(f"{noun}s", "none are given", expected, code=Code.MISSING, argument=True)
    if "" in given:
        yield Diagnostic(f"{noun}s", "there is an empty name", f"expected names of {noun}s", argument=True)


def repeated_names(noun: str, names: Iterable[str]) -> Iterator[Diagnostic]:
    """Problem of each name that occurs several times."""
    for name, count in Counter(names).items():
        if count > 1:
            problem = f"the {noun} is given {count} times"
            expected = "expected each name once; of a file, the `name` in it counts"
            yield Diagnostic(name, problem, expected, code=Code.DUPLICATE)


def _suite_drafts(path: Path, problems: list[Diagnostic]) -> list[_Draft]:
    """Entries of a suite file, not loaded; problems of the file itself are added to `problems`."""
    document = read_document(path)
    problems += [*check(SuiteFile, document)[1], *_repeated_entries(document)]
    drafts = []
    for k, entry in _valid_entries(document):
        reference = entry.scenario if bundled.is_name(entry.scenario) else path_from(path.parent, entry.scenario)
        try:
            bundled.find("scenario", reference)
            overrides = _entry_overrides(document.source, k, entry.set, path.parent, problems)
            drafts.append(_Draft(entry.name, reference, overrides))
        except InputError as error:
            source, at = document.source, ("entries", k, "scenario")
            problems += [
                source.diagnostic(at, d.problem, d.expected, code=d.code) if d.line is None else d
                for d in error.diagnostics
            ]
    return drafts


def _valid_entries(document: Document) -> Iterator[tuple[int, EntryFile]]:
    """Entries that are valid by themselves, with their numbers: their scenarios are checked whatever else is wrong."""
    entries = document.data.get("entries") if isinstance(document.data, dict) else None
    for k, content in enumerate(entries if isinstance(entries, tuple) else ()):
        entry = part(EntryFile, content)
        if entry is not None:
            yield k, entry


def _entry_overrides(
    source: Source, entry: int, values: Mapping[str, Value], folder: Path, problems: list[Diagnostic]
) -> tuple[Override, ...]:
    """Overrides of an entry; problems of their keys are added to `problems`."""
    found: list[Override] = []
    for key, value in values.items():
        at = ("entries", entry, "set", key)
        place = Place(source.file, source.values.get(at), folder=folder)
        try:
            found.append(replace(overrides_of({key: value})[0], place=place))
        except InputError as error:
            place = replace(place, position=source.keys.get(at))
            problems += [place.diagnostic(key, d.problem, d.expected, d.code) for d in error.diagnostics]
    problems += repeated(found)
    return tuple(found)


def _repeated_entries(document: Document) -> Iterator[Diagnostic]:
    entries = document.data.get("entries") if isinstance(document.data, dict) else None
    names: dict[Value, int] = {}
    for k, entry in enumerate(entries if isinstance(entries, tuple) else ()):
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            continue
        if name in names:
            problem, expected = f"is the name of entry {names[name]} too", "expected each name once"
            yield document.source.diagnostic(("entries", k, "name"), problem, expected, code=Code.DUPLICATE)
        names.setdefault(name, k)


def _check_apart(draft: _Draft, common: Sequence[Override], sweeps: Sequence[tuple[Override, ...]]) -> None:
    """Check that a suite does not set the keys that are set or varied for all of its entries.

    Raises:
        InputError: with every key that both set.
    """
    given = [*common, *(sweep[0] for sweep in sweeps)]
    both = [each for each in given if repeated([*draft.overrides, each])]
    if both:
        expected = "expected a key that the suite does not set"
        raise InputError(
            each.diagnostic(f"the entry {draft.name} sets it too", expected, Code.DUPLICATE) for each in both
        )


def _has_values(values: object) -> bool:
    """Whether the values of a varied key are a list, of Python or numpy, that is not empty."""
    if isinstance(values, np.ndarray):
        return values.size > 0 and values.ndim > 0
    return isinstance(values, Sized) and not isinstance(values, str) and len(values) > 0


def _sweeps(vary: Mapping[str, Sequence[Any] | np.ndarray[Any, Any]]) -> tuple[tuple[Override, ...], ...]:
    """Overrides for each value of each key."""
    empty = [key for key, values in vary.items() if not _has_values(values)]
    if empty:
        place = Place("vary", argument=True)
        raise InputError(
            place.diagnostic(key, "has no values", "expected a list of values", Code.MISSING) for key in empty
        )
    sweeps = tuple(tuple(overrides_of({key: value}, "vary")[0] for value in values) for key, values in vary.items())
    twice = [repeated_values(each[0].key, [one.value for one in each], each[0].place) for each in sweeps]
    if problems := list(itertools.chain.from_iterable(twice)):
        raise InputError(problems)
    return sweeps
