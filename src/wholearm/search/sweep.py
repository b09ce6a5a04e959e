"""The fastest motion along many ways at once, without squeeze, from rest to rest.

The same sweep as `planning.lower_bound.sweep`, over all ways together: backwards for the largest
b = s'^2 from which rest at the end can still be reached, forwards as fast as that allows.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..planning.lower_bound.rows import Rows


def find_durations(rows: Rows, steps: Array, part: Array) -> Array:
    """Least durations of ways, infinite where no motion keeps the limits, shape (w,).

    Parameters
    ----------
    rows : Rows
        At a place of each interval: arrays of shape (w, n, m), and (w, n) for the limit of b.
    steps, part : ndarray, shape (n,)
        Lengths of the intervals, and which part of each is before its place.
    """
    near = None
    for _ in range(2):
        b = _sweep(rows, steps, part, near)
        near = np.maximum(b[:, :-1] + part * np.diff(b), 0.0)
    speeds = np.sqrt(np.maximum(b, 0.0))
    moving = (b[:, 1:-1] > 0).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        times = (2 * steps / (speeds[:, 1:] + speeds[:, :-1])).sum(axis=1)
    return np.asarray(np.where(moving, times, np.inf))


def _sweep(rows: Rows, steps: Array, part: Array, near: Array | None) -> Array:
    """B at the nodes, shape (w, n + 1); with viscous friction linearised about `near`."""
    of_b, one = rows.b, rows.one
    if near is not None:
        speed = np.sqrt(near)[..., None]
        drag = np.divide(rows.v, 2 * speed, out=np.zeros_like(rows.v), where=speed > 0)
        of_b, one = of_b + drag, one + rows.v * speed / 2
    of_a = rows.a / (2 * steps)[:, None]
    before = (1 - part)[:, None] * of_b - of_a
    after = part[:, None] * of_b + of_a
    count, ways = len(steps), len(of_b)
    largest = np.zeros((ways, count + 1))
    for k in range(count - 1, -1, -1):
        b = _find_corners(before[:, k], after[:, k], one[:, k], largest[:, k + 1])
        largest[:, k] = np.minimum(b, rows.cap[:, k])
    b = np.zeros((ways, count + 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(count):
            ends = (before[:, k] * b[:, k, None] + one[:, k]) / -after[:, k]
            pushed = np.where(after[:, k] < 0, ends, np.inf).min(axis=1)
            b[:, k + 1] = np.maximum(np.minimum(pushed, largest[:, k + 1]), 0.0)
    return b


def _find_corners(before: Array, after: Array, one: Array, following: Array) -> Array:
    """Largest b, of each way, from which rows leave some b' from 0 to `following`."""
    none, ways = np.zeros((len(before), 1)), len(before)
    before = np.hstack([before, none, none])
    after = np.hstack([after, none + 1, none - 1])
    one = np.hstack([one, none, following[:, None]])
    up, down = np.maximum(after, 0)[:, :, None], np.maximum(-after, 0)[:, None, :]
    slope = down * before[:, :, None] + up * before[:, None, :]
    value = down * one[:, :, None] + up * one[:, None, :]
    bounded = (up > 0) & (down > 0) & (slope < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(bounded, value / -slope, np.inf).reshape(ways, -1).min(axis=1)
    return np.asarray(np.maximum(found, 0.0))
