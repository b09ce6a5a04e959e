"""Arguments of public functions, and fields, checked against the classes of their annotations."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable, Mapping
from functools import cache, wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import wholearm

from .errors import InputError

_T = TypeVar("_T")
_P = ParamSpec("_P")
_BUILT_IN: dict[str, Any] = {"str": str, "Path": os.PathLike, "PathLike": os.PathLike}
_BUILT_IN |= {"tuple": tuple | list, "Mapping": Mapping, "Callable": Callable}
_CLASSES = {*wholearm.__all__, "Figure", "Route"}


def _fits(value: Any, kind: ast.expr) -> bool:
    """Whether a value is of a kind, by names of classes: nothing is imported. Lists are tuples.

    Every value is of a kind that is not known here, such as a number.
    """
    match kind:
        case ast.Constant(None):
            return value is None
        case ast.BinOp(one, _, other):
            return _fits(value, one) or _fits(value, other)
        case ast.Subscript(ast.Name("tuple"), ast.Tuple([item, last])) if _fits(value, kind.value):
            kinds = [item, last] if isinstance(last, ast.Name) else [item] * len(value)
            return len(kinds) == len(value) and all(map(_fits, value, kinds))
        case ast.Subscript(ast.Name("Sequence"), item):
            indexed = hasattr(value, "__getitem__") and not isinstance(value, str | bytes | Mapping)
            return indexed and all(_fits(each, item) for each in value)
        case ast.Subscript(ast.Name("Mapping"), ast.Tuple([key, item])) if _fits(value, kind.value):
            return all(_fits(k, key) and _fits(each, item) for k, each in value.items())
        case ast.Subscript(head):
            return _fits(value, head)
        case ast.Name(name) | ast.Attribute(attr=name):
            if name in _BUILT_IN:
                return isinstance(value, _BUILT_IN[name])
            classes = (ancestor.__name__ for ancestor in type(value).__mro__)
            return name not in _CLASSES or name in classes
    return True


@cache
def _list_kinds(annotation: str) -> tuple[ast.expr, ...]:
    """Alternatives of an annotation; none for text alone, which is one of several words."""
    kinds, first = list[ast.expr](), ast.parse(annotation, mode="eval").body
    while isinstance(first, ast.BinOp):
        kinds, first = [first.right, *kinds], first.left
    return () if annotation == "str" else (first, *kinds)


def check_kinds(annotations: Mapping[str, str], arguments: Mapping[str, Any]) -> None:
    """Raise an `InputError` for the first argument whose class its annotation does not allow.

    Public classes, paths, lists, mappings and functions are checked here, numbers where their
    ranges are known.
    """
    for name, value in arguments.items():
        kinds = _list_kinds(annotations.get(name, "Any"))
        if kinds and not any(_fits(value, kind) for kind in kinds):
            allowed = ", ".join(map(ast.unparse, kinds))
            raise InputError("", name, f"{value!r} given; allowed: {allowed}")


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """The function with a check of the classes of its arguments (`check_kinds`)."""
    parameters = signature(function).parameters.items()
    annotations = {k: "Any" if p.annotation is p.empty else p.annotation for k, p in parameters}

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        check_kinds(annotations, dict(zip(annotations, args, strict=False)) | kwargs)
        return function(*args, **kwargs)

    return run
