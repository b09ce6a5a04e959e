"""Static torque polygon: torques under which friction can hold a formation at rest.

With the edges of the friction cones as columns E, amounts e >= 0 and joint friction d, balance is

    g + S (tau - d) + E e = 0,   e >= 0,   |d| <= D.

Its projection onto the torques is a convex polygon, perhaps unbounded. Corners are basic solutions
of the object's three rows, rays are internal forces. Beyond it a motion begins in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..scene.model import Scene

SURE = 1e-3  # distance from torques that friction can hold, over the scene's, at which it moves
_TINY = 1e-9  # what counts as zero of numbers of the order of one


class StaticTorques(NamedTuple):
    """The polygon normals @ tau <= bounds, with normals of length one."""

    normals: Array  # (m, 2)
    bounds: Array  # (m,) [N m]: a single one of minus infinity where nothing can be held

    def measure(self, tau: Array) -> Array:
        """How far torques, shape (n, 2), are beyond the polygon; negative inside, (n,) [N m]."""
        if not len(self.normals):
            return np.full(len(tau), -np.inf)
        return np.asarray((tau @ self.normals.T - self.bounds).max(axis=1))

    def is_empty(self, limit: Array) -> bool:
        """Whether no torques up to `limit`, shape (2,) [N m], maybe infinite, are inside."""
        from scipy.optimize import linprog

        if not np.isfinite(self.bounds).all():
            return True
        sides = [(-own, own) for own in limit]
        return bool(linprog(np.zeros(2), self.normals, self.bounds, bounds=sides).status == 2)


def find_static_torques(
    touching: Sequence[Formation], z: Array, least: float = 0.0
) -> StaticTorques:
    """Torque polygon in which contact forces and joint friction can balance gravity at `z`, (5,).

    `touching` are formations with all contacts that touch; `least` [N] is the apex of every cone,
    c_n >= least and |c_t| <= mu (c_n - least).
    """
    scene = touching[0].scene
    rows: dict[Contact, tuple[Array, Array]] = {}
    for formation in touching:
        kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        slip = formation.friction[:, None] * kinematics.A_t[0]
        rows |= dict(zip(formation.contacts, zip(kinematics.A[0], slip, strict=True), strict=True))
    # Edges of all cones, (2 n_c, 5), and normals, (n_c, 5), as forces on (q, theta).
    edges = np.array([normal + sign * slip for normal, slip in rows.values() for sign in (-1, 1)])
    normals = np.array([normal for normal, _ in rows.values()])
    static = _project(scene, edges, scene.applied_force + least * normals.sum(axis=0))
    return static._replace(bounds=static.bounds + np.abs(static.normals) @ scene.dry[3:])


def _project(scene: Scene, edges: Array, applied: Array) -> StaticTorques:
    """Torques that balance an applied force, shape (5,), with nonnegative amounts of the edges."""
    scales = scene.scales
    # Forces count in the scene's force, torques in its torque.
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    edges, load = edges / units, applied[:3] / (scales.force * units[:3])
    E, joints = edges[:, :3], -edges[:, 3:]
    corners, rays = _find_corners(E, joints, load), _find_rays(E, joints)
    if not len(corners):
        return StaticTorques(np.array([[1.0, 0.0]]), np.array([-np.inf]))
    hull = _find_hull(corners)
    sides = np.concatenate([np.roll(hull, -1, axis=0) - hull, rays, np.eye(2)])
    sides = sides[np.linalg.norm(sides, axis=1) > _TINY]
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    normals = np.concatenate([normals, -normals])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = normals[(normals @ rays.T <= _TINY).all(axis=1)]
    bounds = scales.torque * (normals @ hull.T).max(axis=1) if len(normals) else np.zeros(0)
    return StaticTorques(normals, bounds - normals @ applied[3:])


def _find_corners(E: Array, joints: Array, load: Array) -> Array:
    """Torques of the basic solutions of E^T e = -load with e >= 0, shape (m, 2)."""
    chosen = _choose(len(E), 3)
    matrix = E[chosen].transpose(0, 2, 1)
    # Elimination of a singular matrix may divide by zero; its determinant is zero, or not a number.
    with np.errstate(all="ignore"):
        regular = np.abs(np.linalg.det(matrix)) > _TINY
    matrix, chosen = matrix[regular], chosen[regular]
    amounts = np.linalg.solve(matrix, np.broadcast_to(-load[:, None], (len(matrix), 3, 1)))[..., 0]
    held = (amounts >= -_TINY).all(axis=1)
    return np.asarray(np.einsum("ni,nij->nj", amounts[held], joints[chosen[held]]))


def _find_rays(E: Array, joints: Array) -> Array:
    """Unit torques of internal forces, E^T e = 0 with e >= 0, shape (m, 2)."""
    chosen = _choose(len(E), 4)
    minors = [np.linalg.det(np.delete(E[chosen], k, axis=1)) for k in range(4)]
    null = np.stack([minors[0], -minors[1], minors[2], -minors[3]], axis=1)
    sizes = np.linalg.norm(null, axis=1)
    null, chosen = null[sizes > _TINY] / sizes[sizes > _TINY, None], chosen[sizes > _TINY]
    null *= np.where(null.sum(axis=1) < 0, -1.0, 1.0)[:, None]
    internal = (null >= -_TINY).all(axis=1)
    rays = np.einsum("ni,nij->nj", null[internal], joints[chosen[internal]])
    sizes = np.linalg.norm(rays, axis=1)
    return np.asarray(rays[sizes > _TINY] / sizes[sizes > _TINY, None])


def _find_hull(points: Array) -> Array:
    """Corners of the convex hull of points in the plane, in order, (m, 2): Andrew's algorithm."""
    ordered = sorted(set(map(tuple, points.tolist())))
    halves = []
    for way in (ordered, ordered[::-1]):
        half: list[tuple[float, float]] = []
        for point in way:
            while len(half) > 1:
                (a, b), (c, d), (e, f) = half[-2], half[-1], point
                if (c - a) * (f - b) - (d - b) * (e - a) > 0:
                    break
                half.pop()
            half.append(point)
        halves.append(half)
    return np.array((halves[0][:-1] + halves[1][:-1]) or ordered)


@lru_cache(maxsize=16)
def _choose(count: int, k: int) -> NDArray[np.int64]:
    """Every choice of k out of `count` rows, shape (m, k)."""
    return np.array(list(combinations(range(count), k)), dtype=np.int64).reshape(-1, k)
