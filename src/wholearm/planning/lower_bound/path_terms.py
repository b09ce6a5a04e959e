"""Limits along one or more curves joined to a path, and grids on it that are fine at its ends.

Places are given by an angle from 0 to pi: s = length (1 - cos angle) / 2. Near rest the speed is
proportional to the root of s, and so is the angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...geometry.curve import Curve
from .rows import PathLimitRows, evaluate_rows


class PathPiece(NamedTuple):
    """A segment of one of the curves, from `start` to `stop` along all of them [m]."""

    curve: int
    segment: int
    start: float
    stop: float


class PathGrid(NamedTuple):
    """Angles of N + 1 nodes, and the piece that each of the N intervals belongs to."""

    angles: Array
    owners: NDArray[np.int64]

    def split(self, parts: NDArray[np.int64]) -> PathGrid:
        """Split every interval into a number of parts, shape (N,)."""
        owner = np.repeat(np.arange(len(parts)), parts)
        place = np.arange(len(owner)) - (np.cumsum(parts) - parts)[owner]
        angles = self.angles[owner] + np.diff(self.angles)[owner] * (place / parts[owner])
        return PathGrid(np.append(angles, self.angles[-1]), self.owners[owner])


@dataclass(frozen=True, eq=False)
class PathTerms:
    """Curves that are run through one after the other at speed."""

    curves: Sequence[Curve]  # with speed ratios that make the speed continuous
    epsilon: float  # [N]

    @cached_property
    def offsets(self) -> Array:
        """Where each curve starts, and the length of all, shape (n + 1,) [m]."""
        return np.cumsum([0.0, *(curve.length for curve in self.curves)])

    @property
    def length(self) -> float:
        """Length of all curves [m]."""
        return float(self.offsets[-1])

    @cached_property
    def pieces(self) -> tuple[PathPiece, ...]:
        """The segments of all curves."""
        return tuple(
            PathPiece(index, number, offset + part.start, offset + part.stop)
            for index, (curve, offset) in enumerate(zip(self.curves, self.offsets, strict=False))
            for number, part in enumerate(curve.segments)
        )

    def place(self, angles: Array) -> Array:
        """Places along the path at some angles [m]."""
        return np.asarray(self.length * np.sin(angles / 2) ** 2)

    def make_grid(self, intervals: int) -> PathGrid:
        """A grid of about so many intervals, with nodes wherever pieces meet."""
        stops = np.array([0.0, *(piece.stop for piece in self.pieces)])
        ends = np.arccos(np.clip(1 - 2 * stops / self.length, -1, 1))
        counts = np.maximum(2, np.rint(np.diff(ends) / np.pi * intervals)).astype(np.int64)
        return PathGrid(ends, np.arange(len(counts))).split(counts)

    def evaluate(self, angles: Array, owners: NDArray[np.int64]) -> PathLimitRows:
        """Limits at angles of shape (N, n), each row of them as part of a piece."""
        s, shape = self.place(angles), angles.shape
        parts = []
        for index, curve in enumerate(self.curves):
            mine = np.array([piece.curve == index for piece in self.pieces])[owners]
            pieces = [self.pieces[k] for k in owners[mine]]
            low, high = (np.array([[piece[k]] for piece in pieces]) for k in (2, 3))
            local = np.clip(s[mine], low, high) - self.offsets[index]
            segment = np.repeat([piece.segment for piece in pieces], shape[1])
            local = np.clip(local.ravel(), 0.0, curve.length)
            parts.append(evaluate_rows(curve, self.epsilon, local, segment))
        stacked = (np.concatenate(column) for column in zip(*parts, strict=True))
        return PathLimitRows(*(column.reshape(*shape, *column.shape[1:]) for column in stacked))
