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
_SCALARS: dict[str, Any] = {
    "None": type(None), "bool": bool, "str": str, "int": Integral, "float": Real
}  # fmt: skip
_TYPES = _SCALARS | {
    "os.PathLike": os.PathLike, "Path": os.PathLike, "Callable": Callable, "Mapping": Mapping,
    "Sequence": Iterable,
}  # fmt: skip
# Protocols: an attribute that tells them, and what is public and has it.
_PROTOCOLS = {"Moved": ("trajectory", "Plan, Simulation, Report"), "Law": ("held", "Policy")}
_TUPLE = re.compile(r"tuple\[(\w+), (\w+|\.\.\.)\]")


def _fits(given: Any, kind: str) -> bool:
    if items := _TUPLE.fullmatch(kind):
        right = isinstance(given, tuple | list) and all(_fits(one, items[1]) for one in given)
        return right and (items[2] == "..." or len(given) == 2)
    if kind in _PROTOCOLS:
        return _PROTOCOLS[kind][0] in dir(given)
    if isinstance(given, bool) or (kind == "Sequence" and isinstance(given, str | Mapping)):
        return kind == "bool"
    if kind in _TYPES:
        return isinstance(given, _TYPES[kind])
    return kind in (own.__name__ for own in type(given).__mro__)


@lru_cache(maxsize=256)
def _split(annotation: str) -> tuple[str, ...]:
    """The kinds that an annotation names, none if it allows what is not told by a name."""
    text = re.sub(r"\bTorques\b", "TorqueProfile | Trajectory | Moved", annotation)
    while "[" in text and not _TUPLE.search(text):
        text = re.sub(r"\[[^][]*\]", "", text)
    kinds = tuple(text.split(" | "))
    return () if _ANY & {*kinds} else kinds


def check_kinds(
    annotations: Mapping[str, str], given: Mapping[str, Any], *, scalars: bool = False
) -> None:
    """Raise an `InputError` for the first value that is none of the kinds of its annotation.

    Values that may only be `scalars` are left to checks that know their range, unless it is said.
    """
    for name, value in given.items():
        kinds = _split(annotations.get(name, "Any"))
        left = not kinds or (not scalars and {*kinds} <= _SCALARS.keys())
        if not left and not any(_fits(value, kind) for kind in kinds):
            allowed = ", ".join(_PROTOCOLS.get(kind, ("", kind))[1] for kind in kinds)
            raise InputError("", name, f"{value!r} given; allowed: {allowed}")


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A public function that names arguments of a wrong kind; scalars where it fails by them."""
    every = signature(function).parameters.items()
    known = {name: own.annotation for name, own in every if "*" not in str(own)}

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
