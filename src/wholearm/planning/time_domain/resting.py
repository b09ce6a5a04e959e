"""Whether a motion can begin from rest, by one linear programme for each contact mode.

At rest the equations of motion are linear in acceleration, forces and torques,

    A a = 0,  M5 a = g - D sigma + S tau + A^T c_n + A_t^T c_t,  c_n >= epsilon,  |tau| <= limit,

and closed gaps of other contacts can only open. Friction follows from the acceleration: a contact
slides with c_t = -mu Xi c_n and Xi A_t a > 0, or sticks with |c_t| <= mu (c_n - epsilon) and
A_t a = 0. With two degrees of freedom the modes are the sectors and rays between a few lines. If
none admits a nonzero acceleration, no plan exists. For a motion that comes to rest the acceleration
is against the direction of motion.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import tangent_basis

MOVES = 1e-5  # least sum of accelerations, over the scene's own, that counts as a motion
BEGINS = 0.3  # sum of accelerations of an initial direction, over the scene's own
PUSHES = 1e-3  # least component along one direction, over all forces, that moves the object
_SAME = 1e-9  # difference of two margins, over the scene's force, below which motions are the same
_STILL = 1e-9  # rate over the largest one below which something does not move
_PROBE = 1e-6  # steps that slopes of limits are taken over, in radii of gyration and rad
_LEVEL = 1e-6  # slope of a limit, in radii of gyration, below which no motion changes it


class BlockedStart(NamedTuple):
    """The contact with the largest tension, in the mode where that is least."""

    contact: str  # empty if torques alone prevent a motion
    short: float  # least shortfall of c_n below epsilon


def find_block(
    formation: Formation, z: Array, epsilon: float, ends: bool = False
) -> BlockedStart | None:
    """Why no motion begins from rest at `z`, (5,), or `ends` there; None if one may.

    Formations with more than two degrees of freedom always may.
    """
    modes = _list_modes(formation, z, epsilon, ends)
    if not modes or any(mode.moves() for mode in modes):
        return None
    shorts = [short for mode in modes if (short := mode.find_short()) is not None]
    return min(shorts, key=lambda short: short.short, default=BlockedStart("", 0.0))


def find_change(
    formation: Formation, z: Array, epsilon: float, finger: int | None, ends: bool = False
) -> float | None:
    """Limit with which a motion can begin from rest at `z`, or end there; None if there is none.

    The least torque limit of a finger, or for None the largest epsilon.
    """
    values = [mode.find_limit(finger) for mode in _list_modes(formation, z, epsilon, ends)]
    return (max if finger is None else min)((v for v in values if v is not None), default=None)


def pushes_one_way(formation: Formation, z: Array) -> bool:
    """Whether contact forces share a half-space at all of `z`, (n, 5): no motion comes to rest.

    So if w^T f > 0 for all edges f of friction cones, and w^T g >= 0: then w^T M q' only grows.
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
    """Initial directions of motions from rest at `z`, (5,), by decreasing normal forces."""
    headings: list[tuple[float, Array]] = []
    for mode in _list_modes(formation, z, epsilon, ends=False):
        answer = mode.find_heading()
        if answer is not None and all(abs(answer[0] - margin) > _SAME for margin, _ in headings):
            headings.append(answer)
    return [heading for _, heading in sorted(headings, key=lambda pair: -pair[0])]


