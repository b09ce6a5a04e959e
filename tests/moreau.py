"""Plastic impacts as a complementarity problem (Moreau), in plain NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from plane import stack_rows
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation


class Collision(NamedTuple):
    """Velocity after an impact, and what each contact does.

    Attributes
    ----------
    v : ndarray, shape (5,)
    rates, slips : ndarray, shape (n_c,), [m/s]
        How fast contacts part and slide.
    normal, tangential : ndarray, shape (n_c,), [N s]
    """

    v: Array
    rates: Array
    slips: Array
    normal: Array
    tangential: Array


def collide(formation: Formation, z: Array, v: Array, sweeps: int = 20_000) -> Collision:
    """Contacts press or part, slide or stick, each on its own terms, until all agree.

    At every contact 0 <= p_n, 0 <= u_n, p_n u_n = 0 and Coulomb's law between p_t and u_t, by
    nonlinear Gauss-Seidel sweeps. Nothing is assumed about which contacts press or which way they
    slide.

    Parameters
    ----------
    formation : Formation
        Of vertex contacts, all that touch.
    z, v : ndarray, shape (5,)
        Configuration, and velocity before.
    """
    scene, body = formation.scene, formation.scene.polygon
    assert body.inertia is not None
    mass = np.array([body.mass, body.mass, body.inertia, *(f.inertia for f in scene.fingers)])
    N, T = stack_rows(formation, z)
    count, v = len(N), v.copy()
    p = np.zeros((2, count))
    rows = np.stack([N, T])
    lifts = rows / mass
    weights = (rows * lifts).sum(axis=2)
    for _ in range(sweeps):
        before = v.copy()
        for k in range(count):
            for axis in range(2):
                wanted = p[axis, k] - rows[axis, k] @ v / weights[axis, k]
                bound = formation.friction[k] * p[0, k]
                new = max(0.0, wanted) if axis == 0 else min(max(wanted, -bound), bound)
                v += lifts[axis, k] * (new - p[axis, k])
                p[axis, k] = new
        if np.abs(v - before).max() < 1e-15:
            break
    return Collision(v, N @ v, T @ v, p[0], p[1])
