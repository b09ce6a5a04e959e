"""Least times along many paths at once, from rest to rest, without internal force.

Vectorized form of `planning.lower_bound.speed_sweep` (backward and forward reachability in the
phase plane, TOPP-RA, Pham and Pham 2018).
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags
from ..planning.lower_bound.rows import PathLimitRows

PAIRS = 200_000  # pairs of rows in one vectorized operation


def find_durations(rows: PathLimitRows, steps: Array, part: Array) -> Array:
    """Least durations of paths, infinite where no motion keeps the limits, shape (w,).

    Parameters
    ----------
    rows                at a place of each interval: arrays of shape (w, n, m), and (w, n) for the
                        limit of b
    steps, part : (n,)  lengths of the intervals, and which part of each is before its place
    """
    b = _sweep(rows, steps, part, None)
    if rows.v.any():
        # No row bounds b where a motion is closed; case: the map of a rolling octagon.
        finite = np.where(np.isfinite(b), b, 0.0)
        near = np.maximum(finite[:, :-1] + part * np.diff(finite), 0.0)
        b = _sweep(rows, steps, part, near)
    speeds = np.sqrt(np.maximum(b, 0.0))
    moving = (b[:, 1:-1] > 0).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        times = (2 * steps / (speeds[:, 1:] + speeds[:, :-1])).sum(axis=1)
    return np.asarray(np.where(moving, times, np.inf))


def _sweep(rows: PathLimitRows, steps: Array, part: Array, near: Array | None) -> Array:
    """Largest b at the nodes, shape (w, n + 1); viscous friction linearized about `near`."""
    of_b, one = rows.b, rows.one
    if near is not None:
        speed = np.sqrt(near)[..., None]
        drag = np.divide(rows.v, 2 * speed, out=np.zeros_like(rows.v), where=speed > 0)
        of_b, one = of_b + drag, one + rows.v * speed / 2
    of_a = rows.a / (2 * steps)[:, None]
    before = (1 - part)[:, None] * of_b - of_a
    after = part[:, None] * of_b + of_a
    count, paths = len(steps), len(of_b)
    # A few paths at a time, so that their pairs of rows stay in the cache.
    some = max(1, PAIRS // (count * before.shape[2] ** 2))
    cuts = [slice(k, k + some) for k in range(0, paths, some)]
    corners = [_find_corners(before[k], after[k], one[k]) for k in cuts]
    most = np.minimum(np.concatenate(corners), rows.cap).T
    largest = np.zeros((count + 1, paths))
    # Backward: rows that bound b by the next one.
    starts, slopes = _solve(before, after, one, (before < 0) & (after > 0))
    for k in range(count - 1, -1, -1):
        bounds = _bound(starts[k], slopes[k], largest[k + 1])
        largest[k] = np.maximum(np.minimum(bounds, most[k]), 0.0)
    b = np.zeros((count + 1, paths))
    starts, slopes = _solve(after, before, one, after < 0)
    for k in range(count):
        bounds = _bound(starts[k], slopes[k], b[k])
        b[k + 1] = np.maximum(np.minimum(bounds, largest[k + 1]), 0.0)
    return b.T


def _solve(p: Array, q: Array, one: Array, used: Flags) -> tuple[Array, Array]:
    """Used rows own p + other q + one >= 0 as p <= start + slope q, shape (n, w, m)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        starts, slopes = np.where(used, one / -p, np.inf), np.where(used, q / -p, 0.0)
    return np.ascontiguousarray(starts.swapaxes(0, 1)), np.ascontiguousarray(slopes.swapaxes(0, 1))


def _bound(starts: Array, slopes: Array, other: Array) -> Array:
    """Largest p within all rows of a place at q = `other`, maybe infinite, shape (w,)."""
    with np.errstate(invalid="ignore"):
        more = np.where(slopes == 0, 0.0, slopes * other[:, None])
    return np.asarray((starts + more).min(axis=1))


def _find_corners(before: Array, after: Array, one: Array) -> Array:
    """Largest b for which some next b >= 0 keeps the rows, shape (w, n)."""
    none = np.zeros((*one.shape[:-1], 1))
    rise, fixed, rest = (
        np.concatenate([part, none + more], axis=-1)[..., :, None]
        for part, more in ((after, 1), (before, 0), (one, 0))
    )
    rise, fall = np.maximum(rise, 0), np.maximum(-after, 0)[..., None, :]
    slope = fall * fixed + rise * before[..., None, :]
    value = fall * rest + rise * one[..., None, :]
    bounded = (rise > 0) & (fall > 0) & (slope < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(bounded, value / -slope, np.inf).min(axis=(2, 3)))
