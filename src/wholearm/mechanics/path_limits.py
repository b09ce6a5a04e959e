"""Limits along a path: coefficients of (1, s'', s'^2, s', lambda), from a `LimitSet`.

At a place of a path every limited value is affine in a = s'', b = s'^2, s' and the internal force
lambda. Two limits with lambda of opposite signs combine to one without it; all such pairs bound
(a, b) exactly (Fourier-Motzkin elimination).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation
from .dynamics import LAMBDA, ONE, A, B, PathForces, V, stack_motion
from .limits import CONE, PRESS, LimitSet, make_limits

TIED = 1e-9  # relative difference of two bounds that is rounding: pairs of a limit without lambda
FLAT = 1e-12  # slope over lambda below which a limit does not depend on it, over its scale


class Extreme(NamedTuple):
    """The largest or the least a at n places, its slope da/db, and the row that sets it."""

    a: Array
    slope: Array
    row: NDArray[np.int64]


class PathLimits(NamedTuple):
    """One-sided limits, rows @ (1, a, b, s', lambda) >= 0, and b <= `cap`, at places of a path.

    The slack is over the scale of each limit. After `eliminate` the last column is missing.
    """

    rows: Array  # (..., m, 5), or (..., m, 4) without lambda
    cap: Array  # (...,) [m^2/s^2]: largest b by joint speeds, infinite without speed limits

    @staticmethod
    def of(limits: LimitSet, forces: PathForces, rates: Array, give: float = 0.0) -> PathLimits:
        """Limits of a set at n places with d theta / ds = `rates`, (n, 2).

        They are relaxed by `give`, over their scales.
        """
        bounds, speeds = limits.split(2)
        rows = find_slack_rows(bounds, forces, rates)
        rows[..., ONE] += give
        return PathLimits(rows, (1 + give) * find_speed_cap(speeds, rates))

    def pick(self, index: Any) -> PathLimits:
        """Return the places that `index` selects."""
        return PathLimits(self.rows[index], self.cap[index])

    def scale(self, size: Array | float) -> PathLimits:
        """The limits with s / `size` in place of s; `size` as the places, or one number."""
        size = np.asarray(size)[..., None]
        columns = [size**0, size, size**2, size, size**0][: self.rows.shape[-1]]
        return PathLimits(self.rows * np.stack(columns, axis=-1), self.cap / size[..., 0] ** 2)

    def relax(self, amount: Array | float) -> PathLimits:
        """The limits with an `amount` of slack more, over their scales."""
        rows = self.rows.copy()
        rows[..., ONE] += amount
        return self._replace(rows=rows)

    def eliminate(self) -> PathLimits:
        """Limits without lambda: one for each pair of rows, ordered as `triu_indices(m, 1)`.

        Without any influence of lambda, as with three contacts, they are the rows themselves.
        """
        by = self.rows[..., LAMBDA]
        if not by.any():
            return self._replace(rows=self.rows[..., :LAMBDA])
        i, j = np.triu_indices(by.shape[-1], 1)
        opposite = by[..., i] * by[..., j] <= 0
        first, second = (np.where(opposite, np.abs(by[..., k]), 0) for k in (j, i))
        # Other pairs are 0 >= -1.
        used = first + second > 0
        size = np.where(used, first + second, 1)
        one, other = (self.rows[..., k, :LAMBDA] for k in (i, j))
        rows = ((first / size)[..., None] * one) + ((second / size)[..., None] * other)
        rows[..., ONE] = np.where(used, rows[..., ONE], 1.0)
        return self._replace(rows=rows)

    def pair(self, row: NDArray[np.int64]) -> NDArray[np.int64]:
        """The two rows that a row of `eliminate` combines, shape (..., 2)."""
        return np.asarray(np.stack(np.triu_indices(self.rows.shape[-2], 1), axis=1)[row])

    def meet(self, b: Array, pairs: NDArray[np.int64]) -> tuple[Array, Array]:
        """The a and lambda, (n,) each, at which two rows, (n, 2) or (2,), have no slack."""
        k = np.arange(len(b))[:, None]
        (r1, r2), (l1, l2) = (self.rows[k, pairs, column].T for column in (A, LAMBDA))
        one, other = self.at(b)[k, pairs].T
        with np.errstate(divide="ignore", invalid="ignore"):
            det = r1 * l2 - r2 * l1
            return (other * l1 - one * l2) / det, (one * r2 - other * r1) / det

    def at(self, b: Array) -> Array:
        """Slack of the rows at a = 0 and lambda = 0 for b of shape (...,)."""
        b = b[..., None]
        return np.asarray(
            self.rows[..., ONE] + self.rows[..., B] * b + self.rows[..., V] * np.sqrt(b)
        )

    def find_slack(self, a: Array, b: Array, internal: Array) -> Array:
        """Slack of the rows for a motion of shape (n,), over their scales, shape (n, m)."""
        return np.asarray(np.einsum("nmi,ni->nm", self.rows, stack_motion(a, b, internal)))

    def find_internal_force_range(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Least and largest lambda that the rows allow for a motion, (n,); crossed if none."""
        return find_range(self.rows[..., LAMBDA], self.find_slack(a, b, np.zeros_like(b)))

    def extreme(self, b: Array, largest: bool) -> Extreme:
        """The largest or least a at n places for b of shape (n,): of tied rows by the first."""
        sign, of_a = -1.0 if largest else 1.0, self.rows[..., A]
        with np.errstate(divide="ignore", invalid="ignore"):
            bounds = -self.at(b) / of_a
            slack = TIED * (np.abs(self.rows[..., ONE] / of_a) + np.abs(bounds))
            lead = np.where(sign * of_a > 0, sign * bounds, -np.inf)
            reach = np.where(sign * of_a > 0, lead + slack, -np.inf)
            row = (reach >= lead.max(axis=1, keepdims=True)).argmax(axis=1)
            k = np.arange(len(b))
            used = self.rows[k, row]
            slope = -(used[:, B] + used[:, V] / (2 * np.sqrt(b))) / used[:, A]
        return Extreme(bounds[k, row], slope, row)

    def can_rest(self, sign: float = 1.0) -> NDArray[np.bool_]:
        """Whether rows without lambda allow an a of some `sign`, or zero, at rest, shape (...,)."""
        least, most = find_range(sign * self.rows[..., A], self.rows[..., ONE])
        return np.asarray((np.maximum(least, 0.0) <= most) & (least < np.inf))

    def find_largest_b(self) -> Array:
        """Upper bound of b at n places by rows without lambda and the speed limits, shape (n,)."""
        of_a = self.rows[..., A]
        up, down = np.maximum(of_a, 0)[:, :, None], np.maximum(-of_a, 0)[:, None, :]
        one, b, v = (
            down * self.rows[:, :, None, k] + up * self.rows[:, None, :, k] for k in (ONE, B, V)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            root = (v + np.sqrt(np.maximum(v**2 - 4 * b * one, 0))) / (-2 * b)
        bounded = (up > 0) & (down > 0) & (b < 0)
        largest = np.where(bounded, np.maximum(root, 0), np.inf).min(axis=(1, 2))
        return np.asarray(np.minimum(largest**2, self.cap))


def find_range(by: Array, slack: Array) -> tuple[Array, Array]:
    """Least and largest x of by x + slack >= 0, rows (..., m); crossed or infinite if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -slack / by
    never = np.where((by == 0) & (slack < 0), np.inf, -np.inf)
    low = np.where(by > 0, bound, never).max(axis=-1, initial=-np.inf)
    return low, np.where(by < 0, bound, np.inf).min(axis=-1, initial=np.inf)


def find_value_rows(limits: LimitSet, forces: PathForces, rates: Array) -> Array:
    """Coefficients of the limited values at n places, shape (n, m, 5); see `PathLimits.of`."""
    turn = rates[..., None] * np.eye(5)[V]
    return np.asarray(limits.rows @ np.concatenate([forces.of_c, forces.of_tau, turn], axis=1))


def find_slack_rows(limits: LimitSet, forces: PathForces, rates: Array) -> Array:
    """Coefficients of the slack of each side over its scale, shape (n, n_sides, 5)."""
    rows, signs, bounds = limits.sides
    slack = signs[:, None] * find_value_rows(limits, forces, rates)[:, rows]
    slack[..., ONE] -= signs * bounds
    return np.asarray(slack / limits.scales[rows, None])


def find_speed_cap(limits: LimitSet, rates: Array) -> Array:
    """Largest b by limits of joint speeds alone, d theta / ds = `rates`, shape (n,)."""
    cap = np.full(len(rates), np.inf)
    for limit in limits.limits:
        for row, low, high in zip(limit.rows[:, -2:], limit.low, limit.high, strict=True):
            rate = rates @ row
            with np.errstate(divide="ignore", invalid="ignore"):
                largest = (np.where(rate > 0, high, low) / rate) ** 2
            cap = np.fmin(cap, largest)
    return cap


class BestInternalForce(NamedTuple):
    """Internal force (squeeze) with the largest least normal force at n places."""

    # (n,) [N]: the largest epsilon that all contacts keep; minus infinity where other limits are
    # missed with any internal force
    least: Array
    internal_force: Array  # (n,) [N]
    # (n, 2): limits, as indices into the set, that keep it from being larger, those of contacts
    # first
    owners: NDArray[np.int64]


class InternalForceLimits(NamedTuple):
    """Limits at n places of a path as functions of the internal force."""

    limits: LimitSet  # for an epsilon of zero
    at: PathLimits  # all sides, also of joint speeds

    @staticmethod
    def of(formation: Formation, forces: PathForces, rates: Array) -> InternalForceLimits:
        """Those of a formation at places with d theta / ds = `rates`, (n, 2)."""
        limits = make_limits(formation, 0.0)
        rows = find_slack_rows(limits, forces, rates)
        rows[..., LAMBDA] *= np.abs(rows[..., LAMBDA]) > FLAT
        return InternalForceLimits(limits, PathLimits(rows, np.full(len(rows), np.inf)))

    @property
    def far(self) -> float:
        """Internal force that stands for an infinite one [N]."""
        return 1e6 * float(self.limits.scales[self.limits.of(PRESS)[0]])

    def _split(self) -> tuple[NDArray[np.bool_], Array, NDArray[np.int64]]:
        """Which sides give way to epsilon, by how much per newton, and the limits they are of."""
        rows = self.limits.sides[0]
        weights = np.concatenate([limit.weight for limit in self.limits.limits])[rows]
        soft = np.isin(rows, self.limits.of(PRESS, CONE)) & (weights > 0)
        weights = np.where(soft, weights, 0.0) / self.limits.scales[rows]
        return soft, weights, self.limits.owners[rows]

    def find_span(self, a: Array, b: Array, epsilon: Array | float) -> tuple[Array, Array]:
        """Least and largest internal force with which all limits are kept, shape (n,) [N].

        The least is above the largest where there is none.
        """
        loss = np.multiply.outer(np.broadcast_to(epsilon, a.shape), self._split()[1])
        low, high = self.at.relax(-loss).find_internal_force_range(a, b)
        return np.maximum(low, -self.far), np.minimum(high, self.far)

    def find_best(self, a: Array, b: Array) -> BestInternalForce:
        """The internal force with the largest least normal force, at a = s'', b = s'^2.

        The largest epsilon of c_n >= epsilon and of the cones of rolling contacts, within the other
        limits: a linear programme in two unknowns, solved by its vertices.
        """
        soft, weights, owners = self._split()
        offset, slope = self.at.find_slack(a, b, 0 * a), self.at.rows[..., LAMBDA]
        others = self.at._replace(rows=self.at.rows[:, ~soft])
        low, high = others.find_internal_force_range(a, b)
        feasible = np.maximum(low, -self.far) <= np.minimum(high, self.far)
        low, high = np.clip([low, high], -self.far, self.far)
        # In newtons of epsilon.
        rest, rise = offset[:, soft] / weights[soft], slope[:, soft] / weights[soft]
        i, j = np.triu_indices(soft.sum(), 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            corners = (rest[:, j] - rest[:, i]) / (rise[:, i] - rise[:, j])
        corners = np.where(np.isfinite(corners), corners, low[:, None])
        tried = np.clip(np.column_stack([low, high, corners]), low[:, None], high[:, None])
        least = (rest[:, None] + rise[:, None] * tried[..., None]).min(axis=2)
        k, best = np.arange(len(a)), least.argmax(axis=1)
        internal, value = tried[k, best], np.where(feasible, least[k, best], -np.inf)
        slack = offset + slope * internal[:, None]
        finite = np.isfinite(value)
        slack[:, soft] -= np.where(finite, value, 0.0)[:, None] * weights[soft]
        # Where other limits cannot be kept it is these that are to blame.
        slack[np.ix_(~finite, soft)] = np.inf
        pair = np.argsort(np.where(finite[:, None], np.abs(slack), slack), axis=1)[:, :2]
        # Where it has no effect, only those that are missed.
        bent = np.abs(np.take_along_axis(slope, pair, axis=1)) > FLAT
        free = np.take_along_axis(slack, pair, axis=1)[:, 1] > TIED
        pair[:, 1] = np.where(free & ~bent.any(axis=1), pair[:, 0], pair[:, 1])
        rank = np.sort(owners[pair] + len(self.limits.limits) * ~soft[pair], axis=1)
        return BestInternalForce(value, internal, rank % len(self.limits.limits))
