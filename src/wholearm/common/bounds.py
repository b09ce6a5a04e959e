"""Ranges of options: those of the planner, and what checks any."""

from __future__ import annotations

from typing import NamedTuple

from .errors import InputError


class Bounds(NamedTuple):
    """Least and greatest value of an option, both allowed; whole numbers are given as such."""

    low: float
    high: float

    @property
    def whole(self) -> bool:
        """Whether only whole numbers are allowed."""
        return isinstance(self.low, int)

    def describe(self, given: object) -> str:
        """What is wrong with a value; empty if nothing is."""
        kinds = (int,) if self.whole else (int, float)
        known = isinstance(given, kinds) and not isinstance(given, bool)
        if known and self.low <= given <= self.high:  # type: ignore[operator]
            return ""
        low, high = (f"{own}" if self.whole else f"{own:g}" for own in self)
        kind = "whole numbers from " if self.whole else ""
        return f"{given!r} given; allowed are {kind}{low} to {high}"

    def read(self, text: str) -> float:
        """The value of an option on the command line."""
        value: float | str
        try:
            value = int(text) if self.whole else float(text)
        except ValueError:
            value = text
        if wrong := self.describe(value):
            from argparse import ArgumentTypeError

            raise ArgumentTypeError(wrong)
        return value  # type: ignore[return-value]

    def check(self, key: str, given: object) -> None:
        """Raise an `InputError` that names `key` if a value is out of its range."""
        if text := self.describe(given):
            raise InputError("", key, text)


PLANNER = {
    "intervals": Bounds(10, 5000),
    "samples": Bounds(2, 100_000),
    "time_intervals": Bounds(4, 1000),
    "degree": Bounds(2, 6),
    "accuracy": Bounds(1e-8, 0.1),
    "duration": Bounds(1e-9, 1e9),
    "time_weight": Bounds(1e-30, 1e30),
    "opening": Bounds(0.0, 100.0),
    "clearance": Bounds(0.0, 1.0),
    "robust": Bounds(0.0, 1000.0),
}
"""Options of the planner by name. What is more than these takes memory or hours for nothing."""
