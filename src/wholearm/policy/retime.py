"""The fastest motion along a curve that is nowhere faster than a plan and keeps a reserve.

With b = s'^2, and a = s'' constant on each interval, b is linear in s and limits are linear in a, b
and the squeeze. The squeeze goes by pairs of limits that push it to and fro; what is left bounds
(a, b) on each interval. A pass backward finds the largest b at each node from which the end can be
reached, a pass forward goes as fast as that allows (reachability analysis, Pham and Pham 2018).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.arrays import Array

LESS = 0.8
"""Factor by which a reserve shrinks where there is no motion with it."""
SLOWEST = 0.1
"""Least part of the plan's b that a reserve must allow: what crawls can stick."""
TRIES = 40


class Profile(NamedTuple):
    """A motion along a curve: b at the nodes, and the part of the reserve of each interval."""

    b: Array
    share: Array


def retime(s: Array, slack: Array, reserve: Array, cap: Array) -> Profile:
    """Find the motion.

    Parameters
    ----------
    s : ndarray, shape (n,), [m]
        Nodes.
    slack : ndarray, shape (n, m, 5)
        Limits at the nodes, as in `curve_rows.Rows`.
    reserve : ndarray, shape (n, m)
        What they have to have in reserve.
    cap : ndarray, shape (n,), [m^2/s^2]
        Largest b; the motion begins with the first one, or less, and ends with the last one.
    """
    steps, count = np.diff(s), len(s)
    most, share = np.empty(count), np.ones(count - 1)
    most[-1] = cap[-1]
    bounds: list[Array] = []
    for k in range(count - 2, -1, -1):
        for _ in range(TRIES):
            ends = slice(k, k + 2)
            rows = _bound(slack[ends], share[k] * reserve[ends], steps[k], cap[ends])
            rows = np.vstack([rows, [most[k + 1], -1.0, -2 * steps[k]]])
            b = _find_largest(rows)
            if b >= SLOWEST * cap[k]:
                break
            share[k] *= LESS
        if b < 0:
            # Nothing but the plan itself passes here.
            rows, b, share[k] = rows[-1:], cap[k], 0.0
        bounds.append(rows)
        most[k] = b
    b_here = np.empty(count)
    b_here[0] = most[0]
    for k, rows in enumerate(reversed(bounds)):
        falls = rows[:, 2] < 0
        a = float(((rows[:, 0] + rows[:, 1] * b_here[k])[falls] / -rows[falls, 2]).min())
        b_here[k + 1] = min(max(b_here[k] + 2 * steps[k] * a, 0.0), most[k + 1])
    return Profile(b_here, share)


def eliminate(rows: Array) -> Array:
    """Limits rows (1, x, y) >= 0 that leave some y, shape (k, m - 1), from (n, m), y the last.

    Each is a mean of two in which y cancels, or one that does not know of it.
    """
    last = rows[:, -1]
    up, down = np.flatnonzero(last > 0), np.flatnonzero(last < 0)
    first, second = (index.ravel() for index in np.meshgrid(up, down))
    share = (-last[second] / (last[first] - last[second]))[:, None]
    mixed = share * rows[first, :-1] + (1 - share) * rows[second, :-1]
    return np.vstack([mixed, rows[last == 0, :-1]])


def _bound(slack: Array, reserve: Array, step: float, cap: Array) -> Array:
    """Limits on (1, b, a) of an interval from those at both ends, shape (k, 3)."""
    found = [np.array([[cap[0], -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 2 * step]])]
    for end in range(2):
        own = slack[end].copy()
        # Drag at the plan's speed: it is small, and no motion is faster.
        own[:, 0] += own[:, 2] * np.sqrt(cap[end]) - reserve[end]
        rows = eliminate(own[:, [0, 1, 3, 4]])
        rows[:, 2] += end * 2 * step * rows[:, 1]
        found.append(rows)
    return np.vstack(found)


def _find_largest(rows: Array) -> float:
    """Largest b with rows (1, b, a) >= 0 for some a, -1 if there is none."""
    size = np.abs(rows).max(axis=1, keepdims=True)
    fixed, slope = eliminate(rows / np.where(size > 0, size, 1.0)).T
    low = (-fixed[slope > 0] / slope[slope > 0]).max(initial=0.0)
    high = (-fixed[slope < 0] / slope[slope < 0]).min(initial=np.inf)
    return float(high) if high >= low and not (fixed[slope == 0] < 0).any() else -1.0
