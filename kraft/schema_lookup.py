"""What a schema says about one place of a file, for error messages."""

from __future__ import annotations

import types
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from kraft.source import KeyPath


@dataclass(frozen=True)
class Known:
    """What the schema says about one place."""

    description: str | None = None
    keys: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    length: int = 0


def _bare(annotation: Any) -> Any:
    """Strip ``Annotated`` and ``| None``."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _bare(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        members = [a for a in get_args(annotation) if a is not type(None)]
        return _bare(members[0]) if len(members) == 1 else annotation
    return annotation


def _kinds(annotation: Any) -> dict[str, Any]:
    """Members of a union of models by their ``kind``, empty if the annotation is no such union."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return {}
    members = [m for m in get_args(annotation) if isinstance(m, type) and issubclass(m, BaseModel)]
    return {get_args(m.model_fields["kind"].annotation)[0]: m for m in members if "kind" in m.model_fields}


def in_file(model: type[BaseModel], path: KeyPath) -> KeyPath:
    """Return a key path of pydantic's, which has the kind of a union's member as if it were a key, as in the file."""
    return tuple(part for i, part in enumerate(path) if part not in _kinds(_bare(_follow(model, path[:i])[0])))


def lookup(model: type[BaseModel], path: KeyPath) -> Known:
    """Follow a key path of pydantic's through the annotations of a schema."""
    annotation, description, length = _follow(model, path)
    if annotation is None:
        return Known()
    annotation = _bare(annotation)
    keys: tuple[str, ...] = ()
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        keys = tuple(annotation.model_fields)
    choices = tuple(str(c) for c in get_args(annotation)) if get_origin(annotation) is Literal else ()
    return Known(description, keys, choices, length)


def _follow(model: type[BaseModel], path: KeyPath) -> tuple[Any, str | None, int]:
    """Annotation at a path (None if there is none), its description, and the length of the list it is in."""
    annotation: Any = model
    description: str | None = None
    length = 0
    for part in path:
        annotation = _bare(annotation)
        arguments = get_args(annotation)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found = annotation.model_fields.get(str(part))
            if found is None:
                return None, None, 0
            annotation, description = found.annotation, found.description
        elif part in _kinds(annotation):
            annotation = _kinds(annotation)[str(part)]
        elif get_origin(annotation) is tuple and isinstance(part, int):
            length = len(arguments)
            if Ellipsis in arguments:  # the description is that of the list, not of an item
                annotation, description = arguments[0], None
            else:
                annotation = arguments[min(part, length - 1)]
        elif len(arguments) == 2:
            annotation, description = arguments[1], None
        else:
            return None, None, 0
    return annotation, description, length
