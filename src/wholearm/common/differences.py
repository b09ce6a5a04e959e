"""Where two nested tables differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any, NamedTuple

_SHOWN = 3
"""Differences that are written out; the others are counted."""


class Difference(NamedTuple):
    """A key with two values, as text; `nothing` where one table does not have it."""

    key: str
    one: str
    other: str


def find_differences(
    one: Any, other: Any, free: tuple[str, ...] = (), key: str = ""
) -> Iterator[Difference]:
    """The keys in which two nested tables differ, in their order.

    Parameters
    ----------
    one, other : object
        Mappings, lists, and what they hold.
    free : tuple of str
        Names, at any depth, in which they may differ; only at the top if they begin with a dot.
    key : str
        Of the tables themselves.
    """
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in dict.fromkeys([*one, *other]):
            if name in free or (not key and f".{name}" in free):
                continue
            inner = f"{key}.{name}" if key else str(name)
            yield from find_differences(one.get(name), other.get(name), free, inner)
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple):
        if len(one) != len(other):
            yield Difference(key, f"{len(one)} entries", f"{len(other)}")
            return
        for k, pair in enumerate(zip(one, other, strict=True), start=1):
            yield from find_differences(*pair, free, f"{key}[{k}]")
    elif one != other:
        yield Difference(key, _write(one), _write(other))


def _write(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    if isinstance(value, float):
        text = f"{value:.12g}"
    return text if len(text) <= 40 else f"{text[:37]}..."


def describe_differences(found: Iterator[Difference], one: str, other: str) -> str:
    """The first differences in words; `one` and `other` say where the values stand."""
    shown = list(islice(found, _SHOWN))
    rest = sum(1 for _ in found)
    parts = [f"{own.key} ({own.one} {one}, {own.other} {other})" for own in shown]
    return ", ".join(parts) + (f", and {rest} more" if rest else "")
