"""Whether a motion can begin from rest, by one linear programme for each contact mode.

At rest the equations of motion are linear in acceleration, forces and torques,

    A a = 0,  M5 a = g - D sigma + S tau + A^T c_n + A_t^T c_t,  c_n >= epsilon,  |tau| <= limit,

and closed gaps of other contacts can only open. Friction follows from the acceleration: a contact
slides with c_t = -mu Xi c_n and Xi A_t a > 0, or sticks with |c_t| <= mu (c_n - epsilon) and
A_t a = 0. With two degrees of freedom the modes are the sectors and rays between a few lines. If
none admits a nonzero acceleration, no plan exists. For a motion that comes to rest the acceleration
is against the direction of motion. Forces may be indeterminate here, as where only a finger starts;
the start modes of `simulation.rest` are those with forces that torques determine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import tangent_basis

MOVES = 1e-5  # least sum of accelerations, over the scene's own, that counts as a motion
PUSHES = 1e-3  # least component along one direction, over all forces, that moves the object
_SAME = 1e-9  # difference of two margins, over the scene's force, below which motions are the same
_STILL = 1e-9  # rate over the largest one below which something does not move
_PROBE = 1e-6  # steps that slopes of limits are taken over, in radii of gyration and rad
_KINK = 1e-3  # difference of slopes on both sides, in radii of gyration, from which there is a kink
_LEVEL = 1e-6  # slope of a limit, in radii of gyration, below which no motion changes it


class BlockedStart(NamedTuple):
    """The contact with the largest tension, in the mode where that is least."""

    contact: str  # empty if torques alone prevent a motion
    short: float  # least shortfall of c_n below epsilon


class _Margin(NamedTuple):
    """Largest margin of a mode, with its acceleration (5,) and normal forces (n_c,)."""

    value: float
    acceleration: Array
    c_n: Array


def find_block(
    formation: Formation, z: Array, epsilon: float, ends: bool = False
) -> BlockedStart | None:
    """Why no motion begins from rest at `z`, (5,), or `ends` there; None if one may.

    Formations with more than two degrees of freedom always may.
    """
    best, modes = None, list(_list_modes(formation, z, ends))
    for mode in modes:
        margin = _maximise(formation, mode, epsilon)
        if margin is not None and margin.value >= 0:
            return None
        if margin is not None and (best is None or margin.value > best.value):
            best = margin
    if best is None:
        return BlockedStart("", 0.0) if modes else None
    # Contacts that lack equally much: the first, not the one that rounding chooses.
    equal = best.c_n <= best.c_n.min() + _SAME * formation.scene.scales.force
    return BlockedStart(formation.names[int(equal.argmax())], -best.value)


def find_change(
    formation: Formation, z: Array, epsilon: float, finger: int | None, ends: bool = False
) -> float | None:
    """Limit with which a motion can begin from rest at `z`, or end there; None if there is none.

    The least torque limit of a finger, or for None the largest epsilon.
    """
    modes = _list_modes(formation, z, ends)
    if finger is None:
        margins = [_maximise(formation, mode, 0.0, cones=True) for mode in modes]
        return max((m.value for m in margins if m is not None and m.value >= 0), default=None)
    margins = [_maximise(formation, mode, epsilon, finger=finger) for mode in modes]
    return min((-m.value for m in margins if m is not None), default=None)


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


def list_ways(rates: Array) -> list[Array]:
    """One acceleration, shape (f,), for each combination of signs of rates, shape (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _STILL * np.abs(rates).max()]
    across = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = np.unique(np.round(np.concatenate([across, across + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


class _Mode(NamedTuple):
    """A contact mode: accelerations are N y, with rates and opens @ y."""

    z: Array  # (5,)
    N: Array  # (5, f)
    rates: Array  # (n_c + 2, f): of sliding and turning
    opens: Array  # (k, f): of closed gaps, that can only open
    signs: Array  # (n_c + 2,): of the motion that begins or ends, zero for what sticks or is held


def _list_modes(formation: Formation, z: Array, ends: bool) -> Iterator[_Mode]:
    """Every mode of a motion with one or two degrees of freedom; none with more."""
    N = tangent_basis(formation, z)
    N = N / np.array([1.0, 1.0, *(3 * [formation.scene.polygon.gyration_radius**2])])[:, None]
    if not 1 <= N.shape[1] <= 2:
        return
    rates = np.vstack([formation.evaluate(z[None], np.zeros((1, 5))).A_t[0], np.eye(5)[3:]]) @ N
    opens = _list_opening(formation, z) @ N
    opens = opens[np.abs(opens).max(axis=1, initial=0.0) > _LEVEL]
    side, least = -1.0 if ends else 1.0, _STILL * np.abs(rates).max()
    for way in list_ways(rates):
        speed = rates @ way
        signs = np.sign(np.where(np.abs(speed) > least, speed, 0))
        signs[list(formation.rolling_rows)] = 0.0
        yield _Mode(z, side * N, rates, side * opens, signs)


def _list_opening(formation: Formation, z: Array) -> Array:
    """Slopes of the closed gaps at `z`, shape (n, 5): from rest these may only open.

    Without those that have a kink there, as where a fingertip is at a vertex: no slope is theirs.
    """
    here = formation.evaluate_limits(z[None])[0]
    met = np.abs(here) < formation.scene.touching
    steps = _PROBE * np.diag([*[formation.scene.scales.length] * 2, 1.0, 1.0, 1.0])
    around = formation.evaluate_limits(z + np.vstack([steps, -steps]))[:, met]
    ahead, behind = (part.T / steps.diagonal() for part in np.split(around - here[met], 2))
    smooth = np.abs(ahead + behind).max(axis=1, initial=0.0) < _KINK * formation.scene.scales.length
    return np.asarray((ahead - behind)[smooth] / 2)


def _maximise(
    formation: Formation,
    mode: _Mode,
    epsilon: float,
    cones: bool = False,
    finger: int | None = None,
) -> _Margin | None:
    """The largest r with c_n >= epsilon + r in a motion; None without any.

    `cones` take epsilon + r for epsilon, too. With a `finger` its torque is at most -r, and
    c_n >= epsilon.
    """
    from scipy.optimize import linprog

    scene, n_c, mu = formation.scene, formation.n_contacts, formation.friction
    N, signs, f = mode.N, mode.signs, mode.N.shape[1]
    at = formation.evaluate(mode.z[None], np.zeros((1, 5)))
    A, A_t, joints = at.A[0], at.A_t[0], np.eye(5)[:, 3:]
    sticks, held, moving = np.flatnonzero(signs[:n_c] == 0), signs[n_c:] == 0, signs != 0
    # Unknowns are y, c_n, c_t of what sticks, friction of joints that are held, tau and r.
    slip = (A - (mu * signs[:n_c])[:, None] * A_t).T
    forces = [-scene.mass_diagonal[:, None] * N, slip, A_t[sticks].T, joints[:, held], joints]
    balance = np.hstack([*forces, np.zeros((5, 1))])
    one = np.eye(balance.shape[1])
    y, c_n, others = np.split(one, [f, f + n_c])
    c_t, tau, r = others[: len(sticks)], others[-3:-1], others[-1]
    motion = signs[moving, None] * mode.rates[moving] @ y
    dry = scene.dry * np.array([0.0, 0.0, 0.0, *signs[n_c:]])
    edges, least = mu[sticks, None] * (c_n[sticks] - cones * r), epsilon * mu[sticks]
    rows = [c_n - (finger is None) * r, edges - c_t, edges + c_t, motion, mode.opens @ y]
    lows = [np.full(n_c, epsilon), least, least, np.zeros(len(motion) + len(mode.opens))]
    rows, lows = [*rows, motion.sum(axis=0)[None]], [*lows, np.array([MOVES])]
    limits = scene.torque_limit.copy()
    if finger is not None:
        limits[finger] = math.inf
        rows, lows = [*rows, np.stack([-r - tau[finger], -r + tau[finger]])], [*lows, np.zeros(2)]
    bounds = np.tile([-np.inf, np.inf], (len(one), 1))
    most = np.concatenate([scene.dry[3:][held], limits])
    bounds[-1 - len(most) : -1] = np.stack([-most, most], axis=1)
    answer: Any = linprog(
        -r,
        A_ub=-np.vstack(rows),
        b_ub=-np.concatenate(lows),
        A_eq=np.vstack([balance, mode.rates[~moving] @ y]),
        b_eq=np.append(dry - scene.applied_force, np.zeros((~moving).sum())),
        bounds=bounds,
    )
    if answer.status != 0:
        return None
    return _Margin(float(answer.x[-1]), N @ answer.x[:f], c_n @ answer.x)
