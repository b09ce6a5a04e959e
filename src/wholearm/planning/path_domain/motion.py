"""Motion along a curve: speed and squeeze at the nodes of a grid, the rest at any instant.

Between two nodes a = s'' and the squeeze are linear in s, so b = s'^2 is quadratic and s(t) is a
hyperbolic or circular function. z, tau and the contact forces follow from s, s' and s'' by inverse
dynamics, hence the equations of motion hold at every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...geometry.curve import Curve
from ...mechanics.dynamics import Directions, inverse, split_forces
from ...results.trajectory import Samples


class Grid(NamedTuple):
    """Nodes on a curve.

    Attributes
    ----------
    s : ndarray, shape (N + 1,), [m]
        Never decreasing; equal neighbours where the curve's segments meet.
    segment : ndarray of int, shape (N + 1,)
        The segment that each node's forces belong to.
    """

    s: Array
    segment: NDArray[np.int64]

    @property
    def steps(self) -> Array:
        """Lengths of the intervals, shape (N,) [m]."""
        return np.diff(self.s)


class Profile(NamedTuple):
    """Motion at n places of a curve: a = s'' [m/s^2], b = s'^2 [m^2/s^2] and squeeze [N]."""

    a: Array
    b: Array
    squeeze: Array


@dataclass(frozen=True, eq=False)
class PathMotion:
    """A phase on a curve as a function of time, satisfying the equations of motion at any instant.

    Attributes
    ----------
    curve : Curve
    grid : Grid
    profile : Profile
        At the nodes.
    """

    curve: Curve
    grid: Grid
    profile: Profile

    @cached_property
    def times(self) -> Array:
        """When each node is passed, shape (N + 1,) [s]."""
        return np.concatenate([[0.0], np.cumsum(self.durations(np.ones(1))[:, 0])])

    def durations(self, fractions: Array) -> Array:
        """Time from each node to a fraction of the way to the next, shape (N, n) [s]."""
        h = self.grid.steps[:, None]
        a, b = self.profile.a, self.profile.b
        rise = np.diff(a)[:, None]
        run = fractions * h
        later = b[:-1, None] + run * (2 * a[:-1, None] + fractions * rise)
        # Rounding would cost the run to rest the square root of its digits.
        later = np.where(fractions == 1.0, b[1:, None], later)
        speeds = np.sqrt(b[:-1, None]) + np.sqrt(np.maximum(later, 0.0))
        some = run > 0
        speeds = np.where(some, speeds, 1.0)
        slope = np.divide(rise, h, out=np.zeros_like(rise), where=h > 0)
        # s'' linear in s makes the mean speed that of the ends times tanh(y) / y.
        return np.asarray(2 * run / speeds * arctanh_ratio(slope * (run / speeds) ** 2))

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return float(self.times[-1])

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.curve.formation.names

    def locate(self, t: Array) -> tuple[Array, NDArray[np.int64], Profile]:
        """Arc length [m], segment and profile at times `t`, each of shape (n,)."""
        nonempty = np.flatnonzero(self.grid.steps > 0)
        k = nonempty[np.clip(np.searchsorted(self.times[nonempty], t, side="right") - 1, 0, None)]
        h, a, b, squeeze = self.grid.steps[k], *self.profile
        local = np.clip(t, 0.0, self.duration) - self.times[k]
        slope = (a[k + 1] - a[k]) / h
        speed = np.sqrt(b[k])
        x = slope * local**2
        run = local * (speed * sinh_ratio(x) + a[k] * local * cosh_ratio(x))
        run = np.clip(run, 0.0, h)
        part = run / h
        # The speed as a function of time: that of the place would lose half its digits near rest.
        speed = speed * (1 + x * cosh_ratio(x)) + a[k] * local * sinh_ratio(x)
        here = Profile(
            a[k] + slope * run,
            np.maximum(speed, 0.0) ** 2,
            squeeze[k] + part * (squeeze[k + 1] - squeeze[k]),
        )
        return self.grid.s[k] + run, self.grid.segment[k], here

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        s, segment, (a, b, squeeze) = self.locate(np.asarray(t, dtype=float))
        point = self.curve.evaluate(s)
        directions = directions_of(self.curve, segment)
        formation = self.curve.formation
        forces = inverse(formation, *point[:3], directions, point.kinematics)
        c_n, c_t = split_forces(formation, forces.c(a, b, squeeze), directions.Xi)
        return Samples(
            point.z,
            point.z_s * np.sqrt(b)[:, None],
            point.z_s * a[:, None] + point.z_ss * b[:, None],
            forces.tau(a, b, squeeze),
            c_n,
            c_t,
        )


