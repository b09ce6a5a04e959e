"""Static balance by a linear programme set up on its own."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation

PULL = 1e-6  # sum of pulls that counts as none, over the scene's force


def balances(touching: Formation, z: Array, tau: Array, least: float = 0.0) -> bool:
    """Whether forces with c_n >= least and |c_t| <= mu (c_n - least) balance everything at rest.

    Contacts pull as little as possible besides, which counts as rounding up to `PULL`.
    """
    scene, count = touching.scene, touching.n_contacts
    at = touching.evaluate(z[None], np.zeros((1, 5)))
    joints = np.eye(5)[:, 3:]
    dry = zip(-scene.dry[3:], scene.dry[3:], strict=True)
    cone, one, none = np.diag(touching.friction), np.eye(count), np.zeros((count, count + 2))
    answer = linprog(
        np.repeat([0.0, 1.0], [2 * count + 2, count]),
        A_ub=np.vstack([np.hstack([-cone, way * one, none]) for way in (1.0, -1.0)]),
        b_ub=np.tile(-touching.friction * least, 2),
        A_eq=np.hstack([at.A[0].T, at.A_t[0].T, -joints, -at.A[0].T]),
        b_eq=-(scene.applied_force + joints @ tau),
        bounds=[*[(least, None)] * count, *[(None, None)] * count, *dry, *[(0, None)] * count],
    )
    return bool(answer.status == 0 and answer.fun <= PULL * scene.scales.force)
