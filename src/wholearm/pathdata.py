"""What one phase gives the planner: forces along its curve, at nodes and between them.

Forces are evaluated at the nodes and at three places of every interval. They are smooth there, so
polynomials through these five carry them to all places where limits are looked at.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .curve import Curve, describe_pose
from .dynamics import PathForces, inverse, reduced_inertia
from .errors import JammingError
from .model import Array
from .pathmotion import Grid, PathMotion, Profile, directions_of
from .torque import TorqueProfile

KNOTS = np.linspace(0.0, 1.0, 5)
"""Where in an interval forces are evaluated, its ends included."""
LOOKS = np.arange(1, 16) / 16
"""Where in an interval limits are looked at."""


class Places(NamedTuple):
    """Forces and rates of the joints, d theta / ds with shape (n, 2), at n places of a curve."""

    forces: PathForces
    rates: Array

    def pick(self, rows: Any) -> Places:
        """Return the places that `rows` indexes."""
        return Places(PathForces(*(part[rows] for part in self.forces)), self.rates[rows])


class PhaseData(NamedTuple):
    """What one phase gives the NLP.

    Attributes
    ----------
    curve : Curve
    epsilon : float, [N]
    grid : Grid
    nodes : Places
        At the nodes.
    knots : Places
        At `KNOTS` of every solid interval, interval by interval.
    looks : Places
        At `LOOKS` of every solid interval, interval by interval.
    solid : ndarray of int
        The intervals that have a length.
    """

    curve: Curve
    epsilon: float
    grid: Grid
    nodes: Places
    knots: Places
    looks: Places
    solid: NDArray[np.int64]

    @property
    def torque_limit(self) -> Array:
        """Torque limits, shape (2,) [N m]."""
        return self.curve.formation.scene.torque_limit

    def slack(self, places: Places, profile: Profile, margin: float = 0.0) -> Array:
        """How far each limit is from being missed, shape (n, n_c + 4) [N, N m].

        In the order c_n - epsilon - margin, tau + limit, limit - tau.
        """
        c_n, tau = places.forces.c_n(*profile), places.forces.tau(*profile)
        limit = self.torque_limit
        return np.hstack([c_n - self.epsilon - margin, tau + limit, limit - tau])

    def largest_b(self, places: Places) -> Array:
        """Largest b that the joints' speed limits allow, shape (n,) [m^2/s^2]."""
        limit = self.curve.formation.scene.speed_limit
        if np.isinf(limit).all():
            return np.full(len(places.rates), np.inf)
        return np.asarray(((limit / np.maximum(np.abs(places.rates), 1e-12)) ** 2).min(axis=1))

    def spread(self, profile: Profile, fractions: Array) -> Profile:
        """The profile at `fractions` of every solid interval, interval by interval."""
        k, x, h = self.solid, fractions, self.grid.steps[self.solid, None]
        a, rise = profile.a[k, None], (profile.a[k + 1] - profile.a[k])[:, None]
        b = profile.b[k, None] + h * x * (2 * a + x * rise)
        squeeze = profile.squeeze[k, None] * (1 - x) + profile.squeeze[k + 1, None] * x
        return Profile((a + x * rise).ravel(), np.maximum(b, 0.0).ravel(), squeeze.ravel())

    def misses(self, profile: Profile, margin: float) -> tuple[Array, Array]:
        """What limits miss inside each solid interval, shape (n_solid, n_c + 4) [N, N m].

        And how far b is beyond what the speed limits allow, shape (n_solid,), relative.
        """
        here = self.spread(profile, LOOKS)
        short = np.maximum(-self.slack(self.looks, here, margin), 0.0)
        speeding = np.maximum(here.b / self.largest_b(self.looks) - 1, 0.0)
        shape = (len(self.solid), len(LOOKS))
        return short.reshape(*shape, -1).max(axis=1), speeding.reshape(shape).max(axis=1)

    def slack_beside(self, profile: Profile, margin: float, short: Array) -> Array:
        """The lesser slack of the two nodes of each solid interval, shape (n_solid, n_c + 4).

        Zero where nothing is `short` in the interval.
        """
        slack = self.slack(self.nodes, profile, margin)
        least = np.minimum(slack[self.solid], slack[self.solid + 1])
        return np.where(short > 0, np.maximum(least, 0.0), 0.0)

    def beside(self, inside: Array) -> Array:
        """The larger value of the two solid intervals beside each node, shape (N + 1, ...)."""
        table = np.zeros((len(self.grid.s), *inside.shape[1:]))
        table[self.solid] = inside
        table[self.solid + 1] = np.maximum(table[self.solid + 1], inside)
        return table


