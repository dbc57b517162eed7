"""Files that are based on another one: the keys of a file with the key `base` override those of its base.

Mappings are merged key by key.  A list, or a mapping of another `kind`, replaces that of the base; so does null.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Generic, TypeVar

from pydantic import BaseModel

from kraft.config import bundled
from kraft.config.document import Document, Value
from kraft.config.schema import check
from kraft.config.source import KeyPath, Place, Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.files import path_from

BASE: Final = "base"
"""Key of the name or path of the base; a path is relative to the file."""

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class BasedFiles(Generic[Model]):
    """Files of one kind that may have bases.

    Attributes:
        kind: kind of the files.
        model: schema of a file with its base.
        own: keys that a file does not take from its base.
    """

    kind: bundled.Kind
    model: type[Model]
    own: Collection[str]

    def read(self, path: Path) -> tuple[Model, Document]:
        """Read a file with its bases and validate it; the document has the keys of all of them.

        Raises:
            InputError: with every problem of the file and of its bases; if it is based on itself.
        """
        found = self._read(path, ())
        if found.value is None:
            raise InputError(found.problems)
        return found.value, found.document

    def _read(self, path: Path, derived: tuple[Path, ...]) -> _Read[Model]:
        """Read a file; `derived` are the files that are based on it, the first one first."""
        document = read_document(path)
        reference = document.data.get(BASE) if isinstance(document.data, dict) else None
        if not isinstance(reference, str):  # none, or a value that the schema refuses
            value, problems = check(self.model, document)
            return _Read(document, value, problems)
        try:
            base = self._read(self._base(reference, path, document, derived), (*derived, path))
        except InputError as error:
            return _Read(document, None, [*error.diagnostics, *self._without_base(document)], whole=False)
        if not base.whole:
            return _Read(document, None, [*base.problems, *self._without_base(document)], whole=False)
        together = merged(base.document, document, {*self.own, BASE})
        value, problems = check(self.model, together)
        if base.problems:
            known = {(each.path, each.problem) for each in base.problems}
            others = [each for each in problems if each.path in self.own or (each.path, each.problem) not in known]
            return _Read(together, None, [*base.problems, *others])
        return _Read(together, value, [_of_file(each, document.source) for each in problems])

    def _without_base(self, document: Document) -> list[Diagnostic]:
        """Problems of a file that it has whatever its base is, which cannot be read."""
        found = check(self.model, document, across_keys=False)[1]
        return [each for each in found if each.code is not Code.MISSING or each.path in self.own]

    def _base(self, reference: str, path: Path, document: Document, derived: tuple[Path, ...]) -> Path:
        """File of a base.

        Raises:
            InputError: at the key `base`, if there is none, or it is based on this file.
        """
        try:
            named = reference if bundled.is_name(reference) else path_from(path.parent, reference)
            found = bundled.find(self.kind, named)
        except InputError as error:
            raise InputError(
                document.source.diagnostic(BASE, each.problem, each.expected, code=each.code)
                for each in error.diagnostics
            ) from None
        files = [*derived, path]
        same = [k for k, file in enumerate(files) if os.path.samefile(file, found)]
        if same:
            names = " -> ".join(str(file) for file in [*files[same[0] :], found])
            problem, expected = f"is based on this file: {names}", "expected a base that is not based on this file"
            raise InputError([document.source.diagnostic(BASE, problem, expected, code=Code.CONFLICT)])
        return found


@dataclass(frozen=True)
class _Read(Generic[Model]):
    """File with its bases: the document of all keys, the model if it is valid, and otherwise all problems.

    It is not `whole` if a base cannot be read; the document then lacks the keys of this base.
    """

    document: Document
    value: Model | None
    problems: list[Diagnostic]
    whole: bool = True


def merged(base: Document, own: Document, own_keys: Collection[str]) -> Document:
    """Document with the keys of `own`, and those of `base` that it does not have, apart from the top-level `own_keys`.

    Places of keys of the base are those of its file; `BASE` is left out.
    """
    below = base.data if isinstance(base.data, dict) else {}
    above = own.data if isinstance(own.data, dict) else {}
    kept = {key: value for key, value in below.items() if key not in own_keys}
    places: dict[KeyPath, Place] = {}
    data = dict(_merged((), kept, {key: value for key, value in above.items() if key != BASE}, base.source, places))
    unusable = own.unusable | {path for path in base.unusable if path in places}
    source = replace(own.source, replaced={**own.source.replaced, **places})
    return replace(own, data=data, source=source, unusable=unusable)


def _merged(
    path: KeyPath, below: Mapping[str, Value], above: Mapping[str, Value], source: Source, places: dict[KeyPath, Place]
) -> Iterator[tuple[str, Value]]:
    """Keys and values of a merged mapping; the places of those that come from below are added to `places`."""
    for key in {**below, **above}:
        at = (*path, key)
        if key not in above:
            places.update(_places(at, source))
            yield key, below[key]
            continue
        one, other = below.get(key), above[key]
        if isinstance(one, dict) and isinstance(other, dict) and other.get("kind", one.get("kind")) == one.get("kind"):
            yield key, dict(_merged(at, one, other, source, places))
        else:
            yield key, other


def _places(path: KeyPath, source: Source) -> Iterator[tuple[KeyPath, Place]]:
    """Place of the value at a path, and of every value in it."""
    for at in {**source.values, **source.replaced}:
        if at[: len(path)] == path:
            place = source.replacement(at)
            yield at, place or Place(source.file, source.values[at], folder=Path(source.file).parent)


def _of_file(problem: Diagnostic, source: Source) -> Diagnostic:
    """Problem at its place in the file, or at the nearest key there, if only its base has the value.

    The base is valid by itself: the problem is that this file does not fit to it.
    """
    if problem.file == source.file:
        return problem
    where = f"{problem.problem}, with the value of the base at {problem.place}"
    return source.diagnostic(problem.path, where, problem.expected, code=problem.code)
