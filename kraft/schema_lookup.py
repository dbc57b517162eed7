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


def lookup(model: type[BaseModel], path: KeyPath) -> Known:
    """Follow a key path through the annotations of a schema."""
    annotation: Any = model
    description: str | None = None
    length = 0
    for part_ in path:
        annotation = _bare(annotation)
        arguments = get_args(annotation)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found = annotation.model_fields.get(str(part_))
            if found is None:
                return Known()
            annotation, description = found.annotation, found.description
        elif get_origin(annotation) is tuple and isinstance(part_, int):
            length = len(arguments)
            if Ellipsis in arguments:  # the description is that of the list, not of an item
                annotation, description = arguments[0], None
            else:
                annotation = arguments[min(part_, length - 1)]
        elif len(arguments) == 2:
            annotation, description = arguments[1], None
        else:
            return Known()
    annotation = _bare(annotation)
    keys: tuple[str, ...] = ()
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        keys = tuple(annotation.model_fields)
    choices = tuple(str(c) for c in get_args(annotation)) if get_origin(annotation) is Literal else ()
    return Known(description, keys, choices, length)
