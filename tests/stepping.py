"""Moreau's time stepping with Coulomb friction at contacts and dry friction at joints.

Nothing is assumed about what presses, slides or sticks: each step is one complementarity problem in
impulses, solved by a semismooth Newton method, in plain NumPy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plane import stack_rows
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation


def march(
    formation: Formation, z: Array, v: Array, torque: Callable[[float], Array], stop: float, n: int
) -> tuple[Array, Array]:
    """States after each of n equal steps from time 0, shape (n, 5) each.

    Parameters
    ----------
    formation : Formation
        Of vertex contacts, all that touch; whether they roll or slide is not looked at.
    """
    scene = formation.scene
    body, links = scene.polygon, scene.fingers
    assert body.inertia is not None
    mass = np.array([body.mass, body.mass, body.inertia, *(link.inertia for link in links)])
    drag = np.array([0.0, 0.0, 0.0, *(link.viscous for link in links)])
    dry = np.array([link.dry for link in links])
    weight = np.array([0.0, -body.mass * scene.gravity, 0.0, 0.0, 0.0])
    h = stop / n
    p = np.zeros(2 * formation.n_contacts + 2)
    states = []
    for k in range(n):
        middle = z + h / 2 * v
        N, T = stack_rows(formation, middle)
        rows = np.vstack([N, T, np.eye(5)[3:]])
        push = weight - drag * v
        push[3:] += torque((k + 0.5) * h)
        free = v + h * push / mass
        p = _solve((rows / mass) @ rows.T, rows @ free, formation.friction, h * dry, p)
        v = free + rows.T @ p / mass
        z = middle + h / 2 * v
        states.append(np.concatenate([z, v]))
    z_all, v_all = np.split(np.array(states), 2, axis=1)
    return z_all, v_all


def _solve(W: Array, b: Array, mu: Array, most: Array, p: Array) -> Array:
    """Impulses p with u = W p + b: contacts press, and friction is within its bounds and opposes.

    Each condition is p = its projection of p - r u, as of Alart and Curnier.
    """
    count = len(mu)
    r = 1 / np.diag(W)
    for turn in range(200):
        wanted = p - r * (W @ p + b)
        shift = np.eye(len(p)) - r[:, None] * W
        pressing = wanted[:count] > 0
        normal = np.where(pressing, wanted[:count], 0.0)
        d_normal = np.where(pressing[:, None], shift[:count], 0.0)
        bound = np.concatenate([mu * normal, most])
        d_bound = np.vstack([mu[:, None] * d_normal, np.zeros((2, len(p)))])
        free, d_free = wanted[count:], shift[count:]
        inside = np.abs(free) <= bound
        sign = np.sign(free)
        target = np.concatenate([normal, np.where(inside, free, sign * bound)])
        slope = np.vstack([d_normal, np.where(inside[:, None], d_free, sign[:, None] * d_bound)])
        miss = p - target
        # A flush edge leaves it open how its vertices share their friction.
        step = np.linalg.lstsq(np.eye(len(p)) - slope, miss, rcond=1e-12)[0]
        # Full steps may go round in circles.
        p = p - step * (1.0 if turn < 20 else 0.3)
        if np.abs(step).max() <= 1e-13 * max(np.abs(p).max(), 1e-12):
            return p
    raise AssertionError("the complementarity problem was not solved")
