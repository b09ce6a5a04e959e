"""Static equilibrium with Coulomb friction: torques that hold, and forces that would be missing.

With contact forces c_n, c_t inside the friction cones and friction d of the joints, balance is

    g + S (tau - d) + A^T c_n + A_t^T c_t = 0,   |c_t| <= mu c_n,   |d| <= D.

Its projection onto the torques is a convex polygon, perhaps unbounded. Corners are basic solutions
of the object's three rows, rays are internal forces. Beyond it a motion begins in any case; within
it friction may hold everything at rest (static indeterminacy).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..scene.model import Scene
from .dynamics import null_vector

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
        box = np.stack([-limit, limit], axis=1)
        return bool(linprog(np.zeros(2), self.normals, self.bounds, bounds=box).status == 2)


def find_static_torques(touching: Formation, z: Array, least: float = 0.0) -> StaticTorques:
    """Torque polygon in which contact forces and joint friction can balance gravity at `z`, (5,).

    `touching` has all contacts that touch; `least` [N] is the apex of every cone, c_n >= least and
    |c_t| <= mu (c_n - least).
    """
    scene, kinematics = touching.scene, touching.evaluate(z[None], np.zeros((1, 5)))
    normal, slip = kinematics.A[0], touching.friction[:, None] * kinematics.A_t[0]
    # Edges of all cones, (2 n_c, 5), as forces on (q, theta).
    edges = np.stack([normal - slip, normal + slip], axis=1).reshape(-1, 5)
    static = _project(scene, edges, scene.applied_force + least * normal.sum(axis=0))
    return static._replace(bounds=static.bounds + np.abs(static.normals) @ scene.dry[3:])


def _project(scene: Scene, edges: Array, applied: Array) -> StaticTorques:
    """Torques that balance an applied force, shape (5,), with nonnegative amounts of the edges."""
    scales = scene.scales
    # Forces count in the scene's force, torques in its torque.
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    edges, load = edges / units, applied[:3] / (scales.force * units[:3])
    E, joints = edges[:, :3], -edges[:, 3:]
    # Without friction the edges may leave a direction of the load out.
    _, values, basis = np.linalg.svd(E)
    basis = basis[: int((values > _TINY * values[0]).sum())]
    if np.abs(load - load @ basis.T @ basis).max() > _TINY:
        return StaticTorques(np.array([[1.0, 0.0]]), np.array([-np.inf]))
    E, load = E @ basis.T, basis @ load
    corners, rays = _find_corners(E, joints, load), _find_rays(E, joints)
    if not len(corners):
        return StaticTorques(np.array([[1.0, 0.0]]), np.array([-np.inf]))
    sides = np.concatenate([_find_sides(corners), rays, np.eye(2)])
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    normals = np.concatenate([normals, -normals])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = normals[(normals @ rays.T <= _TINY).all(axis=1)]
    bounds = scales.torque * (normals @ corners.T).max(axis=1)
    return StaticTorques(normals, bounds - normals @ applied[3:])


def _find_sides(corners: Array) -> Array:
    """Sides of the convex hull of points in the plane, (m, 2): all others are on one side."""
    first, second = corners[_choose(len(corners), 2)].swapaxes(0, 1)
    sides = second - first
    sides, first = (part[np.linalg.norm(sides, axis=1) > _TINY] for part in (sides, first))
    across = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    off = across @ corners.T - (across * first).sum(axis=1)[:, None]
    small = _TINY * np.linalg.norm(sides, axis=1)[:, None]
    return np.asarray(sides[(off <= small).all(axis=1) | (off >= -small).all(axis=1)])


def _find_corners(E: Array, joints: Array, load: Array) -> Array:
    """Torques of the basic solutions of E^T e = -load with e >= 0, shape (m, 2)."""
    chosen = _choose(len(E), E.shape[1])
    matrix = E[chosen].transpose(0, 2, 1)
    # Elimination of a singular matrix may divide by zero; its determinant is zero, or not a number.
    with np.errstate(all="ignore"):
        regular = np.abs(np.linalg.det(matrix)) > _TINY
    matrix, chosen = matrix[regular], chosen[regular]
    right = np.broadcast_to(-load[:, None], (len(matrix), len(load), 1))
    amounts = np.linalg.solve(matrix, right)[..., 0]
    held = (amounts >= -_TINY).all(axis=1)
    return np.asarray(np.einsum("ni,nij->nj", amounts[held], joints[chosen[held]]))


def _find_rays(E: Array, joints: Array) -> Array:
    """Unit torques of internal forces, E^T e = 0 with e >= 0, shape (m, 2)."""
    chosen = _choose(len(E), E.shape[1] + 1)
    null = null_vector(E[chosen].transpose(0, 2, 1), _TINY)
    null *= np.where(null.sum(axis=1) < 0, -1.0, 1.0)[:, None]
    internal = (null >= -_TINY).all(axis=1)
    rays = np.einsum("ni,nij->nj", null[internal], joints[chosen[internal]])
    sizes = np.linalg.norm(rays, axis=1)
    return np.asarray(rays[sizes > _TINY] / sizes[sizes > _TINY, None])


@lru_cache(maxsize=16)
def _choose(count: int, k: int) -> NDArray[np.int64]:
    """Every choice of k out of `count` rows, shape (m, k)."""
    return np.array(list(combinations(range(count), k)), dtype=np.int64).reshape(-1, k)


def find_pulls(touching: Formation, z: Array, tau: Array) -> Array:
    """Pulls p >= 0 of the contacts, (n_c,) [N], of least sum with which forces balance at rest.

    Contact forces are those of cones less p along the normals. Infinite if no pulls balance.
    """
    A = touching.evaluate(z[None], np.zeros((1, 5))).A[0]
    bounds = np.tile([0.0, np.inf], (len(A), 1))
    found = _balance(touching, z, tau, 0.0, -A.T, bounds)
    if found is None:
        return np.full(len(A), np.inf)
    return touching.scene.scales.force * found[-len(A) :]


def find_holding_change(
    touching: Formation, z: Array, tau: Array, least: float, free: tuple[int, ...]
) -> Array | None:
    """Change of the torques `free`, (2,) [N m], of least sum of sizes that holds at rest, or None.

    Torques stay within their limits, with c_n >= least [N] and |c_t| <= mu c_n.
    """
    scene = touching.scene
    most = [np.maximum(scene.torque_limit + side * tau, 0.0) for side in (-1.0, 1.0)]
    changes = np.where(np.isin([0, 1], free), most, 0.0).ravel() / scene.scales.torque
    joints = scene.scales.length * np.eye(5)[:, 3:]
    bounds = np.stack([np.zeros(4), changes], axis=1)
    found = _balance(touching, z, tau, least, np.hstack([joints, -joints]), bounds)
    return None if found is None else scene.scales.torque * (found[-4:-2] - found[-2:])


def find_firmest_forces(touching: Formation, z: Array, tau: Array) -> Array:
    """Contact forces c_n and c_t at rest with the largest least c_n, (2, n_c) [N]; NaN for none."""
    count, least = touching.n_contacts, np.array([[-np.inf, np.inf]])
    found = _balance(touching, z, tau, -np.inf, np.zeros((5, 1)), least, firmest=True)
    if found is None:
        return np.full((2, count), np.nan)
    return touching.scene.scales.force * found[: 2 * count].reshape(2, count)


def _balance(
    touching: Formation,
    z: Array,
    tau: Array,
    least: float,
    more: Array,
    bounds: Array,
    firmest: bool = False,
) -> Array | None:
    """Forces c_n, c_t, d and amounts x, (k,), of further ones `more`, (5, k), that balance at rest.

    A linear programme in c_n >= least [N], |c_t| <= mu c_n, |d| <= D and x within `bounds`, (k, 2),
    with the least sum of x, or the `firmest`, with the largest x below every c_n. None without any.
    Forces and x are in the scene's force, friction of the joints is in its torque.
    """
    from scipy.optimize import linprog

    scene, n_c = touching.scene, touching.n_contacts
    scales, at = scene.scales, touching.evaluate(z[None], np.zeros((1, 5)))
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    joints = np.eye(5)[:, 3:]
    load = (scene.applied_force + joints @ tau) / (scales.force * units)
    forces = np.hstack([at.A[0].T, at.A_t[0].T, -scales.length * joints, more]) / units[:, None]
    cone, one = -np.diag(touching.friction), np.eye(n_c)
    rows = np.block([[cone, one], [cone, -one], [-one, 0 * one]])
    rows = np.pad(rows, ((0, 0), (0, forces.shape[1] - 2 * n_c)))
    rows[2 * n_c :, -1] = 1.0
    rows = rows if firmest else rows[: 2 * n_c]
    dry = scene.dry[3:] / scales.torque
    normal, free = [(least / scales.force, np.inf)] * n_c, [(-np.inf, np.inf)] * n_c
    answer: Any = linprog(
        np.repeat([0.0, -1.0 if firmest else 1.0], [2 * n_c + 2, more.shape[1]]),
        A_ub=rows,
        b_ub=np.zeros(len(rows)),
        A_eq=forces,
        b_eq=-load,
        bounds=[*normal, *free, *zip(-dry, dry, strict=True), *bounds],
        # Forces that are missing just beyond balance are small.
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    return np.asarray(answer.x) if answer.status == 0 else None
