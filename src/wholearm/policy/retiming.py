"""The fastest motion along a curve that is nowhere faster than a plan and keeps a reserve.

With b = s'^2, and a = s'' constant on each interval, b is linear in s and limits are linear in a, b
and the squeeze. The squeeze goes by pairs of limits that push it to and fro; what is left bounds
(a, b) on each interval. A pass backward finds the largest b at each node from which the end can be
reached, a pass forward goes as fast as that allows (reachability analysis, Pham and Pham 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from .curve_rows import NEVER

SHARES = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
"""Parts of the reserve that are tried, the largest first. A plan's limits hold between its own
nodes, so that at others a little may lack."""
SLOWEST = 0.1  # Least part of the plan's b of a motion with a reserve: what crawls can stick
PARTS = (0.5, 0.2, 0.0)
"""Parts of the reserve that all places are limited to, where some place has less."""
NEAR, ENOUGH = 0.8, 0.4
"""Part of such a limit, and of the reserve, from which on the place with least is near enough."""
SPACE = 1e-9  # Part of the plan's b by which limits of b may cross, from rounding

ROUNDING = 1e-12  # Part of its terms that is nothing in a difference
HUGE = 1e12  # Larger than any b


class Reach(NamedTuple):
    """From where the end of a curve can be reached.

    `least` and `most` b at the nodes, shape (n,); `rows` (1, b, a) >= 0 of the intervals, from the
    last one to the first; the part of the reserve of each interval.
    """

    s: Array
    least: Array
    most: Array
    rows: list[Array]
    share: Array

    def run(self, first: float) -> Array:
        """The fastest motion from a b within its limits at the first node: b at all of them."""
        b, steps = np.empty(len(self.s)), np.diff(self.s)
        b[0] = first
        for k, rows in enumerate(reversed(self.rows)):
            falls = rows[:, 2] < 0
            a = float(((rows[:, 0] + rows[:, 1] * b[k])[falls] / -rows[falls, 2]).min())
            b[k + 1] = min(max(b[k] + 2 * steps[k] * a, self.least[k + 1]), self.most[k + 1])
        return b


def retime(
    s: Array,
    slack: Array,
    reserve: Array,
    cap: Array,
    end: tuple[float, float] | None = None,
    parts: Sequence[float] = PARTS,
) -> Reach:
    """Find the motions whose least part of the reserve is largest, as far as it matters.

    Parameters
    ----------
    s : (n,) [m]          nodes
    slack : (n, m, 5)     limits at the nodes, as in `curve_rows.Rows`
    reserve : (n, m)      what they have to have in reserve
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node, if it is not the last of the largest
    parts                 of the reserve, that all places are limited to where some place has less
    """
    best: Reach | None = None
    for part in (1.0, *parts):
        # What one place keeps can be what another one lacks.
        found = _pass(s, slack, reserve, cap, end or (cap[-1], cap[-1]), part)
        if best is None or found.share.min() > best.share.min():
            best = found
        if best.share.min() >= min(NEAR * part, ENOUGH):
            break
    assert best is not None
    return best


def _pass(
    s: Array, slack: Array, reserve: Array, cap: Array, end: tuple[float, float], part: float
) -> Reach:
    """Motions with as much of a part of the reserve as there can be on each interval."""
    steps, count = np.diff(s), len(s)
    least, most = SLOWEST * cap, cap.copy()
    least[-1], most[-1] = end
    shares = [part, *(own for own in SHARES if own < part)]
    share = np.empty(count - 1)
    bounds: list[Array] = []
    for k in range(count - 2, -1, -1):
        ends, twice = slice(k, k + 2), 2 * steps[k]
        after = np.array([[most[k + 1], -1.0, -twice], [-least[k + 1], 1.0, twice]])
        # Nothing but the plan itself may pass here.
        rows, low, high, share[k] = after, least[k], cap[k], shares[-1]
        first, last = 0, len(shares)
        while first < last:
            own = first if first == 0 else (first + last) // 2
            tried = _bound(slack[ends], shares[own] * reserve[ends], steps[k], cap[ends])
            tried = np.vstack([tried, after])
            slowest, fastest = find_range(tried)
            slowest, fastest = max(slowest, least[k]), min(fastest, most[k])
            if slowest <= fastest + SPACE * cap[k]:
                rows, low, high, share[k], last = tried, slowest, fastest, shares[own], own
            else:
                first = own + 1
        bounds.append(rows)
        least[k], most[k] = low, high
    return Reach(s, least, most, bounds, share)


def eliminate(rows: Array) -> Array:
    """Limits rows (1, x, y) >= 0 that leave some y, shape (k, m - 1), from (n, m), y the last.

    Each is a mean of two in which y cancels, or one that does not know of it.
    """
    last = rows[:, -1]
    up, down = np.flatnonzero(last > 0), np.flatnonzero(last < 0)
    first, second = np.tile(up, len(down)), np.repeat(down, len(up))
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
        own = np.unique(own[own[:, 0] < NEVER / 2], axis=0)
        rows = eliminate(own[:, [0, 1, 3, 4]])
        rows[:, 2] += end * 2 * step * rows[:, 1]
        found.append(rows)
    return np.vstack(found)


def find_range(rows: Array) -> tuple[float, float]:
    """Least and largest b >= 0 with rows (1, b, a) >= 0 for some a; the least is larger if none.

    Rows bound a from below and from above. The room between is concave in b, so that Newton's
    method from outside ends where it begins.
    """
    size = np.abs(rows).max(axis=1, keepdims=True)
    fixed, slope, rate = (rows / np.where(size > 0, size, 1.0)).T
    flat, up, down = rate == 0, rate > 0, rate < 0
    if (fixed[flat & (slope == 0)] < 0).any():
        return 1.0, -1.0
    rises, falls = flat & (slope > 0), flat & (slope < 0)
    low = float((-fixed[rises] / slope[rises]).max(initial=0.0))
    high = float((-fixed[falls] / slope[falls]).min(initial=np.inf))
    if not up.any() or not down.any() or low > high:
        return low, high
    floors, roofs = (np.column_stack([fixed, slope])[own] / -rate[own, None] for own in (up, down))

    def close(b: float, sign: float) -> float | None:
        for _ in range(len(rows)):
            room = roofs[(roofs @ [1.0, b]).argmin()] - floors[(floors @ [1.0, b]).argmax()]
            if room[0] + room[1] * b >= -ROUNDING * np.abs(room * [1.0, b]).max():
                return b
            if room[1] * sign >= 0:
                return None
            b = float(-room[0] / room[1])
        return b

    ends = close(low, -1.0), close(min(high, HUGE), 1.0)
    if ends[0] is None or ends[1] is None:
        return 1.0, -1.0
    return max(ends[0], low), min(ends[1], high)
