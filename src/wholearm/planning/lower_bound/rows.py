"""Limits along curves in which the squeeze is eliminated.

At a place of a curve every limit is affine in a = s'', b = s'^2, v = s' and the squeeze. Two of
them whose squeezes have opposite signs, added so that these cancel, leave a limit without it; all
such pairs together say which (a, b) some squeeze allows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...geometry.curve import Curve, CurvePoint
from ...mechanics.dynamics import Directions, PathForces, inverse
from ...mechanics.limits import SPEED, LimitSet, SideTerms, make_limits

GIVE = 2.5e-7
"""By how much limits give way, over what is much for each: a plan may miss as much of them."""
TIED = 1e-9
"""Difference of two bounds below which they are one, over the largest of their terms: where a limit
has no squeeze, all its pairs say the same but for rounding."""


class Extreme(NamedTuple):
    """The largest or the least a at n places, its slope da/db, and the row that sets it."""

    a: Array
    slope: Array
    row: NDArray[np.int64]


class PathLimitRows(NamedTuple):
    """Limits a_i a + b_i b + v_i v + one_i >= 0 and b <= cap at places of a curve.

    Arrays of shape (..., m), and (...) for `cap` [m^2/s^2], which is infinite without speed limits.
    """

    a: Array
    b: Array
    v: Array
    one: Array
    cap: Array

    def pick(self, index: Any) -> PathLimitRows:
        """Return the places that `index` selects."""
        return PathLimitRows(*(part[index] for part in self))

    def rest(self, b: Array) -> Array:
        """What the rows are but for their part in a, shape (..., m), at each b."""
        b = b[..., None]
        return np.asarray(self.b * b + self.v * np.sqrt(b) + self.one)

    def extreme(self, b: Array, largest: bool) -> Extreme:
        """The largest or least a at n places for some b, shape (n,): of tied rows by the first."""
        sign = -1.0 if largest else 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            bounds = -self.rest(b) / self.a
            slack = TIED * (np.abs(self.one / self.a) + np.abs(bounds))
            lead = np.where(sign * self.a > 0, sign * bounds, -np.inf)
            reach = np.where(sign * self.a > 0, lead + slack, -np.inf)
            row = (reach >= lead.max(axis=1, keepdims=True)).argmax(axis=1)
            k = np.arange(len(b))
            slope = -(self.b[k, row] + self.v[k, row] / (2 * np.sqrt(b))) / self.a[k, row]
        return Extreme(bounds[k, row], slope, row)

    def highest(self) -> Array:
        """An upper bound of b at n places from the limits there, shape (n,)."""
        up, down = np.maximum(self.a, 0)[:, :, None], np.maximum(-self.a, 0)[:, None, :]

        def cross(part: Array) -> Array:
            return np.asarray(down * part[:, :, None] + up * part[:, None, :])

        b, v, one = cross(self.b), cross(self.v), cross(self.one)
        with np.errstate(divide="ignore", invalid="ignore"):
            root = (v + np.sqrt(np.maximum(v**2 - 4 * b * one, 0))) / (-2 * b)
        bounded = (up > 0) & (down > 0) & (b < 0)
        largest = np.where(bounded, np.maximum(root, 0), np.inf).min(axis=(1, 2))
        return np.asarray(np.minimum(largest**2, self.cap))


def evaluate_rows(
    curve: Curve, epsilon: float, s: Array, segment: NDArray[np.int64]
) -> PathLimitRows:
    """Limits at n places of a curve, each taken as part of a segment; see `GIVE`.

    Parameters
    ----------
    epsilon : [N]
    s : (n,)
    segment : (n,)
    """
    return limit_along(curve, epsilon, curve.evaluate(s), segment)


def limit_along(
    curve: Curve, epsilon: float, point: CurvePoint, segment: NDArray[np.int64]
) -> PathLimitRows:
    """Limits at n places of a curve that have been evaluated; see `evaluate_rows`."""
    signs = ([getattr(part, name) for part in curve.segments] for name in ("Xi", "sigma"))
    directions = Directions(*(np.array(sign)[segment] for sign in signs))
    forces = inverse(curve.formation, *point[:3], directions, point.kinematics)
    return limit(make_limits(curve.formation, epsilon), forces, point.z_s[:, 3:])


def limit(every: LimitSet, forces: PathForces, rates: Array) -> PathLimitRows:
    """Limits at n places of curves or of other ways, from the forces that motions along them take.

    Parameters
    ----------
    rates : (n, 2)  d theta / ds

    Returns
    -------
    Rows  without the squeeze, which three contacts do not have
    """
    terms = SideTerms.of(every.without(SPEED), forces, rates)
    cap = np.full(len(rates), np.inf)
    for own in every.only(SPEED).limits:
        turned = np.abs(rates @ own.rows[0, -2:])
        with np.errstate(divide="ignore"):
            cap = np.minimum(cap, (own.high[0] / turned) ** 2 * (1 + GIVE))
    one = terms.rest + GIVE
    if terms.press.any():
        return eliminate(terms.press, terms.rate, terms.bend, terms.drag, one, cap)
    return PathLimitRows(terms.rate, terms.bend, terms.drag, one, cap)


def eliminate(
    squeeze: Array, a: Array, b: Array, v: Array, one: Array, cap: Array
) -> PathLimitRows:
    """Rows without the squeeze, one for each pair of limits, of limits with it, (n, k) each.

    Pairs are in the order of `numpy.triu_indices(k, 1)`.
    """
    i, j = np.triu_indices(squeeze.shape[1], 1)
    opposite = squeeze[:, i] * squeeze[:, j] <= 0
    first, second = (np.where(opposite, np.abs(squeeze[:, k]), 0) for k in (j, i))
    # A pair that leaves nothing is 0 >= -1.
    left = first + second > 0
    size = np.where(left, first + second, 1)

    def combine(of_limits: Array) -> Array:
        return np.asarray((first * of_limits[:, i] + second * of_limits[:, j]) / size)

    return PathLimitRows(combine(a), combine(b), combine(v), np.where(left, combine(one), 1.0), cap)
