"""Limits along curves with the internal force lambda eliminated (Fourier-Motzkin).

At a place of a curve every limit is affine in a = s'', b = s'^2, v = s' and lambda. Two limits with
lambda of opposite signs combine to one without it; all such pairs bound (a, b) exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...geometry.curve import Curve, CurvePoint
from ...mechanics.dynamics import Directions, PathForces, inverse
from ...mechanics.limits import SPEED, LimitSet, SideTerms, make_limits

GIVE = 2.5e-7  # relaxation of limits over their scales: a plan may violate them as much
TIED = 1e-9  # relative difference of two bounds that is rounding: pairs of a limit without lambda


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
        """The rows at a = 0, shape (..., m), at each b."""
        b = b[..., None]
        return np.asarray(self.b * b + self.v * np.sqrt(b) + self.one)

    def extreme(self, b: Array, largest: bool) -> Extreme:
        """The largest or least a at n places for b of shape (n,): of tied rows by the first."""
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


class LimitSides(NamedTuple):
    """Sides of limits, slack = rest + b bend + s' drag + a rate + lambda press, at n places.

    Each of shape (n, n_sides), over its scale (`SideTerms`). `cap` is the b that speed limits
    allow, shape (n,) [m^2/s^2].
    """

    rest: Array
    bend: Array
    drag: Array
    rate: Array
    press: Array
    cap: Array

    def pick(self, rows: Any) -> LimitSides:
        """Some of the places."""
        return LimitSides(*(part[rows] for part in self))

    def eliminate(self) -> PathLimitRows:
        """Limits without lambda, one for each pair of sides, ordered as `triu_indices(k, 1)`."""
        i, j = np.triu_indices(self.press.shape[1], 1)
        opposite = self.press[:, i] * self.press[:, j] <= 0
        first, second = (np.where(opposite, np.abs(self.press[:, k]), 0) for k in (j, i))
        # Other pairs are 0 >= -1.
        left = first + second > 0
        size = np.where(left, first + second, 1)
        rate, bend, drag, rest = (
            np.asarray((first * part[:, i] + second * part[:, j]) / size)
            for part in (self.rate, self.bend, self.drag, self.rest)
        )
        return PathLimitRows(rate, bend, drag, np.where(left, rest, 1.0), self.cap)

    def at(self, b: Array) -> Array:
        """The sides at a = 0 and lambda = 0 for b of shape (n,)."""
        return np.asarray(self.rest + self.bend * b[:, None] + self.drag * np.sqrt(b)[:, None])

    def find_slack(self, a: Array, b: Array, lam: Array) -> Array:
        """Slack of each side for a motion, shape (n, n_sides)."""
        return np.asarray(self.at(b) + a[:, None] * self.rate + lam[:, None] * self.press)

    def pair(self, row: NDArray[np.int64]) -> NDArray[np.int64]:
        """The sides that a row of `eliminate` combines, shape (..., 2)."""
        return np.asarray(np.stack(np.triu_indices(self.rest.shape[1], 1), axis=1)[row])

    def meet(
        self, b: Array, sides: NDArray[np.int64], slack: float | Array = 0.0
    ) -> tuple[Array, Array]:
        """The a and lambda, (n,) each, at which two sides, (n, 2) or (2,), have a slack, (n, 2)."""
        k = np.arange(len(b))[:, None]
        rest, rate, press = (part[k, sides] for part in (self.at(b), self.rate, self.press))
        (one, other), (r1, r2), (p1, p2) = (rest - slack).T, rate.T, press.T
        with np.errstate(divide="ignore", invalid="ignore"):
            det = r1 * p2 - r2 * p1
            return (other * p1 - one * p2) / det, (one * r2 - other * r1) / det


def directions_of(curve: Curve, segment: NDArray[np.int64]) -> Directions:
    """Directions at n places, given the segment that each belongs to."""
    signs = ([getattr(part, name) for part in curve.segments] for name in ("Xi", "sigma"))
    return Directions(*(np.array(sign)[segment] for sign in signs))


def evaluate_rows(
    curve: Curve, epsilon: float, s: Array, segment: NDArray[np.int64]
) -> PathLimitRows:
    """Limits at n places of a curve, each taken as part of a segment; see `GIVE`."""
    return limit_along(curve, epsilon, curve.evaluate(s), segment)


def limit_along(
    curve: Curve, epsilon: float, point: CurvePoint, segment: NDArray[np.int64]
) -> PathLimitRows:
    """Limits at n places of a curve that have been evaluated; see `evaluate_rows`."""
    directions = directions_of(curve, segment)
    forces = inverse(curve.formation, *point[:3], directions, point.kinematics)
    return limit(make_limits(curve.formation, epsilon), forces, point.z_s[:, 3:])


def limit(every: LimitSet, forces: PathForces, rates: Array) -> PathLimitRows:
    """Limits along a path from its inverse dynamics and rates d theta / ds, shape (n, 2).

    Without lambda, which three contacts do not have.
    """
    terms = SideTerms.of(every.without(SPEED), forces, rates)
    cap = np.full(len(rates), np.inf)
    for speed in every.only(SPEED).limits:
        with np.errstate(divide="ignore"):
            largest = (speed.high[0] / np.abs(rates @ speed.rows[0, -2:])) ** 2
        cap = np.minimum(cap, largest * (1 + GIVE))
    sides = LimitSides(terms.rest + GIVE, *terms[1:], cap)
    if terms.press.any():
        return sides.eliminate()
    return PathLimitRows(sides.rate, sides.bend, sides.drag, sides.rest, cap)
