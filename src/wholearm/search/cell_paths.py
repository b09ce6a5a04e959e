"""Least times of straight paths in (x, phi) through cells, by a vectorized speed sweep.

With three contacts there is no internal force: forces and torques follow from speed and
acceleration. Each cell has one contact of palm and each finger: all paths share one `LimitSet`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers, contact_table, first_contact
from ..contacts.explicit import move
from ..contacts.formation import Formation
from ..mechanics.dynamics import ONE, Directions, force_rows, inverse
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits
from ..planning.lower_bound.path_terms import GIVE
from ..planning.lower_bound.speed_sweep import make_cosine_grid, speed_sweep
from ..scene.model import Scene

NODES = 12  # intervals of a path

STEPS, MIDDLES, PART = make_cosine_grid(NODES)
"""Intervals over the path's length, and the places in them where limits are kept."""


def list_middles(starts: Array, ends: Array) -> Array:
    """Poses at `MIDDLES` of paths between poses (n, 2), shape (n, NODES, 2)."""
    return np.asarray(starts[:, None] + MIDDLES[:, None] * (ends - starts)[:, None])


def can_start(scene: Scene, epsilon: float, labels: Numbers, poses: Array, runs: Array) -> Flags:
    """Whether motions along straight paths can start from rest, shape (n,); see `time_paths`."""
    return _evaluate(scene, epsilon, labels, poses, runs).can_rest()


def time_paths(scene: Scene, epsilon: float, labels: Numbers, starts: Array, ends: Array) -> Array:
    """Least times of straight paths inside cells from rest to rest, or infinite, shape (n,).

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
    labels, runs = np.repeat(labels, NODES, axis=0), np.repeat(ends - starts, NODES, axis=0)
    rows, cap = _evaluate(scene, epsilon, labels, poses, runs)
    limits = PathLimits(rows.reshape(-1, NODES, *rows.shape[1:]), cap.reshape(-1, NODES))
    return speed_sweep(limits, STEPS, PART, sweeps=2).find_durations(STEPS)


def _evaluate(
    scene: Scene, epsilon: float, labels: Numbers, poses: Array, runs: Array
) -> PathLimits:
    """Limits of acceleration and speed at n places of straight paths."""
    at, (formation, limits) = move(scene, labels, poses, runs), _make_limits(scene, epsilon)
    directions, kinematics = Directions.of(at.kinematics, at.z_u), at.kinematics
    try:
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    except np.linalg.LinAlgError:
        wrenches = force_rows(formation, kinematics, directions)[:, :, :3]
        unheld = np.equal(np.linalg.det(wrenches), 0.0).reshape(-1, 1, 1)
        kinematics = kinematics._replace(A=np.where(unheld, np.nan, kinematics.A))
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    rows, cap = PathLimits.of(limits, forces, at.z_u[:, 3:], GIVE).eliminate()
    # No motion where three contacts cannot balance the object.
    held = np.asarray(np.isfinite(rows).all(axis=(1, 2)))
    rows = np.where(held[:, None, None], rows, -np.eye(rows.shape[-1])[ONE])
    return PathLimits(rows, np.where(held, cap, 0.0))


@lru_cache(maxsize=8)
def _make_limits(scene: Scene, epsilon: float) -> tuple[Formation, LimitSet]:
    """Three sliding contacts and their limits, which are the same for all such formations."""
    some = (0, first_contact(scene, 0), first_contact(scene, 1))
    formation = Formation(scene, tuple(contact_table(scene)[k] for k in some))
    return formation, make_limits(formation, epsilon)
