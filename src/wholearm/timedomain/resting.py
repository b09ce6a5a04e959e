"""Whether a motion can begin from rest at all: one linear programme for each contact mode.

At rest nothing is left of the equations of motion that is not linear,

    A a = 0,  M5 a = g - D sigma + S tau + A^T c_n + A_t^T c_t,  c_n >= epsilon,  |tau| <= limit,

and friction is that of the way in which the acceleration a sets things in motion: c_t = -mu Xi c_n
with Xi A_t a > 0 where a contact will slide, |c_t| <= mu (c_n - epsilon) with A_t a = 0 where it
will not. With two freedoms the ways are the sectors and rays between a handful of lines. If none of
them admits an acceleration other than zero, no plan exists, whatever the solver says. Where a
motion comes to rest the same holds with the acceleration against the way that things move.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..curve import tangent_basis
from ..formation import Formation
from ..model import Array

MOVES = 1e-7
"""Least sum of rates, of a sum that may be 1, that counts as a motion."""
_STILL = 1e-9
"""Rate over the largest one below which something does not move."""


class Blocked(NamedTuple):
    """No motion begins.

    Attributes
    ----------
    contact : str
        The contact that has to pull most, in the mode in which that is least; empty if torques
        alone are in the way.
    short : float
        By how much c_n is short of epsilon there at least.
    """

    contact: str
    short: float


def find_block(
    formation: Formation,
    z: Array,
    epsilon: float,
    ends: bool = False,
    torque_limit: Array | None = None,
) -> Blocked | None:
    """Say why no motion begins from rest at `z`, or ends there; None if one may.

    Formations with more than two freedoms always may.

    Parameters
    ----------
    formation : Formation
    z : ndarray, shape (5,)
    epsilon : float
    ends : bool
        Whether the motion ends at rest at `z`: then it moved against its acceleration.
    torque_limit : ndarray, shape (2,), optional
        In place of the scene's.
    """
    torque = formation.scene.torque_limit if torque_limit is None else torque_limit
    N = tangent_basis(formation, z)
    metric = np.array([1.0, 1.0, *(3 * [formation.scene.polygon.gyration_radius**2])])
    N = N / metric[:, None]
    freedoms = N.shape[1]
    if not 1 <= freedoms <= 2:
        return None
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    A, A_t = kinematics.A[0], kinematics.A_t[0]
    rates = np.vstack([A_t, np.eye(5)[3:]]) @ N
    least: Blocked | None = None
    for way in list_ways(rates):
        signs = np.sign(
            np.where(np.abs(rates @ way) > _STILL * np.abs(rates).max(), rates @ way, 0)
        )
        signs[list(formation.rolling_rows)] = 0.0
        programme = _Programme(formation, epsilon, torque, -N if ends else N, A, A_t, rates, signs)
        if programme.moves():
            return None
        short = programme.find_short()
        if short is not None and (least is None or short.short < least.short):
            least = short
    return least or Blocked("", 0.0)


def find_largest(allows: Callable[[float], bool], most: float) -> float | None:
    """The largest value below `most` that allows a motion, to a thousandth; None if none does."""
    low, high = 0.0, most
    if not allows(low):
        return None
    while high - low > 1e-3 * most:
        middle = (low + high) / 2
        low, high = (middle, high) if allows(middle) else (low, middle)
    return low or None


def find_smallest(allows: Callable[[float], bool], least: float) -> float | None:
    """The smallest value above `least` that allows a motion, to a thousandth; None if none does.

    More than a thousand times as much is not looked at.
    """
    low, high = least, 2 * least
    while not allows(high):
        low, high = high, 2 * high
        if high > 1e3 * least:
            return None
    while high - low > 1e-3 * low:
        middle = (low + high) / 2
        low, high = (low, middle) if allows(middle) else (middle, high)
    return high


def list_ways(rates: Array) -> list[Array]:
    """Accelerations, shape (f,), one for each way to set things in motion, from rates (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _STILL * np.abs(rates).max()]
    across = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = np.unique(np.round(np.concatenate([across, across + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


class _Programme:
    """Accelerations and forces of one mode: x = (y, c_n, c_t of what sticks, f of joints, tau)."""

    def __init__(
        self,
        formation: Formation,
        epsilon: float,
        torque_limit: Array,
        N: Array,
        A: Array,
        A_t: Array,
        rates: Array,
        signs: Array,
    ) -> None:
        scene, n_c, f = formation.scene, formation.n_contacts, N.shape[1]
        self.names, self.epsilon = formation.names, epsilon
        mu = formation.friction
        sticks = np.flatnonzero(signs[:n_c] == 0)
        held = np.flatnonzero(signs[n_c:] == 0)
        self.f, self.n_c = f, n_c
        unit = np.eye(5)
        forces = [
            -(scene.mass_diagonal[:, None] * N),
            (A - (mu * signs[:n_c])[:, None] * A_t).T,
            A_t[sticks].T,
            unit[:, 3 + held],
            unit[:, 3:],
        ]
        self.equal = np.hstack(forces)
        dry = scene.dry * np.array([0.0, 0.0, 0.0, *signs[n_c:]])
        self.equal_to = dry - scene.applied_force
        still = np.hstack([rates[signs == 0], np.zeros((int((signs == 0).sum()), self.size - f))])
        self.equal = np.vstack([self.equal, still])
        self.equal_to = np.append(self.equal_to, np.zeros(len(still)))
        rows, most = [], []
        for k, contact in enumerate(sticks.tolist()):
            for side in (1.0, -1.0):
                row = np.zeros(self.size)
                row[f + n_c + k] = side
                row[f + contact] = -mu[contact]
                rows.append(row)
                most.append(-mu[contact] * epsilon)
        moving = signs != 0
        self.speed = np.zeros(self.size)
        self.speed[:f] = (signs[moving, None] * rates[moving]).sum(axis=0)
        for row in signs[moving, None] * rates[moving]:
            rows.append(np.concatenate([-row, np.zeros(self.size - f)]))
            most.append(0.0)
        self.rows, self.most = np.array([*rows, self.speed]), np.array([*most, 1.0])
        free: tuple[float | None, float | None] = (None, None)
        limits = [free] * f + [(epsilon, None)] * n_c + [free] * len(sticks)
        limits += [(-float(scene.dry[3 + k]), float(scene.dry[3 + k])) for k in held]
        limits += [(-float(limit), float(limit)) for limit in torque_limit]
        self.limits = limits

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.equal.shape[1])

    def moves(self) -> bool:
        """Whether an acceleration other than zero is possible."""
        from scipy.optimize import linprog

        answer = linprog(-self.speed, self.rows, self.most, self.equal, self.equal_to, self.limits)
        # What is not decided counts as possible.
        return bool(answer.status not in (0, 2) or (answer.status == 0 and -answer.fun > MOVES))

    def find_short(self) -> Blocked | None:
        """What the normal forces lack to move with a speed of 1, the largest made least."""
        from scipy.optimize import linprog

        n, own = self.size, slice(self.f, self.f + self.n_c)
        wide = np.hstack([self.rows, np.zeros((len(self.rows), 1))])
        presses = np.zeros((self.n_c, n + 1))
        presses[:, own], presses[:, -1] = -np.eye(self.n_c), -1.0
        moving = np.append(-self.speed, 0.0)[None]
        limits = [*self.limits, (0.0, None)]
        limits[own] = [self.limits[0]] * self.n_c
        answer = linprog(
            np.append(np.zeros(n), 1.0),
            np.vstack([wide, presses, moving]),
            np.concatenate([self.most, np.full(self.n_c, -self.epsilon), [-MOVES]]),
            np.hstack([self.equal, np.zeros((len(self.equal), 1))]),
            self.equal_to,
            limits,
        )
        if answer.status != 0:
            return None
        worst = int(np.argmin(answer.x[own]))
        return Blocked(self.names[worst], float(answer.fun))