def prepare(curve: Curve, epsilon: float, grid: Grid, phase: int) -> PhaseData:
    """Evaluate a curve's forces at the nodes of a grid and between them.

    Raises
    ------
    JammingError
        If friction makes the reduced inertia vanish or turn negative anywhere.
    """
    solid = np.flatnonzero(grid.steps > 0)
    inner = KNOTS[1:-1]
    between = (grid.s[solid, None] + inner * grid.steps[solid, None]).ravel()
    s = np.concatenate([grid.s, between])
    segment = np.concatenate([grid.segment, np.repeat(grid.segment[solid], len(inner))])
    point = curve.evaluate(s)
    formation, directions = curve.formation, directions_of(curve, segment)
    inertia = reduced_inertia(formation, point.kinematics, directions)
    if inertia.min() <= 0:
        worst = int(inertia.argmin())
        raise JammingError(
            f"phase {phase}: {' '.join(formation.names)} jams at {describe_pose(point.z[worst])}: "
            f"friction makes the reduced inertia {inertia[worst]:.3g} of its frictionless value"
        )
    forces = inverse(formation, *point[:3], directions, point.kinematics)
    every = Places(forces, point.z_s[:, 3:])
    own = len(grid.s) + np.arange(len(between)).reshape(len(solid), -1)
    order = np.hstack([solid[:, None], own, solid[:, None] + 1])
    knots = every.pick(order.ravel())

    def carry(values: Array) -> Array:
        table = values.reshape(len(solid), len(KNOTS), -1)
        return (_knots_to_looks() @ table).reshape(len(solid) * len(LOOKS), -1)

    looks = Places(PathForces(*(carry(part) for part in knots.forces)), carry(knots.rates))
    nodes = every.pick(slice(None, len(grid.s)))
    return PhaseData(curve, epsilon, grid, nodes, knots, looks, solid)


@lru_cache(maxsize=1)
def _knots_to_looks() -> Array:
    """Matrix that takes values at `KNOTS` to those of their polynomial at `LOOKS`."""
    powers = np.arange(len(KNOTS))
    return np.asarray(LOOKS[:, None] ** powers @ np.linalg.inv(KNOTS[:, None] ** powers))


def fit_torque(data: PhaseData, motion: PathMotion) -> tuple[TorqueProfile, float]:
    """Torque of a motion as one polynomial in time per interval, through its values at `KNOTS`.

    Also returns the integral of tau^T tau [(N m)^2 s].
    """
    k = data.solid
    values = data.knots.forces.tau(*data.spread(motion.profile, KNOTS))
    values = values.reshape(len(k), len(KNOTS), 2)
    spans = motion.durations(KNOTS)[k]
    x = 2 * spans / spans[:, -1:] - 1
    powers = np.arange(len(KNOTS))
    vandermonde = x[..., None] ** powers
    coefficients = np.linalg.solve(vandermonde, values)
    moments = (1 - (-1.0) ** (powers + 1)) / (powers + 1)
    weights = np.linalg.solve(vandermonde.transpose(0, 2, 1), moments[:, None])[..., 0]
    squares = (weights * (values**2).sum(axis=2)).sum(axis=1)
    breaks = np.append(motion.times[k], motion.times[-1])
    torque = TorqueProfile(breaks, np.asarray(coefficients.transpose(0, 2, 1), dtype=float))
    return torque, float(squares @ spans[:, -1] / 2)
