"""A lower bound of the least time from any costate.

For any p(s) and any motion from rest to rest, the integral of p' b + 2 p a, b' being 2 a, is zero.
Hence

    T = integral of 1/v = integral of (1/v - p' b - 2 p a) >= integral of H(s),

H being the least value of the integrand over all (a, b) that the limits at s allow. Where p rises
in a jump, the jump times b is taken away, which is at most that times the highest b there. H is
made smaller still by keeping one limit at a time; the largest of these values counts.

So any p gives a lower bound, whatever it was made from. The costate of the fastest motion gives
the time of that motion: always without viscous friction, when the problem is convex, and with it
for as long as viscous torques are not most of what the joints can give.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from .rows import Rows


def find_least(rows: Rows, p: Array, slope: Array) -> Array:
    """H at n places, from p and p' there."""
    least = _find_least(rows, p, slope)
    lost = np.flatnonzero(~np.isfinite(least))
    if len(lost):
        own = rows.pick(lost)
        own = own._replace(cap=own.highest())
        least[lost] = _find_least(own, p[lost], slope[lost])
    return least


def evaluate(rows: Rows, p: Array, slope: Array, b: Array) -> Array:
    """The integrand at n places for a motion with some b and the best a."""
    share, rest = _weigh(rows, p), rows.rest(b)
    push = np.where(share < 0, share * rest, -np.inf).max(axis=1)
    return np.asarray(1 / np.sqrt(b) - slope * b + np.where(p == 0, 0.0, push))


def _find_least(rows: Rows, p: Array, slope: Array) -> Array:
    share, cap = _weigh(rows, p), rows.cap[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        least = _minimise(share * rows.b - slope[:, None], share * rows.v, cap) + share * rows.one
    least = np.where((share < 0) & ~np.isnan(least), least, -np.inf).max(axis=1)
    alone = _minimise(-slope[:, None], np.zeros((len(p), 1)), cap)[:, 0]
    return np.where(p == 0, alone, least)


def _weigh(rows: Rows, p: Array) -> Array:
    """What a row's rest counts in the integrand if it alone bounds p a; 0 if it cannot."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        share = 2 * p[:, None] / rows.a
        return np.where((share < 0) & np.isfinite(share), share, 0.0)


def _minimise(c: Array, g: Array, cap: Array) -> Array:
    """Least 1/v + g v + c v^2 over 0 < v <= sqrt(cap).

    The derivative vanishes where x = 1/v has x^3 = g x + 2 c. The largest root is the minimum, or
    there is none and the largest v is best.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = np.cbrt(2 * np.maximum(c, 0))
        if g.any():
            # Newton's method falls monotonically from above the largest root.
            x = np.where(g > 0, root + np.sqrt(np.abs(g)), np.minimum(root, root**3 / np.abs(g)))
            for _ in range(12):
                x = x - (x**3 - g * x - 2 * c) / (3 * x**2 - g)
            root = np.where(g == 0, root, x)
        v = np.sqrt(cap)
        inner = np.where(root > 0, np.minimum(1 / root, v), v)
        values = [
            np.where(np.isfinite(own), 1 / own + g * own + c * own**2, _far(c, g))
            for own in (inner, v)
        ]
        return np.where(c > 0, values[0], np.minimum(*values))


def _far(c: Array, g: Array) -> Array:
    """Limit of 1/v + g v + c v^2 for a large v."""
    first = np.where(c == 0, g, c)
    return np.where(first == 0, 0.0, np.copysign(np.inf, first))
