"""Whether contact forces can hold a formation at rest, whatever they are."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..scene.model import Scene

BALANCED = 1e-6
"""Pull that counts as none, relative to the scene's force: the accuracy of the linear programme."""


def balances(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> bool:
    """Whether contact forces inside the friction cones balance gravity and torques at rest."""
    return measure_lack(scene, contacts, z, tau)[0] <= 0


def measure_lack(
    scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array
) -> tuple[float, Array]:
    """How much pull is needed beyond what counts as none, and its rise with the torques.

    See `find_pulls`. The sum of the pulls is convex in the torques: elsewhere it is at least what
    the rise, from the dual solution, makes of it.

    Returns
    -------
    lack : float, [N]
        Infinite if none balance.
    rise : ndarray, shape (2,), [1/m]
    """
    answer, scales = _solve(scene, contacts, z, tau), scene.scales
    if answer.status:
        return np.inf, np.zeros(2)
    lack = scales.force * (answer.fun - BALANCED)
    return float(lack), -np.asarray(answer.eqlin.marginals)[3:] / scales.length


def find_pulls(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Array:
    """Least pulls with which contact forces balance gravity and torques at rest.

    A linear programme in c_n >= 0, c_t within U c_n, dry joint friction within D and a pull p >= 0
    of each contact: least sum of p with g + S (tau - friction) + A^T (c_n - p) + A_t^T c_t = 0.

    Parameters
    ----------
    contacts : tuple of Contact
        All that touch.
    z : ndarray, shape (5,)
    tau : ndarray, shape (2,), [N m]

    Returns
    -------
    ndarray, shape (n,), [N]
        Pull of each contact, infinite if none balance; all zero if no contact has to pull.
    """
    answer, n_c = _solve(scene, contacts, z, tau), len(contacts)
    return scene.scales.force * answer.x[-n_c:] if answer.status == 0 else np.full(n_c, np.inf)


def _solve(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Any:
    """Solve the linear programme of `find_pulls`, with forces in the scene's force."""
    from scipy.optimize import linprog

    touching, scales = _formation(scene, contacts), scene.scales
    # Forces count in the scene's force, torques in its torque.
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    kinematics = touching.evaluate(z[None], np.zeros((1, 5)))
    n_c = touching.n_contacts
    normal, tangential = ((rows / units).T for rows in (kinematics.A[0], kinematics.A_t[0]))
    joints = np.eye(5)[:, 3:]
    balance = np.hstack([normal, tangential, -joints, -normal])
    load = (scene.applied_force + joints @ tau) / (scales.force * units)
    cone, unit, none = -np.diag(touching.friction), np.eye(n_c), np.zeros((n_c, 2 + n_c))
    within = np.vstack([np.hstack([cone, sign * unit, none]) for sign in (1.0, -1.0)])
    free, pressing = [(None, None)] * n_c, [(0.0, None)] * n_c
    return linprog(
        np.repeat([0.0, 1.0], [2 * n_c + 2, n_c]),
        A_ub=within,
        b_ub=np.zeros(2 * n_c),
        A_eq=balance,
        b_eq=-load,
        bounds=[*pressing, *free, *((-d, d) for d in scene.dry[3:] / scales.torque), *pressing],
        method="highs",
    )


@lru_cache(maxsize=64)
def _formation(scene: Scene, contacts: tuple[Contact, ...]) -> Formation:
    return Formation(scene, contacts)