def make_grid(curve: Curve, intervals: int) -> Grid:
    """Grid of a curve, fine towards the ends (where the motion is slow) and split at reversals.

    Parameters
    ----------
    curve : Curve
    intervals : int
        In all, one of length zero for each place where two segments meet.
    """
    ends = np.array([0.0, *(segment.stop for segment in curve.segments)])
    angles = np.arccos(1 - 2 * np.clip(ends / curve.length, 0.0, 1.0))
    nonempty = intervals - (len(ends) - 2)
    # Halves go up whatever their last bit is.
    counts = np.maximum(1, np.floor(np.diff(angles) / np.pi * nonempty + 0.5 + 1e-6).astype(int))
    while counts.sum() != nonempty:
        counts[np.argmax(counts)] += np.sign(nonempty - counts.sum())
    nodes = []
    for index, count in enumerate(counts):
        angle = np.linspace(angles[index], angles[index + 1], count + 1)
        s = curve.length * (1 - np.cos(angle)) / 2
        s[0], s[-1] = ends[index], ends[index + 1]
        nodes.append(s)
    return Grid(np.concatenate(nodes), np.repeat(np.arange(len(counts)), counts + 1))


def redistribute_nodes(grid: Grid, nonempty: NDArray[np.int64], misses: Array) -> Grid:
    """Move nodes into the solid intervals whose `misses` exceed 1, keeping those of each segment.

    A miss falls with the square of the interval, so its root says how many parts are wanted; four
    are enough, as the limits are tightened afterwards.
    """
    wanted = np.ones(len(grid.steps))
    wanted[nonempty] = np.clip(np.sqrt(misses), 1.0, 4.0)
    s = grid.s.copy()
    for segment in range(int(grid.segment[-1]) + 1):
        mine = np.flatnonzero(grid.segment == segment)
        parts = np.concatenate([[0.0], np.cumsum(wanted[mine[:-1]])])
        s[mine] = np.interp(np.linspace(0.0, parts[-1], len(mine)), parts, grid.s[mine])
    return Grid(s, grid.segment)


def directions_of(curve: Curve, segment: NDArray[np.int64]) -> Directions:
    """Directions at n places, given the segment that each belongs to."""
    Xi = np.array([part.Xi for part in curve.segments])
    sigma = np.array([part.sigma for part in curve.segments])
    return Directions(Xi[segment], sigma[segment])


def arctanh_ratio(x: Array) -> Array:
    """Return artanh(sqrt(x)) / sqrt(x), which is arctan(sqrt(-x)) / sqrt(-x) for x < 0."""
    root = np.sqrt(np.abs(x))
    small = root < 1e-3
    safe = np.where(small, 0.5, root)
    capped = np.minimum(safe, 1 - 1e-16)
    ratio = np.where(x > 0, np.arctanh(capped), np.arctan(safe)) / safe
    return np.where(small, 1 + x / 3 + x**2 / 5, ratio)


def sinh_ratio(x: Array) -> Array:
    """Return sinh(sqrt(x)) / sqrt(x), which is sin(sqrt(-x)) / sqrt(-x) for x < 0."""
    root = np.sqrt(np.abs(x))
    small = root < 1e-2
    safe = np.where(small, 1.0, root)
    ratio = np.where(x > 0, np.sinh(safe), np.sin(safe)) / safe
    return np.where(small, 1 + x / 6 * (1 + x / 20 * (1 + x / 42)), ratio)


def cosh_ratio(x: Array) -> Array:
    """Return (cosh(sqrt(x)) - 1) / x, which is 1/2 at zero."""
    return sinh_ratio(x / 4) ** 2 / 2
