"""Drawing on a sheet of SVG whose axes are x and phi: shapes as text, nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags

SHEET = (1000.0, 620.0)
"""Width and height of the drawing, in its own units; texts are 11 of these high."""
BOX = (58.0, 44.0, 868.0, 566.0)
"""The axes: left, bottom, width, height."""


class Paper(NamedTuple):
    """What part of the plane the axes show.

    Attributes
    ----------
    low, high : ndarray, shape (2,), [mm, deg]
    """

    low: Array
    high: Array

    @property
    def scale(self) -> Array:
        """Units of the drawing per mm and per deg, shape (2,)."""
        return np.array(BOX[2:]) / (self.high - self.low)

    def place(self, points: Array) -> Array:
        """Places, shape (n, 2), of points (x, phi) [m, rad], the second coordinate upwards."""
        values = np.column_stack([1e3 * points[:, 0], np.degrees(points[:, 1])])
        return np.asarray(np.array(BOX[:2]) + (values - self.low) * self.scale)


def turn(points: Array) -> Array:
    """The same places with the second coordinate downwards, as SVG has it."""
    return np.column_stack([points[:, 0], SHEET[1] - points[:, 1]])


def write_path(lines: Iterable[Array], closed: bool = False) -> str:
    """What a path of polylines, each of shape (n, 2), draws."""
    return "".join(f"M{_join(line)}{'z' if closed else ''}" for line in lines)


def write_line(line: Array) -> str:
    """A polyline's points."""
    return _join(line)


def write_text(text: str, place: Iterable[float], look: str = "") -> str:
    """A text at a place, the second coordinate upwards."""
    x, y = place
    return f'<text x="{x:.1f}" y="{SHEET[1] - y:.1f}"{look}>{escape(text)}</text>'


def write_region(region: Flags, x: Array, y: Array) -> str:
    """The path around the places of a grid in a region, row by row; `x` and `y` are even."""
    step, height = x[1] - x[0], y[1] - y[0]
    edges = np.diff(np.pad(region.astype(int), ((0, 0), (1, 1))), axis=1)
    (rows, starts), stops = np.nonzero(edges == 1), np.nonzero(edges == -1)[1]
    lefts, widths = x[0] + (starts - 0.5) * step, (stops - starts) * step
    return "".join(
        f"M{left:.1f} {SHEET[1] - y[row] - height / 2:.1f}h{width:.1f}v{height:.1f}h{-width:.1f}z"
        for row, left, width in zip(rows.tolist(), lefts.tolist(), widths.tolist(), strict=True)
    )


def choose_ticks(low: float, high: float, most: int) -> list[float]:
    """Round values between two, at most so many."""
    power = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(k * power for k in (1, 2, 5, 10) if k * power * most >= high - low)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _join(line: Array) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in turn(line).tolist())
