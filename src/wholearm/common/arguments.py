"""Arguments checked against their annotations, which are text: classes are told by their names."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, wraps
from inspect import signature
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

from .errors import InputError

_T = TypeVar("_T")
_P = ParamSpec("_P")

_ANY = {"Any", "Array", "ArrayLike", "Literal", "Planner", "object"}  # have checks of their own
_SCALARS = {"None", "bool", "float", "int", "str"}
_ALIASES = {"Torques": "TorqueProfile | Trajectory | Moved"}
_SEVERAL = re.compile(r"tuple\[(\w+), (\w+|\.\.\.)\]")
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "None": ("None", lambda given: given is None),
    "bool": ("True, False", lambda given: isinstance(given, bool)),
    "str": ("a string", lambda given: isinstance(given, str)),
    "int": (
        "a whole number",
        lambda given: isinstance(given, Integral) and not isinstance(given, bool),
    ),
    "float": ("a number", lambda given: isinstance(given, Real) and not isinstance(given, bool)),
    "os.PathLike": ("a path", lambda given: isinstance(given, os.PathLike)),
    "Path": ("a path", lambda given: isinstance(given, os.PathLike)),
    "Callable": ("a function", callable),
    "Mapping": ("a mapping", lambda given: isinstance(given, Mapping)),
    "Sequence": (
        "a list",
        lambda given: isinstance(given, Iterable) and not isinstance(given, str | Mapping),
    ),
    "Moved": ("what has a trajectory", lambda given: "trajectory" in dir(given)),
    "Law": ("a policy", lambda given: hasattr(given, "held")),
}


def _fits(given: Any, kind: str) -> bool:
    if several := _SEVERAL.fullmatch(kind):
        right = isinstance(given, tuple | list) and all(_fits(one, several[1]) for one in given)
        return right and (several[2] == "..." or len(given) == 2)
    if kind in _KINDS:
        return _KINDS[kind][1](given)
    return kind in (own.__name__ for own in type(given).__mro__)


def _describe(kind: str) -> str:
    if several := _SEVERAL.fullmatch(kind):
        return f"{'several' if several[2] == '...' else 'two'} {several[1]}"
    return _KINDS.get(kind, (kind,))[0]


@lru_cache(maxsize=256)
def _split(annotation: str) -> tuple[str, ...]:
    """The kinds that an annotation names, none if it allows what is not told by a name."""
    for alias, meaning in _ALIASES.items():
        annotation = re.sub(rf"\b{alias}\b", meaning, annotation)
    if not _SEVERAL.search(annotation):
        while "[" in annotation:
            annotation = re.sub(r"\[[^][]*\]", "", annotation)
    kinds = tuple(annotation.split(" | "))
    return () if _ANY & {*kinds} else kinds


def check_kinds(
    annotations: Mapping[str, str], given: Mapping[str, Any], *, scalars: bool = False
) -> None:
    """Raise an `InputError` for the first value that is none of the kinds of its annotation.

    Values that may only be `scalars` are left to checks that know their range, unless it is said.
    """
    for name, value in given.items():
        kinds = _split(annotations.get(name, "Any"))
        if kinds and (scalars or not _SCALARS.issuperset(kinds)):
            if not any(_fits(value, kind) for kind in kinds):
                allowed = ", ".join(dict.fromkeys(map(_describe, kinds)))
                raise InputError("", name, f"{value!r} given; allowed: {allowed}")


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A public function that names arguments of a wrong kind; scalars where it fails by them."""
    known = {
        name: each.annotation
        for name, each in signature(function).parameters.items()
        if each.kind is not each.VAR_POSITIONAL and each.kind is not each.VAR_KEYWORD
    }

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        given = {**dict(zip(known, args, strict=False)), **kwargs}
        check_kinds(known, given)
        try:
            return function(*args, **kwargs)
        except (AttributeError, TypeError, ValueError):
            check_kinds(known, given, scalars=True)
            raise

    return run