def list_ways(rates: Array) -> list[Array]:
    """One acceleration, shape (f,), for each combination of signs of rates, shape (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _STILL * np.abs(rates).max()]
    across = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = np.unique(np.round(np.concatenate([across, across + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


def _list_modes(formation: Formation, z: Array, epsilon: float, ends: bool) -> list[_Programme]:
    """One programme for each mode; none with other than one or two degrees of freedom."""
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
        side, speed = -1.0 if ends else 1.0, rates @ way
        signs = np.sign(np.where(np.abs(speed) > least, speed, 0))
        signs[list(formation.rolling_rows)] = 0.0
        modes.append(_Programme(formation, epsilon, side * N, A, A_t, rates, signs, side * opens))
    return modes


def _list_opening(formation: Formation, z: Array) -> Array:
    """Slopes of the closed gaps at `z`, shape (n, 5): from rest these may only open."""
    met = np.abs(formation.evaluate_limits(z[None])[0]) < formation.scene.touching
    steps = _PROBE * np.diag([*[formation.scene.scales.length] * 2, 1.0, 1.0, 1.0])
    around = formation.evaluate_limits(z + np.vstack([steps, -steps]))[:, met]
    ahead, behind = np.split(around, 2)
    return np.asarray((ahead - behind).T / (2 * steps.diagonal()))


class _Programme:
    """Linear programme of one mode: x = (y, c_n, sticking c_t, friction of joints at rest, tau)."""

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
        self.f, self.n_c, mu = f, n_c, formation.friction
        self.normal = slice(f, f + n_c)
        sticks, held = np.flatnonzero(signs[:n_c] == 0), np.flatnonzero(signs[n_c:] == 0)
        forces = [
            -(scene.mass_diagonal[:, None] * N),
            (A - (mu * signs[:n_c])[:, None] * A_t).T,
            A_t[sticks].T,
            np.eye(5)[:, 3 + held],
            np.eye(5)[:, 3:],
        ]
        balance, moving = np.hstack(forces), signs != 0
        self.size = balance.shape[1]
        still = self._pad(rates[~moving])
        self.equal = np.vstack([balance, still])
        dry = scene.dry * np.array([0.0, 0.0, 0.0, *signs[n_c:]])
        self.equal_to = np.append(dry - scene.applied_force, np.zeros(len(still)))
        unit, motion = np.eye(self.size), signs[moving, None] * rates[moving]
        cones = [
            side * unit[f + n_c + k] - mu[contact] * unit[f + contact]
            for k, contact in enumerate(sticks)
            for side in (1.0, -1.0)
        ]
        growing = opens[np.abs(opens).max(axis=1, initial=0.0) > _LEVEL]
        others = self._pad(-np.vstack([motion, growing]))
        self.rows = np.vstack([*cones, others])
        # What epsilon adds to each row.
        self.relaxations = np.append(np.repeat(mu[sticks], 2), np.zeros(len(others)))
        self.most = -epsilon * self.relaxations
        self.speed = self._pad(motion).sum(axis=0)
        free: tuple[float | None, float | None] = (None, None)
        self.limits = [free] * f + [(epsilon, None)] * n_c + [free] * len(sticks)
        for limit in (*scene.dry[3 + held], *scene.torque_limit):
            self.limits.append((-float(limit), float(limit)))

    def _pad(self, rows: Array) -> Array:
        """Rows of the acceleration as rows of x."""
        return np.pad(rows, ((0, 0), (0, self.size - rows.shape[1])))

    def moves(self) -> bool:
        """Whether a nonzero acceleration is possible, which counts so if undecided or unbounded."""
        from scipy.optimize import linprog

        answer = linprog(-self.speed, self.rows, self.most, self.equal, self.equal_to, self.limits)
        return bool(answer.status not in (0, 2) or (answer.status == 0 and -answer.fun > MOVES))

    def find_short(self) -> BlockedStart | None:
        """The least largest shortfall of the normal forces in a motion, and its contact."""
        answer = self._minimise(1.0, MOVES, self._press(-1.0, self.epsilon), self.normal)
        if answer is None:
            return None
        worst = int(np.argmin(answer[self.normal]))
        return BlockedStart(self.names[worst], float(answer[-1]))

    def find_heading(self) -> tuple[float, Array] | None:
        """The largest least c_n over epsilon with a speed of `BEGINS`, and the acceleration."""
        answer = self._minimise(-1.0, BEGINS, self._press(1.0, self.epsilon), self.normal)
        return None if answer is None else (float(answer[-1]), self.N @ answer[: self.f])

    def find_limit(self, finger: int | None) -> float | None:
        """The least torque limit of a finger, or the largest epsilon, with a motion."""
        if finger is None:
            answer = self._minimise(-1.0, MOVES, self._press(1.0, 0.0), self.normal, relaxed=True)
        else:
            at = self.size - 2 + finger
            torque = np.zeros((2, self.size + 1))
            torque[:, at], torque[:, -1] = [1.0, -1.0], -1.0
            answer = self._minimise(1.0, MOVES, (torque, np.zeros(2)), slice(at, at + 1))
        return None if answer is None else float(answer[-1])

    def _press(self, share: float, least: float) -> tuple[Array, Array]:
        """Rows c_n >= least + share r."""
        rows = np.zeros((self.n_c, self.size + 1))
        rows[:, self.f : self.f + self.n_c], rows[:, -1] = -np.eye(self.n_c), share
        return rows, np.full(self.n_c, -least)

    def _minimise(
        self,
        cost: float,
        speed: float,
        more: tuple[Array, Array],
        own: slice,
        relaxed: bool = False,
    ) -> Array | None:
        """Minimise `cost` times one more unknown r >= 0 in a motion of given speed.

        Rows `more` replace the bounds of the unknowns `own`; if `relaxed`, r is epsilon.
        """
        from scipy.optimize import linprog

        by_r = self.relaxations * relaxed
        moving = np.append(-self.speed * (MOVES / speed), 0.0)[None]
        limits = [*self.limits, (0.0, None)]
        limits[own] = [(None, None)] * (own.stop - own.start)
        answer = linprog(
            np.append(np.zeros(self.size), cost),
            np.vstack([np.column_stack([self.rows, by_r]), more[0], moving]),
            np.concatenate([self.most + by_r * self.epsilon, more[1], [-MOVES]]),
            np.hstack([self.equal, np.zeros((len(self.equal), 1))]),
            self.equal_to,
            limits,
        )
        return answer.x if answer.status == 0 else None
