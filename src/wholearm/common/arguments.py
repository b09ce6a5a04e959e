"""Arguments of public functions, and fields, checked against the classes of their annotations."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from functools import cache, wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import wholearm

from .errors import InputError

_T = TypeVar("_T")
_P = ParamSpec("_P")
_BUILT_IN: dict[str, type] = {"None": type(None), "str": str, "Path": os.PathLike}


def _fits(value: Any, kind: str) -> bool:
    """Whether a value is of a kind, by names of classes: nothing is imported. Lists are tuples."""
    if kind.startswith("tuple"):
        item_kind, last = kind.removeprefix("tuple[").removesuffix("]").split(", ")
        matches = isinstance(value, tuple | list) and (last == "..." or len(value) == 2)
        return matches and all(_fits(item, item_kind) for item in value)
    if kind in _BUILT_IN:
        return isinstance(value, _BUILT_IN[kind])
    return kind in (ancestor.__name__ for ancestor in type(value).__mro__)


@cache
def _list_kinds(annotation: str) -> tuple[str, ...]:
    """Alternatives of an annotation of public classes and paths; none for other annotations."""
    names = {*re.findall(r"\w+", annotation)} - {"tuple", "None"}
    checkable = names - {"str"} and names <= {"str", "Path", *wholearm.__all__}
    return tuple(annotation.split(" | ")) if checkable else ()


def check_kinds(annotations: Mapping[str, str], arguments: Mapping[str, Any]) -> None:
    """Raise an `InputError` for the first argument whose class its annotation does not allow.

    Only annotations of public classes and paths are checked here.
    """
    for name, value in arguments.items():
        kinds = _list_kinds(annotations.get(name, "Any"))
        if kinds and not any(_fits(value, kind) for kind in kinds):
            raise InputError("", name, f"{value!r} given; allowed: {', '.join(kinds)}")


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The function with a check of the classes of its arguments (`check_kinds`)."""
    annotations = {name: p.annotation for name, p in signature(function).parameters.items()}

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        check_kinds(annotations, dict(zip(annotations, args, strict=False)) | kwargs)
        return function(*args, **kwargs)

    return run
