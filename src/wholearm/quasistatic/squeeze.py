"""Internal force (squeeze) with the largest least normal force, at places of a path.

At given s'^2 and s'' every limit is affine in the internal force. The largest epsilon of c_n >=
epsilon and of the cones of rolling contacts, within the other limits, is a linear programme in two
unknowns, solved by its vertices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.dynamics import LAMBDA, PathForces
from ..mechanics.limits import CONE, PRESS, LimitSet, make_limits
from ..mechanics.path_limits import PathLimits, find_slack_rows

_FAR = 1e6  # internal force that stands for an infinite one, over the scene's force
_LEVEL = 1e-12
"""Slope over it below which a limit does not depend on it, over what is much for it."""
_TIED = 1e-9  # slack of a limit that counts as none, over what is much for it


class Grasp(NamedTuple):
    """Largest least normal force at n places."""

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
        rows[..., LAMBDA] *= np.abs(rows[..., LAMBDA]) > _LEVEL
        return InternalForceLimits(limits, PathLimits(rows, np.full(len(rows), np.inf)))

    @property
    def force(self) -> float:
        """What is much for a normal force [N]."""
        return float(self.limits.scales[self.limits.of(PRESS)[0]])

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
        return self._find_range(self.at.relax(-loss), a, b)

    def _find_range(self, limits: PathLimits, a: Array, b: Array) -> tuple[Array, Array]:
        low, high = limits.find_internal_force_range(a, b)
        return np.maximum(low, -_FAR * self.force), np.minimum(high, _FAR * self.force)

    def find_best(self, a: Array, b: Array) -> Grasp:
        """The internal force with the largest least normal force, at a = s'', b = s'^2."""
        soft, weights, owners = self._split()
        offset, slope = self.at.find_slack(a, b, 0 * a), self.at.rows[..., LAMBDA]
        others = self.at._replace(rows=self.at.rows[:, ~soft])
        low, high = self._find_range(others, a, b)
        feasible, far = low <= high, _FAR * self.force
        low, high = np.clip([low, high], -far, far)
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
        found = np.isfinite(value)
        slack[:, soft] -= np.where(found, value, 0.0)[:, None] * weights[soft]
        # Where other limits cannot be kept it is these that are to blame.
        slack[np.ix_(~found, soft)] = np.inf
        pair = np.argsort(np.where(found[:, None], np.abs(slack), slack), axis=1)[:, :2]
        # Where it has no effect, only those that are missed.
        bent = np.abs(np.take_along_axis(slope, pair, axis=1)) > _LEVEL
        free = np.take_along_axis(slack, pair, axis=1)[:, 1] > _TIED
        pair[:, 1] = np.where(free & ~bent.any(axis=1), pair[:, 0], pair[:, 1])
        rank = np.sort(owners[pair] + len(self.limits.limits) * ~soft[pair], axis=1)
        return Grasp(value, internal, rank % len(self.limits.limits))
