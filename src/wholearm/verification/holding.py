"""Changes of the torques with which a formation at rest keeps its contacts.

It either begins to move, in one of the ways in which friction lets it, or is held at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.limits import make_limits
from ..results.tuning import TorqueChange
from ..simulation.starting import Way
from ..simulation.sticking import find_rest
from .instants import Instant, answer
from .mending import KEPT, change_both, change_one, normalise, tell

_TORQUES = ((0,), (1,), (0, 1))
"""Which torques change: one alone, or both."""


def list_ways(formation: Formation, z: Array) -> Sequence[Way]:
    """The ways in which a formation at rest at `z` could begin to move."""
    return find_rest(formation, z).all_ways


def find_worst(formation: Formation, ways: Sequence[Way], z: Array, tau: Array) -> Instant | None:
    """Forces as torques begin a motion in the way that holds worst; None if they begin none."""
    load = np.array([1.0, *tau])
    free = [way for way in ways if way.slides(tau)]
    if not free:
        return None
    return _answer(formation, z, min(free, key=lambda way: float((way.force_limits @ load).min())))


def find_resting_changes(
    formation: Formation,
    ways: Sequence[Way],
    epsilon: float,
    z: Array,
    tau: Array,
    gradient: Array | None,
) -> tuple[TorqueChange, ...]:
    """Least changes of each torque alone, or else of both, that let it keep its contacts.

    With them it begins to move towards the end of its phase, or if that cannot be it rests.

    Parameters
    ----------
    formation : Formation
    ways : sequence of Way
        See `list_ways`.
    epsilon : float, [N]
    z : ndarray, shape (5,)
    tau : ndarray, shape (2,), [N m]
    gradient : ndarray, shape (5,), or None
        Of the distance to the end of the phase, if that is known.
    """
    moved = [_move(formation, way, epsilon, z, tau, gradient) for way in ways]
    found: list[TorqueChange] = []
    for k, free in enumerate(_TORQUES):
        known = [change for own in moved if (change := own[k]) is not None]
        if len(free) == 2 and found:
            break
        held = None if known else _hold(formation, epsilon, z, tau, free)
        if known:
            found.append(tell(min(known, key=np.linalg.norm), tau))
        elif held is not None:
            found.append(tell(held, tau, holds=True))
    return tuple(sorted(found, key=lambda change: (change.holds, np.hypot(*change.change))))


def _answer(formation: Formation, z: Array, way: Way) -> Instant | None:
    return answer(formation, z, np.zeros(5), np.concatenate(way.directions))


def _move(
    formation: Formation, way: Way, epsilon: float, z: Array, tau: Array, gradient: Array | None
) -> list[Array | None]:
    """Least changes of one torque, the other and both with which it begins to move one way."""
    instant, much = _answer(formation, z, way), formation.scene.scales.torque
    if instant is None:
        return [None] * len(_TORQUES)
    limits = make_limits(formation, epsilon)
    rows = [row + np.array([offset, 0.0, 0.0]) for row, offset in way.margins]
    rows += [] if gradient is None else [-gradient @ instant.acceleration]
    sizes = np.abs(rows) @ [1.0, much, much]
    scale = np.concatenate([limits.scales[limits.sides[0]], np.where(sizes > 0, sizes, 1.0)])
    sides = np.vstack([instant.find_sides(limits), *rows])
    slack, slope = normalise(sides, scale, tau, much)
    tried = (change_one(slack, slope, 0), change_one(slack, slope, 1), change_both(slack, slope))

    def keep(change: Array | None) -> Array | None:
        if change is None or (slack + slope @ change < -KEPT).any():
            return None
        return much * change if way.moves(tau + much * change) else None

    return [keep(change) for change in tried]


def _hold(
    formation: Formation, epsilon: float, z: Array, tau: Array, free: tuple[int, ...]
) -> Array | None:
    """The change of the torques `free` with the least sum of sizes that holds it at rest.

    A linear programme in c_n >= epsilon, c_t within U c_n, dry joint friction within D and the
    torques, with g + S (tau - friction) + A^T c_n + A_t^T c_t = 0.
    """
    from scipy.optimize import linprog

    scene, n_c = formation.scene, formation.n_contacts
    scales = scene.scales
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    at = formation.evaluate(z[None], np.zeros((1, 5)))
    joints = np.eye(5)[:, 3:]
    # Unknowns are c_n, c_t, dry friction, and what each torque rises and falls by.
    balance = [(at.A[0] / units).T, (at.A_t[0] / units).T, -joints, joints, -joints]
    load = (scene.applied_force + joints @ tau) / (scales.force * units)
    cone, unit, none = -np.diag(formation.friction), np.eye(n_c), np.zeros((n_c, 6))
    within = [np.hstack([cone, sign * unit, none]) for sign in (1.0, -1.0)]
    room = [np.maximum(scene.torque_limit + side * tau, 0.0) for side in (-1.0, 1.0)]
    spare = np.where([k in free for k in (0, 1)], np.array(room) / scales.torque, 0.0)
    answered = linprog(
        np.repeat([0.0, 1.0], [2 * n_c + 2, 4]),
        A_ub=np.vstack(within),
        b_ub=np.zeros(2 * n_c),
        A_eq=np.hstack(balance),
        b_eq=-load,
        bounds=[
            *[(epsilon / scales.force, None)] * n_c,
            *[(None, None)] * n_c,
            *((-most, most) for most in scene.dry[3:] / scales.torque),
            *((0.0, most) for most in spare.ravel()),
        ],
        method="highs",
    )
    if answered.status != 0:
        return None
    rise, fall = answered.x[-4:-2], answered.x[-2:]
    return np.asarray(scales.torque * (rise - fall))
