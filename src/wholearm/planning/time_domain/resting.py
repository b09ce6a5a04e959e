"""Whether a motion can begin from rest at all: one linear programme for each contact mode.

At rest nothing is left of the equations of motion that is not linear,

    A a = 0,  M5 a = g - D sigma + S tau + A^T c_n + A_t^T c_t,  c_n >= epsilon,  |tau| <= limit,

and gaps that are closed beside the contacts can only open. Friction is that of the way in which the
acceleration a sets things in motion: c_t = -mu Xi c_n with Xi A_t a > 0 where a contact will slide,
|c_t| <= mu (c_n - epsilon) with A_t a = 0 where it will not. With two freedoms the ways are the
sectors and rays between a handful of lines. If none of them admits an acceleration other than zero,
no plan exists, whatever the solver says. Where a motion comes to rest the same holds with the
acceleration against the way that things move.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import tangent_basis

MOVES = 1e-5  # least sum of accelerations, over the scene's own, that counts as a motion
BEGINS = 0.3  # sum of accelerations with which a motion sets out, over the scene's own
PUSHES = 1e-3
"""Part of contact forces along one direction, of all, that surely sets the object in motion."""
_SAME = 1e-9
"""Difference of two forces, over the scene's own, below which they are those of one motion."""
_STILL = 1e-9  # rate over the largest one below which something does not move
_PROBE = 1e-6  # steps that slopes of limits are taken over, in radii of gyration and rad
_LEVEL = 1e-6  # slope of a limit, in radii of gyration, below which no motion changes it


class BlockedStart(NamedTuple):
    """No motion begins."""

    # the contact that has to pull most, in the mode in which that is least; empty if torques alone
    # are in the way
    contact: str
    short: float  # by how much c_n is short of epsilon there at least


def find_block(
    formation: Formation, z: Array, epsilon: float, ends: bool = False
) -> BlockedStart | None:
    """Say why no motion begins from rest at `z`, or ends there; None if one may.

    Formations with more than two freedoms always may.

    Parameters
    ----------
    z : (5,)
    ends      whether the motion ends at rest at `z`: then it moved against its acceleration
    """
    modes = _list_modes(formation, z, epsilon, ends)
    if not modes or any(mode.moves() for mode in modes):
        return None
    shorts = [short for mode in modes if (short := mode.find_short()) is not None]
    return min(shorts, key=lambda short: short.short, default=BlockedStart("", 0.0))


def find_change(
    formation: Formation, z: Array, epsilon: float, finger: int | None, ends: bool = False
) -> float | None:
    """The value of one limit with which a motion can begin from rest at `z`, or end there.

    Parameters
    ----------
    finger                       whose torque limit, of which the least value is sought; None for
                                 epsilon, of which the largest is
    formation, z, epsilon, ends  as of `find_block`

    Returns
    -------
    float or None
        None if no value does.
    """
    found = [mode.find_limit(finger) for mode in _list_modes(formation, z, epsilon, ends)]
    values = [value for value in found if value is not None]
    if not values:
        return None
    return max(values) if finger is None else min(values)


def pushes_one_way(formation: Formation, z: Array) -> bool:
    """Whether contacts push the object one way at all of `z`, shape (n, 5): it stays in motion.

    That is so if a direction w has w^T f > 0 for all forces f on the edges of all friction cones,
    and w^T g >= 0: then w^T M q' only grows.
    """
    from scipy.optimize import linprog

    kinematics, mu = formation.evaluate(z, np.zeros_like(z)), formation.friction[:, None]
    edges = [kinematics.A + side * mu * kinematics.A_t for side in (-1.0, 1.0)]
    forces = np.concatenate(edges, axis=1)[..., :3].reshape(-1, 3)
    rows = np.column_stack([-forces, np.ones(len(forces))])
    gravity = np.append(-formation.scene.applied_force[:3], 0.0)
    bounds = [(-1.0, 1.0)] * 3 + [(0.0, 1.0)]
    answer = linprog(
        [0, 0, 0, -1], np.vstack([rows, gravity]), np.zeros(len(rows) + 1), bounds=bounds
    )
    return bool(answer.status == 0 and answer.x[-1] > PUSHES)


