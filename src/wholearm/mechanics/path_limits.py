"""Limits along a path: coefficients of (1, s'', s'^2, s', lambda), from a `LimitSet`.

At a place of a path every limited value is affine in a = s'', b = s'^2, s' and the internal force
lambda. Two limits with lambda of opposite signs combine to one without it; all such pairs bound
(a, b) exactly (Fourier-Motzkin elimination).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Flags, Numbers
from ..contacts.formation import Formation
from .dynamics import LAMBDA, ONE, A, B, PathForces, V, apply
from .limits import EPSILON, PRESS, LimitSet, make_limits

TIED = 1e-9  # relative difference of two bounds that is rounding: pairs of a limit without lambda
FLAT = 1e-12  # slope over lambda below which a limit does not depend on it, over its scale


class Extreme(NamedTuple):
    """The largest or the least a at n places, its slope da/db, and the row that sets it."""

    a: Array
    slope: Array
    row: Numbers


class PathLimits(NamedTuple):
    """One-sided limits, rows @ (1, a, b, s', lambda) >= 0, and b <= `cap`, at places of a path.

    The slack is over the scale of each limit. After `eliminate` the last column is missing.
    """

    rows: Array  # (..., m, 5), or (..., m, 4) without lambda
    cap: Array  # (...,) [m^2/s^2]: largest b by joint speeds, infinite without speed limits

    @staticmethod
    def of(limits: LimitSet, forces: PathForces, rates: Array, amount: float = 0.0) -> PathLimits:
        """Limits of a set at n places with d theta / ds = `rates`, (n, 2).

        They are relaxed by `amount`, over their scales.
        """
        bounds, speeds = limits.split(2)
        rows = find_slack_rows(bounds, find_value_rows(bounds, forces, rates))
        rows[..., ONE] += amount
        return PathLimits(rows, (1 + amount) * find_speed_cap(speeds, rates))

    def pick(self, index: Any) -> PathLimits:
        """Return the places that `index` selects."""
        return PathLimits(self.rows[index], self.cap[index])

    def scale(self, size: Array | float) -> PathLimits:
        """The limits with s / `size` in place of s; `size` as the places, or one number."""
        size = np.asarray(size)[..., None]
        columns = [size**0, size, size**2, size, size**0][: self.rows.shape[-1]]
        return PathLimits(self.rows * np.stack(columns, axis=-1), self.cap / size[..., 0] ** 2)

    def relax(self, amount: Array | float) -> PathLimits:
        """The limits with their slack increased by `amount`, over their scales."""
        rows = self.rows.copy()
        rows[..., ONE] += amount
        return self._replace(rows=rows)

    def eliminate(self, column: int = LAMBDA) -> PathLimits:
        """Limits without lambda, or a: one for each pair of rows, ordered as `triu_indices(m, 1)`.

        Without any influence of lambda, as with three contacts, they are the rows themselves.
        """
        slope = self.rows[..., column]
        if not slope.any():
            return self._replace(rows=self.rows[..., :LAMBDA])
        i, j = np.triu_indices(slope.shape[-1], 1)
        opposite = slope[..., i] * slope[..., j] <= 0
        first, second = (np.where(opposite, np.abs(slope[..., k]), 0) for k in (j, i))
        # Other pairs are 0 >= -1.
        valid = first + second > 0
        size = np.where(valid, first + second, 1)
        row, other_row = (self.rows[..., k, :LAMBDA] for k in (i, j))
        rows = ((first / size)[..., None] * row) + ((second / size)[..., None] * other_row)
        rows[..., ONE] = np.where(valid, rows[..., ONE], 1.0)
        return self._replace(rows=rows)

    def pair(self, row: Numbers) -> Numbers:
        """The two rows that a row of `eliminate` combines, (..., 2); itself without lambda."""
        first, second = np.triu_indices(self.rows.shape[-2], 1)
        if not self.rows[..., LAMBDA].any():
            return np.stack([row, row], axis=-1)
        return np.stack([first[row], second[row]], axis=-1)

    def meet(self, b: Array, pairs: Numbers) -> tuple[Array, Array]:
        """The a and lambda, (n,) each, at which two rows, (n, 2) or (2,), have no slack."""
        k = np.arange(len(b))[:, None]
        (r1, r2), (l1, l2) = (self.rows[k, pairs, column].T for column in (A, LAMBDA))
        slack, other_slack = self.at(b)[k, pairs].T
        with np.errstate(divide="ignore", invalid="ignore"):
            det = r1 * l2 - r2 * l1
            return (other_slack * l1 - slack * l2) / det, (slack * r2 - other_slack * r1) / det

    def at(self, b: Array) -> Array:
        """Slack of the rows at a = 0 and lambda = 0 for b of shape (...,)."""
        b = b[..., None]
        return np.asarray(
            self.rows[..., ONE] + self.rows[..., B] * b + self.rows[..., V] * np.sqrt(b)
        )

    def find_slack(self, a: Array, b: Array, internal: Array) -> Array:
        """Slack of the rows for a motion of shape (n,), over their scales, shape (n, m)."""
        return apply(self.rows, a, b, internal)

    def find_internal_force_range(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Least and largest lambda that the rows allow for a motion, (n,); crossed if none."""
        return find_range(self.rows[..., LAMBDA], self.find_slack(a, b, np.zeros_like(b)))

    def extreme(self, b: Array, largest: bool) -> Extreme:
        """The largest or least a at n places for b of shape (n,): of tied rows by the first."""
        sign, of_a = -1.0 if largest else 1.0, self.rows[..., A]
        with np.errstate(divide="ignore", invalid="ignore"):
            bounds = -self.at(b) / of_a
            slack = TIED * (np.abs(self.rows[..., ONE] / of_a) + np.abs(bounds))
            signed = np.where(sign * of_a > 0, sign * bounds, -np.inf)
            upper = np.where(sign * of_a > 0, signed + slack, -np.inf)
            row = (upper >= signed.max(axis=1, keepdims=True)).argmax(axis=1)
            k = np.arange(len(b))
            active = self.rows[k, row]
            slope = -(active[:, B] + active[:, V] / (2 * np.sqrt(b))) / active[:, A]
        return Extreme(bounds[k, row], slope, row)

    def can_rest(self, sign: float = 1.0) -> Flags:
        """Whether rows without lambda allow an a of some `sign`, or zero, at rest, shape (...,)."""
        least, most = find_range(sign * self.rows[..., A], self.rows[..., ONE])
        return np.asarray((np.maximum(least, 0.0) <= most) & (least < np.inf))

    @property
    def holds(self) -> Flags:
        """Whether rows without lambda allow rest without acceleration, on the verge, (...,)."""
        return np.asarray((self.rows[..., ONE] >= 0).all(axis=-1))

    def find_largest_b(self) -> Array:
        """Upper bound of b at n places by rows without lambda and the speed limits, shape (n,)."""
        rows = self.eliminate(A).rows
        constant, b, v = (rows[..., k] for k in (ONE, B, V))
        with np.errstate(divide="ignore", invalid="ignore"):
            root = (v + np.sqrt(np.maximum(v**2 - 4 * b * constant, 0))) / (-2 * b)
        largest = np.where(b < 0, np.maximum(root, 0), np.inf).min(axis=-1)
        return np.asarray(np.minimum(largest**2, self.cap))


def find_range(slope: Array, slack: Array) -> tuple[Array, Array]:
    """Least and largest x of slope x + slack >= 0, rows (..., m); crossed or infinite if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -slack / slope
    infeasible = np.where((slope == 0) & (slack < 0), np.inf, -np.inf)
    low = np.where(slope > 0, bound, infeasible).max(axis=-1, initial=-np.inf)
    return low, np.where(slope < 0, bound, np.inf).min(axis=-1, initial=np.inf)


def find_value_rows(limits: LimitSet, forces: PathForces, rates: Array) -> Array:
    """Coefficients of the limited values at n places, shape (n, m, 5); see `PathLimits.of`."""
    of_rates = rates[..., None] * np.eye(5)[V]
    return np.asarray(limits.rows @ np.concatenate([forces.of_c, forces.of_tau, of_rates], axis=1))


def find_slack_rows(limits: LimitSet, values: Array) -> Array:
    """Slack of each side over its scale, (n, n_sides, 5), from values as of `find_value_rows`."""
    return np.asarray(limits.find_slack_rows(values) / limits.side_scales[:, None])


def find_speed_cap(limits: LimitSet, rates: Array) -> Array:
    """Largest b by limits of joint speeds alone, d theta / ds = `rates`, shape (n,)."""
    if not limits.limits:
        return np.full(len(rates), np.inf)
    rate = rates @ limits.rows[:, -2:].T
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = (np.where(rate > 0, limits.high, limits.low) / rate) ** 2
    return np.asarray(np.fmin.reduce(largest, axis=1, initial=np.inf))


class BestInternalForce(NamedTuple):
    """Internal force (squeeze) with the largest least normal force at n places."""

    # (n,) [N]: the largest epsilon that all contacts keep; minus infinity where other limits are
    # missed with any internal force
    least: Array
    internal_force: Array  # (n,) [N]
    # (n, 2): limits, as indices into the set, that keep it from being larger, those of contacts
    # first
    owners: Numbers


class InternalForceLimits(NamedTuple):
    """Limits at n places of a path as functions of the internal force."""

    limits: LimitSet  # for an epsilon of zero
    at: PathLimits  # all sides, also of joint speeds

    @staticmethod
    def of(formation: Formation, forces: PathForces, rates: Array) -> InternalForceLimits:
        """Limits of a formation at places with d theta / ds = `rates`, (n, 2)."""
        limits = make_limits(formation, 0.0)
        rows = find_slack_rows(limits, find_value_rows(limits, forces, rates))
        rows[..., LAMBDA] *= np.abs(rows[..., LAMBDA]) > FLAT
        return InternalForceLimits(limits, PathLimits(rows, np.full(len(rows), np.inf)))

    @property
    def infinity(self) -> float:
        """Internal force that stands for an infinite one [N]."""
        return 1e6 * float(self.limits.scales[self.limits.of(PRESS)[0]])

    @property
    def weights(self) -> Array:
        """Change of each side's slack per newton of epsilon, over its scale, (n_sides,)."""
        return np.asarray((self.limits.weigh(EPSILON) / self.limits.scales)[self.limits.sides[0]])

    def find_span(self, a: Array, b: Array, epsilon: Array | float) -> tuple[Array, Array]:
        """Least and largest internal force with which all limits are kept, shape (n,) [N].

        The least is above the largest where there is none.
        """
        reduction = np.multiply.outer(np.broadcast_to(epsilon, a.shape), self.weights)
        low, high = self.at.relax(-reduction).find_internal_force_range(a, b)
        return np.maximum(low, -self.infinity), np.minimum(high, self.infinity)

    def find_best(self, a: Array, b: Array) -> BestInternalForce:
        """The internal force with the largest least normal force, at a = s'', b = s'^2.

        The largest epsilon of c_n >= epsilon and of the cones of rolling contacts, within the other
        limits: a linear programme in lambda and epsilon, here in the place of a = s''.
        """
        rows = np.zeros_like(self.at.rows)
        rows[..., ONE], rows[..., A] = self.at.find_slack(a, b, 0 * a), -self.weights
        rows[..., LAMBDA] = self.at.rows[..., LAMBDA]
        limits = self.at._replace(rows=rows)
        eliminated = limits.eliminate()
        other_slack = np.where(eliminated.rows[..., A] == 0, eliminated.rows[..., ONE], np.inf)
        feasible = other_slack.min(axis=1) >= 0
        least, _, row = eliminated.extreme(0 * b, largest=True)
        # Where other limits cannot be kept, the pair of the largest violation.
        pair = limits.pair(np.where(feasible, row, other_slack.argmin(axis=1)))
        # Zero where it has no influence.
        internal = np.nan_to_num(limits.meet(0 * b, pair)[1])
        owners = np.sort(self.limits.owners[self.limits.sides[0]][pair], axis=1)
        return BestInternalForce(np.where(feasible, least, -np.inf), internal, owners)
