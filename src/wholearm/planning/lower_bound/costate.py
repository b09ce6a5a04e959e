"""The costate p of a fastest motion: by how much the time falls with b = s'^2, at each place.

Where the largest or the least a is used and its slope over b is k, p' = -1/(2 v^3) - 2 k p. It is
zero where the motion switches from the largest to the least a, and followed from there to both
sides, up to rest or to where b meets a limit of its own. At rest it grows without bound like the
inverse of the angle, so y = p sin(angle) is what is integrated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .rows import Extreme, Rows
from .sweep import Mode, Sweep
from .way import Grid, Way

_NEAR = 6
"""Intervals from a switch within which a row that it turns about is looked for."""
_STIFF = 4.0
"""Growth in an interval from which on the trapezoidal rule is left for the exponential one."""


class Costate(NamedTuple):
    """y = p sin(angle) at the two ends of each interval, and its slopes there, (N, 2) each."""

    y: Array
    slopes: Array

    def interpolate(self, way: Way, grid: Grid, fractions: Array) -> tuple[Array, Array]:
        """The costate p and p' = dp/ds at `fractions` of every interval, shape (N, n)."""
        t, h = fractions, np.diff(grid.angles)[:, None]
        (start, stop), (first, last) = self.y.T[..., None], h * self.slopes.T[..., None]
        rise = stop - start
        bow = first + last - 2 * rise
        y = start + t * (first + t * (rise - first - bow + t * bow))
        y_t = first + t * (2 * (rise - first - bow) + 3 * t * bow)
        # No sign but those at the ends: only one side of a is extreme there.
        wrong = ((y > 0) & (self.y.max(axis=1) <= 0)[:, None]) | (
            (y < 0) & (self.y.min(axis=1) >= 0)[:, None]
        )
        plain = wrong.any(axis=1)
        y[plain], y_t[plain] = (start + t * rise)[plain], rise[plain]
        angles = grid.angles[:-1, None] + t * h
        sine = np.sin(angles)
        p_angle = (y_t / h - y / np.tan(angles)) / sine
        return y / sine, p_angle / (way.length / 2 * sine)

    def jumps(self, grid: Grid) -> Array:
        """By how much p falls at each inner node, shape (N - 1,)."""
        return np.asarray((self.y[:-1, 1] - self.y[1:, 0]) / np.sin(grid.angles[1:-1]))


def find_costate(way: Way, grid: Grid, left: Rows, right: Rows, found: Sweep) -> Costate:
    """The costate of a motion, from the limits at the left and right ends of intervals."""
    b, modes = found.b, found.modes.copy()
    pushes, brakes = (
        (left.extreme(b[:-1], largest), right.extreme(b[1:], largest)) for largest in (True, False)
    )
    y = np.zeros((len(modes), 2))
    for k in np.flatnonzero(modes == Mode.SWITCH).tolist():
        pushed, braked = float(pushes[0].a[k]), float(brakes[1].a[k])
        turn = _find_turn(left, right, int(brakes[1].row[k]), k)
        if turn is not None:
            low, high = min(k, turn[0]), max(k, turn[0])
            modes[low : high + 1] = Mode.PUSH
            modes[turn[0] + 1 : high + 1] = Mode.BRAKE
            modes[turn[0]] = Mode.SWITCH
        index = k if turn is None else turn[0]
        y[index] = _switch(way, grid, left, right, b, (pushed, braked), index, turn)
    rates, forces = _linearise(way, grid, b, modes, pushes, brakes)
    ends = float(pushes[0].a[0]), float(brakes[1].a[-1])
    _integrate(way, grid, modes, rates, forces, ends, y)
    slopes = np.where((modes == Mode.HELD)[:, None], 0.0, forces + rates * y)
    # At rest only the value is known.
    secant = np.diff(y, axis=1)[:, 0] / np.diff(grid.angles)
    slopes[0, 0] = 2 * secant[0] - slopes[0, 1]
    slopes[-1, 1] = 2 * secant[-1] - slopes[-1, 0]
    return Costate(y, slopes)


