"""The one number that a motion along a curve leaves free: how hard the contacts are squeezed."""

from __future__ import annotations

from collections.abc import Sequence

SAME = 1e-12
"""Difference of levels that is none."""


def choose_squeeze(
    base: Sequence[float], rates: Sequence[float], press: Sequence[float], a: float
) -> tuple[float, float]:
    """The largest least level of limits base + rates a + press squeeze, and its squeeze.

    Of two limits that the squeeze moves to and fro, no squeeze has a larger least level than where
    they meet. The limit that is least there takes the place of one of them, until it is one.
    """
    lines = [(p + rate * a, q) for p, rate, q in zip(base, rates, press, strict=True)]
    ups, downs = [own for own in lines if own[1] > 0.0], [own for own in lines if own[1] < 0.0]
    flat = min([p for p, q in lines if q == 0.0], default=1e30)
    if not ups or not downs:
        return flat, 0.0
    # Begun with those that meet where the squeeze is what it would be without either.
    (p, q), (u, w) = min(ups), min(downs)
    level, squeeze = 1e30, 0.0
    while True:
        meets = (u * q - p * w) / (q - w)
        if meets >= level:
            break
        level, squeeze = meets, (u - p) / (q - w)
        least = level
        for c, d in lines:
            value = c + d * squeeze
            if value < least:
                least, last = value, (c, d)
        if least > level - SAME * (1.0 + abs(level)):
            break
        if last[1] > 0.0:
            p, q = last
        elif last[1] < 0.0:
            u, w = last
        else:
            break
    return min(level, flat), squeeze


def find_motion(torque: Sequence[Sequence[float]], tau: Sequence[float]) -> tuple[float, float]:
    """Acceleration and squeeze that torques lead to at rest, from rows of torques."""
    (one, _, _, c, d), (two, _, _, e, f) = torque
    first, second = tau[0] - one, tau[1] - two
    size = c * f - d * e
    return (first * f - second * d) / size, (second * c - first * e) / size
