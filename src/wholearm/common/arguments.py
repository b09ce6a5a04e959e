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


def _fits(given: Any, kind: str) -> bool:
    """Whether a value is of a kind; tuples may be lists. Classes are told by name: imports cost."""
    if kind.startswith("tuple"):
        of, second = kind.removeprefix("tuple[").removesuffix("]").split(", ")
        right = isinstance(given, tuple | list) and (second == "..." or len(given) == 2)
        return right and all(_fits(one, of) for one in given)
    if kind in _BUILT_IN:
        return isinstance(given, _BUILT_IN[kind])
    return kind in (own.__name__ for own in type(given).__mro__)


@cache
def _list_kinds(annotation: str) -> tuple[str, ...]:
    """Kinds that an annotation of public classes and paths alone names; of others none."""
    names = {*re.findall(r"\w+", annotation)} - {"tuple", "None"}
    told = names - {"str"} and names <= {"str", "Path", *wholearm.__all__}
    return tuple(annotation.split(" | ")) if told else ()


def check_kinds(annotations: Mapping[str, str], given: Mapping[str, Any]) -> None:
    """Raise an `InputError` for the first value that is of none of the kinds of its annotation.

    Annotations that name other than public classes and paths are left to other checks.
    """
    for name, value in given.items():
        kinds = _list_kinds(annotations.get(name, "Any"))
        if kinds and not any(_fits(value, kind) for kind in kinds):
            raise InputError("", name, f"{value!r} given; allowed: {', '.join(kinds)}")


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A public function that refuses arguments of the wrong class by name."""
    annotations = {name: own.annotation for name, own in signature(function).parameters.items()}

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        check_kinds(annotations, dict(zip(annotations, args, strict=False)) | kwargs)
        return function(*args, **kwargs)

    return run
