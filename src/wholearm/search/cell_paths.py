"""Straight ways in x and phi through cells: whether motions set out along them, and their times.

With three contacts, forces and torques along a way follow from speed and acceleration, as there is
no squeeze, and a sweep over the phase plane gives the least time. All cells have one contact each
with palm and fingers, so that ways through different ones are looked at together.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers, contact_table, first_contact
from ..contacts.explicit import move
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, force_rows, inverse
from ..mechanics.limits import LimitSet, make_limits
from ..planning.lower_bound.rows import PathLimitRows, limit
from ..scene.model import Scene
from .travel_times import find_durations

NODES = 12  # Intervals of a way

_ENDS = (1 - np.cos(np.linspace(0, np.pi, NODES + 1))) / 2
MIDDLES = (_ENDS[1:] + _ENDS[:-1]) / 2
"""Shares of a way that are behind at its places, where limits are kept."""


def list_middles(starts: Array, ends: Array) -> Array:
    """Poses at the places of ways between poses (n, 2), shape (n, NODES, 2)."""
    return np.asarray(starts[:, None] + MIDDLES[:, None] * (ends - starts)[:, None])


def can_set_out(scene: Scene, epsilon: float, labels: Numbers, poses: Array, ways: Array) -> Flags:
    """Whether motions along straight ways can begin from rest, shape (n,); see `time_ways`."""
    rows = _evaluate(scene, epsilon, labels, poses, ways)
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = -rows.one / rows.a
        least = np.where(rows.a > 0, bounds, 0.0).max(axis=1)
        most = np.where(rows.a < 0, bounds, np.inf).min(axis=1)
    never = ((rows.a == 0) & (rows.one < 0)).any(axis=1)
    return np.asarray((np.maximum(least, 0.0) < most) & ~never)


def time_ways(scene: Scene, epsilon: float, labels: Numbers, starts: Array, ends: Array) -> Array:
    """Least times of straight ways inside cells from rest to rest, infinite without, shape (n,).

    Parameters
    ----------
    epsilon : [N]
    labels : (n, 3)                 contacts of each with palm, finger 1 and finger 2, by
                                    `closing.contact_table`
    starts, ends : (n, 2) [m, rad]  poses (x, phi)
    """
    if not len(ends):
        return np.zeros(0)
    poses = list_middles(starts, ends).reshape(-1, 2)
    labels, ways = np.repeat(labels, NODES, axis=0), np.repeat(ends - starts, NODES, axis=0)
    rows = _evaluate(scene, epsilon, labels, poses, ways)
    rows = PathLimitRows(*(part.reshape(-1, NODES, *part.shape[1:]) for part in rows))
    return find_durations(rows, np.diff(_ENDS), (MIDDLES - _ENDS[:-1]) / np.diff(_ENDS))


def _evaluate(
    scene: Scene, epsilon: float, labels: Numbers, poses: Array, ways: Array
) -> PathLimitRows:
    """Limits at n places of straight ways, as what they are of acceleration and speed."""
    at, (formation, limits) = move(scene, labels, poses, ways), _make_limits(scene, epsilon)
    directions, kinematics = Directions.of(at.kinematics, at.z_u), at.kinematics
    try:
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    except np.linalg.LinAlgError:
        wrenches = force_rows(formation, kinematics, directions)[:, :, :3]
        unheld = np.equal(np.linalg.det(wrenches), 0.0).reshape(-1, 1, 1)
        kinematics = kinematics._replace(A=np.where(unheld, np.nan, kinematics.A))
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    rows = limit(limits, forces, at.z_u[:, 3:])
    # Three contacts that do not hold the object let nothing through.
    held = np.asarray(np.isfinite(rows.a + rows.b + rows.v + rows.one).all(axis=1))[:, None]
    a, b, v = (np.where(held, part, 0.0) for part in (rows.a, rows.b, rows.v))
    return PathLimitRows(
        a, b, v, np.where(held, rows.one, -1.0), np.where(held[:, 0], rows.cap, 0.0)
    )


@lru_cache(maxsize=8)
def _make_limits(scene: Scene, epsilon: float) -> tuple[Formation, LimitSet]:
    """Three contacts that slide, and their limits: the same wherever on palm and fingers."""
    some = (0, first_contact(scene, 0), first_contact(scene, 1))
    formation = Formation(scene, tuple(contact_table(scene)[k] for k in some))
    return formation, make_limits(formation, epsilon)