def list_headings(formation: Formation, z: Array, epsilon: float) -> list[Array]:
    """Ways in which motions begin from rest at `z`, shape (5,), those that press most first."""
    found: list[tuple[float, Array]] = []
    for mode in _list_modes(formation, z, epsilon, ends=False):
        answer = mode.find_heading()
        if answer is not None and all(abs(answer[0] - margin) > _SAME for margin, _ in found):
            found.append(answer)
    return [way for _, way in sorted(found, key=lambda one: -one[0])]


def list_ways(rates: Array) -> list[Array]:
    """Accelerations, shape (f,), one for each way to set things in motion, from rates (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _STILL * np.abs(rates).max()]
    across = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = np.unique(np.round(np.concatenate([across, across + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


def _list_modes(formation: Formation, z: Array, epsilon: float, ends: bool) -> list[_Programme]:
    """One programme for each way to set things in motion; none with other than 1 or 2 freedoms."""
    N = tangent_basis(formation, z)
    metric = np.array([1.0, 1.0, *(3 * [formation.scene.polygon.gyration_radius**2])])
    N = N / metric[:, None]
    if not 1 <= N.shape[1] <= 2:
        return []
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    A, A_t = kinematics.A[0], kinematics.A_t[0]
    rates = np.vstack([A_t, np.eye(5)[3:]]) @ N
    least = _STILL * np.abs(rates).max()
    opens = _list_opening(formation, z) @ N
    modes = []
    for way in list_ways(rates):
        signs = np.sign(np.where(np.abs(rates @ way) > least, rates @ way, 0))
        signs[list(formation.rolling_rows)] = 0.0
        side = -1.0 if ends else 1.0
        modes.append(_Programme(formation, epsilon, side * N, A, A_t, rates, signs, side * opens))
    return modes


def _list_opening(formation: Formation, z: Array) -> Array:
    """Slopes of the limits that are met at `z`, shape (n, 5): from rest these may only grow."""
    met = np.abs(formation.evaluate_limits(z[None])[0]) < formation.scene.touching
    steps = _PROBE * np.diag([*[formation.scene.scales.length] * 2, 1.0, 1.0, 1.0])
    around = formation.evaluate_limits(z + np.vstack([steps, -steps]))[:, met]
    ahead, behind = np.split(around, 2)
    return np.asarray((ahead - behind).T / (2 * steps.diagonal()))


class _Programme:
    """Accelerations and forces of one mode: x = (y, c_n, c_t of what sticks, f of joints, tau)."""

    def __init__(
        self,
        formation: Formation,
        epsilon: float,
        N: Array,
        A: Array,
        A_t: Array,
        rates: Array,
        signs: Array,
        opens: Array,
    ) -> None:
        scene, n_c, f = formation.scene, formation.n_contacts, N.shape[1]
        self.names, self.epsilon, self.N = formation.names, epsilon, N
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
        rows, most, relaxations = [], [], []
        for k, contact in enumerate(sticks.tolist()):
            for side in (1.0, -1.0):
                row = np.zeros(self.size)
                row[f + n_c + k] = side
                row[f + contact] = -mu[contact]
                rows.append(row)
                most.append(-mu[contact] * epsilon)
                relaxations.append(mu[contact])
        moving = signs != 0
        self.speed = np.zeros(self.size)
        self.speed[:f] = (signs[moving, None] * rates[moving]).sum(axis=0)
        for row in signs[moving, None] * rates[moving]:
            rows.append(np.concatenate([-row, np.zeros(self.size - f)]))
            most.append(0.0)
        for row in opens[np.abs(opens).max(axis=1, initial=0.0) > _LEVEL]:
            rows.append(np.concatenate([-row, np.zeros(self.size - f)]))
            most.append(0.0)
        self.rows, self.most = np.array(rows), np.array(most)
        # What epsilon adds to each row.
        self.relaxations = np.append(relaxations, np.zeros(len(self.rows) - len(relaxations)))
        free: tuple[float | None, float | None] = (None, None)
        limits = [free] * f + [(epsilon, None)] * n_c + [free] * len(sticks)
        limits += [(-float(scene.dry[3 + k]), float(scene.dry[3 + k])) for k in held]
        limits += [(-float(limit), float(limit)) for limit in scene.torque_limit]
        self.limits = limits

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.equal.shape[1])

    def moves(self) -> bool:
        """Whether an acceleration other than zero is possible."""
        from scipy.optimize import linprog

        answer = linprog(-self.speed, self.rows, self.most, self.equal, self.equal_to, self.limits)
        # What is not decided, or has no bound, counts as possible.
        return bool(answer.status not in (0, 2) or (answer.status == 0 and -answer.fun > MOVES))

    def find_short(self) -> BlockedStart | None:
        """What the normal forces lack to move with a speed of 1, the largest made least."""
        own = slice(self.f, self.f + self.n_c)
        wide = np.hstack([self.rows, np.zeros((len(self.rows), 1))])
        answer = self._minimise(1.0, wide, self.most, self._press(-1.0, self.epsilon), own)
        if answer is None:
            return None
        worst = int(np.argmin(answer[own]))
        return BlockedStart(self.names[worst], float(answer[-1]))

    def find_heading(self) -> tuple[float, Array] | None:
        """The largest least c_n with a speed of `BEGINS`, over epsilon, and which way that is."""
        self.speed *= MOVES / BEGINS
        wide = np.hstack([self.rows, np.zeros((len(self.rows), 1))])
        own = slice(self.f, self.f + self.n_c)
        answer = self._minimise(-1.0, wide, self.most, self._press(1.0, self.epsilon), own)
        self.speed *= BEGINS / MOVES
        return None if answer is None else (float(answer[-1]), self.N @ answer[: self.f])

    def find_limit(self, finger: int | None) -> float | None:
        """The least torque limit of a finger, or the largest epsilon, with which things move."""
        if finger is None:
            own = slice(self.f, self.f + self.n_c)
            wide = np.column_stack([self.rows, self.relaxations])
            most = self.most + self.relaxations * self.epsilon
            answer = self._minimise(-1.0, wide, most, self._press(1.0, 0.0), own)
        else:
            at = self.size - 2 + finger
            wide = np.column_stack([self.rows, np.zeros(len(self.rows))])
            torque = np.zeros((2, self.size + 1))
            torque[:, at], torque[:, -1] = [1.0, -1.0], -1.0
            own = slice(at, at + 1)
            answer = self._minimise(1.0, wide, self.most, (torque, np.zeros(2)), own)
        return None if answer is None else float(answer[-1])

    def _press(self, share: float, least: float) -> tuple[Array, Array]:
        """Rows c_n >= least + share r."""
        rows = np.zeros((self.n_c, self.size + 1))
        rows[:, self.f : self.f + self.n_c], rows[:, -1] = -np.eye(self.n_c), share
        return rows, np.full(self.n_c, -least)

    def _minimise(
        self, cost: float, rows: Array, most: Array, more: tuple[Array, Array], own: slice
    ) -> Array | None:
        """Minimise `cost` times one more unknown r >= 0 while things move; None if they cannot.

        Parameters
        ----------
        rows, most : (n, size + 1) and (n,)
        more  further ones, that take the place of the bounds of the unknowns `own`
        """
        from scipy.optimize import linprog

        moving = np.append(-self.speed, 0.0)[None]
        limits = [*self.limits, (0.0, None)]
        limits[own] = [self.limits[0]] * (own.stop - own.start)
        answer = linprog(
            np.append(np.zeros(self.size), cost),
            np.vstack([rows, more[0], moving]),
            np.concatenate([most, more[1], [-MOVES]]),
            np.hstack([self.equal, np.zeros((len(self.equal), 1))]),
            self.equal_to,
            limits,
        )
        return answer.x if answer.status == 0 else None