def _find_turn(left: Rows, right: Rows, row: int, k: int) -> tuple[int, int] | None:
    """The interval near k in which a row turns from a bound above a to one below, and that row.

    There the motion runs along that row on both sides, and the costate is zero where it turns.
    """
    near = np.arange(max(k - _NEAR, 0), min(k + _NEAR + 1, len(left.cap)))
    turns = near[(left.a[near, row] < 0) & (right.a[near, row] >= 0)]
    return (int(turns[np.abs(turns - k).argmin()]), row) if len(turns) else None


def _switch(
    way: Way,
    grid: Grid,
    left: Rows,
    right: Rows,
    b: Array,
    extremes: tuple[float, float],
    k: int,
    turn: tuple[int, int] | None,
) -> Array:
    """The costate, y, at both ends of the interval k with a switch, shape (2,)."""
    start, stop = way.place(grid.angles[k : k + 2])
    (before, after), h = b[k : k + 2], stop - start
    if turn is None:
        pushed, braked = extremes
        x = np.clip((after - before - 2 * braked * h) / (2 * (pushed - braked)), 0.0, h)
        rate = 0.5 * max(before + 2 * pushed * x, before, after) ** -1.5
    else:
        row, most = turn[1], max(before, after)
        x = h * left.a[k, row] / (left.a[k, row] - right.a[k, row])
        pull = left.b[k, row] + left.v[k, row] / (2 * np.sqrt(most))
        rate = 0.5 * most**-1.5 / (1 - 2 * pull * h / (right.a[k, row] - left.a[k, row]))
    return np.asarray(rate * np.array([x, x - h]) * np.sin(grid.angles[k : k + 2]))


def _linearise(
    way: Way,
    grid: Grid,
    b: Array,
    modes: NDArray[np.int64],
    pushes: tuple[Extreme, Extreme],
    brakes: tuple[Extreme, Extreme],
) -> tuple[Array, Array]:
    """Rates and forces of dy/dangle = force + rate y at both ends of the intervals, (N, 2) each."""
    slope, switches = np.zeros((len(modes), 2)), modes == Mode.SWITCH
    for mode, extremes, switched in ((Mode.PUSH, pushes, 0), (Mode.BRAKE, brakes, 1)):
        for end in range(2):
            used = (modes == mode) | (switches if end == switched else False)
            slope[used, end] = extremes[end].slope[used]
    angles = np.column_stack([grid.angles[:-1], grid.angles[1:]])
    speed = np.sqrt(np.column_stack([b[:-1], b[1:]]))
    inner = speed > 0
    sine, stretch = np.sin(angles), way.length / 2 * np.sin(angles)
    force = np.zeros(slope.shape)
    force[inner] = -(stretch * sine)[inner] / (2 * speed[inner] ** 3)
    rate = np.zeros(slope.shape)
    rate[inner] = 1 / np.tan(angles[inner]) - 2 * slope[inner] * stretch[inner]
    return rate, force


def _integrate(
    way: Way,
    grid: Grid,
    modes: NDArray[np.int64],
    rates: Array,
    forces: Array,
    ends: tuple[float, float],
    y: Array,
) -> None:
    """Follow y from switches and held stretches, back where pushed and forth where braked."""
    h, last = np.diff(grid.angles), len(modes) - 1
    at_rest = [np.sign(a) / (2 * abs(a) * np.sqrt(abs(a) * way.length / 2)) for a in ends]
    for mode, order, near, far in (
        (Mode.PUSH, range(last, -1, -1), 1, 0),
        (Mode.BRAKE, range(last + 1), 0, 1),
    ):
        step = far - near
        for k in order:
            if modes[k] != mode:
                continue
            beside = k - step
            goes_on = 0 <= beside <= last and modes[beside] in (mode, Mode.SWITCH)
            y[k, near] = y[beside, far] if goes_on else 0.0
            if k == (last if far else 0):
                y[k, far] = at_rest[far]
            else:
                y[k, far] = _follow(
                    float(y[k, near]), step * h[k], forces[k, [near, far]], rates[k, [near, far]]
                )


def _follow(y: float, h: float, force: Array, rate: Array) -> float:
    """One step of y' = force + rate y from the first to the second of two places."""
    if np.abs(rate * h).max() < _STIFF:
        return float((y + h / 2 * (force.sum() + rate[0] * y)) / (1 - h / 2 * rate[1]))
    growth = float(np.clip(h * rate.mean(), -60, 60))
    return float(y * np.exp(growth) + h * force.mean() * np.expm1(growth) / growth)
