"""A lower bound of the least time from rest to rest along curves, with an estimate of its error.

A sweep finds about the fastest motion, the costate of that motion gives the bound, and the grid is
refined where the bound loses most. How near the motion is to the fastest one matters to second
order only, and never to whether the bound is one. What has an error is the quadrature.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.curve import Curve
from .costate import find_costate
from .dual import evaluate, find_least
from .rows import Rows
from .sweep import NoMotionError, Sweep, add_up, find_fastest, find_steady
from .way import Grid, Way

_TOLERANCE = 3e-8
"""What the bound may lose, and its error, relative to the time."""
GRID_INTERVALS = 100
"""Of the first grid."""
_ROUNDS = 16
"""Most grids: where motions hardly pass a place losses fall by 64 from one to the next."""
_NARROW, _PARTS, _TRIES = 2, 4, 4
"""Intervals on each side of the one that no motion passes which are split, into how many, and how
often: the border of an octagon's flip is passed at a tenth of the speed beside it."""
_MOST = 1500
"""Most intervals."""
_SAFETY = 2.0
"""Factor on the difference of two rules of quadrature; where limits take turns both err alike."""

_RULES = tuple(np.polynomial.legendre.leggauss(count) for count in (2, 3))
_PLACES = np.concatenate([[0.0, 0.5, 1.0], *((1 + nodes) / 2 for nodes, _ in _RULES)])
"""Left end, middle, right end and the nodes of both rules in an interval."""


class LowerBound(NamedTuple):
    """A lower bound of the least time.

    Attributes
    ----------
    value : float, [s]
        The bound, less the estimate of its error.
    error : float, [s]
        That estimate: of the quadrature, by rules of two orders.
    """

    value: float
    error: float


class _Round(NamedTuple):
    """The bound on a grid, what each interval may lose, (N,) [s], and the motion it is from."""

    bound: LowerBound
    losses: Array
    motion: Sweep
    time: float


def bound_least_time(curves: Sequence[Curve], epsilon: float) -> LowerBound | None:
    """Bound the time of motions along curves from below; None where no motion is found.

    Parameters
    ----------
    curves : sequence of Curve
        With such speed ratios that the speed is the same on both sides of where two of them meet.
    epsilon : float, [N]
        Least normal force.
    """
    way = Way(curves, epsilon)
    grid, near, found, tries = way.make_grid(GRID_INTERVALS), None, None, 0
    for _ in range(_ROUNDS):
        try:
            found = _bound(way, grid, near)
        except NoMotionError as error:
            tries += 1
            if tries > _TRIES:
                break
            parts = np.ones(len(grid.owners), dtype=np.int64)
            parts[max(error.interval - _NARROW, 0) : error.interval + _NARROW + 1] = _PARTS
            grid, near = grid.split(parts), None
            continue
        share = found.losses / (_TOLERANCE * found.time)
        # What switches or kinks lose falls with the square or the third power of the interval.
        parts = np.clip(np.ceil(np.cbrt(share * len(share))), 1, 8).astype(np.int64)
        # If not all can be split, those that lose most are.
        order = np.argsort(-share)
        parts[order[np.cumsum(parts[order] - 1) > _MOST - len(parts)]] = 1
        if share.sum() < 1 or (parts == 1).all():
            break
        finer = grid.split(parts)
        middles = (finer.angles[1:] + finer.angles[:-1]) / 2
        near = np.interp(way.place(middles), way.place(grid.angles), found.motion.b)
        grid = finer
    return found and found.bound


def bound_roughly(curves: Sequence[Curve], epsilon: float, intervals: int) -> float:
    """Bound the time of motions along curves from below on one coarse grid; see `bound_least_time`.

    Zero where no motion is found on that grid.
    """
    way = Way(curves, epsilon)
    try:
        return _bound(way, way.make_grid(intervals), None).bound.value
    except NoMotionError:
        return 0.0


