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
from ...geometry.curve import Curve, CurvePoint, directions_of
from ...mechanics.dynamics import inverse
from ...mechanics.limits import make_limits
from ...mechanics.path_limits import PathLimits

GIVE = 2.5e-7  # relaxation of limits over their scales: a plan may violate them as much


class PathGrid(NamedTuple):
    """Angles of N + 1 nodes, and the segment that each of the N intervals belongs to."""

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
    def pieces(self) -> tuple[tuple[int, int, float, float], ...]:
        """Each segment: its curve, its number there, and its start and stop on the path [m]."""
        return tuple(
            (index, number, offset + part.start, offset + part.stop)
            for index, (curve, offset) in enumerate(zip(self.curves, self.offsets, strict=False))
            for number, part in enumerate(curve.segments)
        )

    def place(self, angles: Array) -> Array:
        """Places along the path at some angles [m]."""
        return np.asarray(self.length * np.sin(angles / 2) ** 2)

    def make_grid(self, intervals: int) -> PathGrid:
        """A grid of about so many intervals, with nodes wherever segments meet."""
        stops = np.array([0.0, *(stop for *_, stop in self.pieces)])
        ends = np.arccos(np.clip(1 - 2 * stops / self.length, -1, 1))
        counts = np.maximum(2, np.rint(np.diff(ends) / np.pi * intervals)).astype(np.int64)
        return PathGrid(ends, np.arange(len(counts))).split(counts)

    def evaluate(self, angles: Array, owners: NDArray[np.int64]) -> PathLimits:
        """Limits without lambda at angles (N, n), each row of them as part of a segment."""
        s, parts = self.place(angles), []
        owner, number, start, stop = np.array(self.pieces)[owners].T[..., None]
        for index, (curve, offset) in enumerate(zip(self.curves, self.offsets, strict=False)):
            mine = owner[:, 0] == index
            local = np.clip(s[mine], start[mine], stop[mine]) - offset
            point = curve.evaluate(np.clip(local.ravel(), 0.0, curve.length))
            segment = np.repeat(number[mine].astype(np.int64), angles.shape[1])
            parts.append(find_limits(curve, self.epsilon, point, segment))
        rows, cap = (np.concatenate(column) for column in zip(*parts, strict=True))
        return PathLimits(rows.reshape(*s.shape, *rows.shape[1:]), cap.reshape(s.shape))


def find_limits(
    curve: Curve, epsilon: float, point: CurvePoint, segment: NDArray[np.int64]
) -> PathLimits:
    """Limits without lambda at n places of a curve, each as part of a segment; see `GIVE`."""
    directions = directions_of(curve, segment)
    forces = inverse(curve.formation, *point[:3], directions, point.kinematics)
    limits = make_limits(curve.formation, epsilon)
    return PathLimits.of(limits, forces, point.z_s[:, 3:], GIVE).eliminate()
