"""Speed profile along a curve, nowhere faster than a plan, that keeps robustness margins.

Backward and forward reachability sweep (TOPP-RA, Pham and Pham 2018). In an interval a = s'' is
constant and the limits are kept at both ends, each with its own internal force.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..mechanics.dynamics import ONE, A, B, V
from ..mechanics.path_limits import PathLimits

# Shares of the margin that are tried, the largest first. Negative ones: limits of a plan hold
# between its own nodes, so that at others they may be violated a little.
SHARES = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
SLOWEST = 0.1  # least b over the plan's of a motion with a margin: slow motions can stick
PARTS = (0.5, 0.2, 0.0)  # upper limits of the share of all intervals, if some interval has less
NEAR, ENOUGH = 0.8, 0.4  # least share, over such a limit and in all, that needs no further one
SPACE = 1e-9  # overlap of limits of b that is rounding, over the plan's b
ROUNDING = 1e-12  # relative rounding of a difference
HUGE = 1e12  # larger than any b


class Reach(NamedTuple):
    """Controllable set: states from which the end of a curve can be reached."""

    s: Array  # (n,) [m]: nodes
    least: Array  # least, most (n,): range of b at the nodes
    most: Array
    rows: list[Array]  # limits (1, b, a) >= 0 of the intervals, from the last one to the first
    share: Array  # (n - 1,): share of the margin in each interval

    def run(self, first: float) -> Array:
        """Forward pass: the fastest motion from `first`, b at the first node; b at all nodes."""
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
    """Backward pass with the largest least share of the margins.

    Parameters
    ----------
    s : (n,) [m]          nodes
    slack : (n, m, 5)     limits at the nodes, as in `CurveLimitRows`
    reserve : (n, m)      their margins
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node; by default the last of `cap`
    parts                 upper limits of the share, tried where some interval has less
    """
    bounds, end = _Bounds.of(s, slack, reserve, cap), end or (cap[-1], cap[-1])
    best: Reach | None = None
    for part in (1.0, *parts):
        # A large share in one interval can reduce that of another one.
        found = bounds.sweep(end, part)
        if best is None or found.share.min() > best.share.min():
            best = found
        if best.share.min() >= min(NEAR * part, ENOUGH):
            break
    assert best is not None
    return best


class _Bounds(NamedTuple):
    """Limits (1, b, a) >= 0 of the intervals between n nodes, with b at their first one."""

    s: Array  # (n,)
    cap: Array  # (n,)
    rows: Array  # (n - 1, m, 3)
    rates: Array  # (n - 1, m): by how much a row falls with the share of the margin

    @staticmethod
    def of(s: Array, slack: Array, reserve: Array, cap: Array) -> _Bounds:
        """Those at both ends of the intervals, without the internal force; see `retime`."""
        limits = PathLimits(slack, cap)
        plain, tight = (each.eliminate().rows for each in (limits, limits.relax(-reserve)))
        # Viscous terms at the plan's speed: they are small, and no motion is faster.
        one = plain[..., ONE] + plain[..., V] * np.sqrt(cap)[:, None]
        rates, twice = plain[..., ONE] - tight[..., ONE], 2 * np.diff(s)[:, None]
        first = np.stack([one, plain[..., B], plain[..., A]], axis=-1)
        second = first[1:].copy()
        second[..., 2] += twice * second[..., 1]
        box = np.tile([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]], (len(s) - 1, 1, 1))
        box[:, 0, 0], box[:, 2, 2] = cap[:-1], twice[:, 0]
        rows = np.concatenate([box, first[:-1], second], axis=1)
        return _Bounds(s, cap, rows, np.hstack([np.zeros((len(box), 3)), rates[:-1], rates[1:]]))

    def sweep(self, end: tuple[float, float], part: float) -> Reach:
        """Backward pass with the largest share in each interval, at most `part`."""
        steps, cap, least, most = np.diff(self.s), self.cap, SLOWEST * self.cap, self.cap.copy()
        least[-1], most[-1] = end
        shares = [part, *(smaller for smaller in SHARES if smaller < part)]
        share, bounds = np.empty(len(steps)), list[Array]()
        for k in range(len(steps) - 1, -1, -1):
            twice = 2 * steps[k]
            after = np.array([[most[k + 1], -1.0, -twice], [-least[k + 1], 1.0, twice]])
            # Default: only the plan itself is feasible here.
            rows, low, high, share[k] = after, least[k], cap[k], shares[-1]
            table = np.vstack([self.rows[k], after])
            first, last = 0, len(shares)
            while first < last:
                middle = first if first == 0 else (first + last) // 2
                tried = table.copy()
                tried[:-2, 0] -= shares[middle] * self.rates[k]
                slowest, fastest = find_range(tried)
                slowest, fastest = max(slowest, least[k]), min(fastest, most[k])
                if slowest <= fastest + SPACE * cap[k]:
                    rows, low, high, last = tried, slowest, fastest, middle
                    share[k] = shares[middle]
                else:
                    first = middle + 1
            bounds.append(rows)
            least[k], most[k] = low, high
        return Reach(self.s, least, most, bounds, share)


def find_range(rows: Array) -> tuple[float, float]:
    """Least and largest b >= 0 with rows (1, b, a) >= 0 for some a; the least is larger if none.

    The width of the range of a is concave in b: Newton's method from outside finds both ends.
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
    floors, roofs = (np.column_stack([fixed, slope])[k] / -rate[k, None] for k in (up, down))

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