def look_along(curves: Sequence[Curve], epsilon: float, intervals: int) -> float:
    """About how long the fastest motion along curves takes, from rest to rest [s].

    It keeps the limits at one place of each interval of a coarse grid; see `bound_least_time`.

    Raises
    ------
    NoMotionError
        If there is no motion on that grid.
    """
    way = Way(curves, epsilon)
    grid = way.make_grid(intervals)
    ends, angles = way.place(grid.angles), (grid.angles[1:] + grid.angles[:-1]) / 2
    rows = way.evaluate(angles[:, None], grid.owners).pick((slice(None), 0))
    cap = np.full(len(ends), np.inf)
    if np.isfinite(rows.cap).any():
        sides = np.column_stack([grid.angles[:-1], grid.angles[1:]])
        cap = _join_caps(*way.evaluate(sides, grid.owners).cap.T)
    steps = np.diff(ends)
    motion = find_steady(rows, steps, (way.place(angles) - ends[:-1]) / steps, cap)
    return add_up(motion.b, steps)


def _join_caps(left: Array, right: Array) -> Array:
    """Limits of b at nodes from those on both sides of each."""
    return np.asarray(np.minimum(np.append(left, np.inf), np.append(np.inf, right)))


def _bound(way: Way, grid: Grid, near: Array | None) -> _Round:
    """The bound on a grid; `near` is what b in its intervals is about."""
    h = np.diff(grid.angles)[:, None]
    angles = grid.angles[:-1, None] + _PLACES * h
    rows = way.evaluate(angles, grid.owners)
    left, middle, right = (rows.pick((slice(None), k)) for k in range(3))
    s = way.place(grid.angles)
    part = (way.place(angles) - s[:-1, None]) / np.diff(s)[:, None]
    cap, places = _join_caps(left.cap, right.cap), part[:, 1]
    if near is None:
        motion = find_steady(middle, np.diff(s), places, cap)
    else:
        motion = find_fastest(middle, np.diff(s), places, cap, near)
    b = motion.b[:-1, None] + part * np.diff(motion.b)[:, None]
    costate = find_costate(way, grid, left, right, motion)
    shape = len(h), len(_PLACES) - 3
    p, slope = (part.ravel() for part in costate.interpolate(way, grid, _PLACES[3:]))
    inner = rows.pick((slice(None), slice(3, None)))
    inner = Rows(*(part.reshape(shape[0] * shape[1], *part.shape[2:]) for part in inner))
    least = find_least(inner, p, slope)
    excess = evaluate(inner, p, slope, b[:, 3:].ravel()) - least
    stretch = way.length / 2 * np.sin(angles[:, 3:])
    least, excess = least.reshape(shape) * stretch, excess.reshape(shape) * stretch
    # Along a limit of the speed nothing is lost, however b is interpolated.
    at_cap = motion.b == cap
    excess[at_cap[:-1] & at_cap[1:]] = 0.0
    coarse, fine = (
        h[:, 0] / 2 * (least[:, own] @ weights)
        for own, (_, weights) in zip((slice(2), slice(2, None)), _RULES, strict=True)
    )
    error = np.abs(fine - coarse)
    losses = error + np.abs(h[:, 0] / 2 * (excess[:, 2:] @ _RULES[1][1]))
    jumps = np.minimum(costate.jumps(grid), 0.0)
    taken = np.zeros(len(jumps))
    at = np.flatnonzero(jumps)
    taken[at] = np.minimum(right.pick(at).highest(), left.pick(at + 1).highest())
    lost = np.abs(jumps * (taken - motion.b[1:-1]))
    losses[:-1] += lost
    losses[1:] += lost
    total = float(fine.sum() + jumps @ taken)
    estimate = _SAFETY * float(error.sum())
    value = max(0.0, total - estimate) if np.isfinite(total) else 0.0
    return _Round(LowerBound(value, estimate), losses, motion, add_up(motion.b, np.diff(s)))
