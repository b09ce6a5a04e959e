"""The constrained equations of motion of object and fingers, forward and inverse.

Eqs. (1)-(4) are together (notation: `README.md`), with b = B z' + D sigma of the joints' friction,

    M5 z'' + b(z') = g + S tau + G^T c,   P z'' + P' z' = 0.

A sliding contact's c_t = -U Xi c_n is part of G, a rolling one's is free, in c. The equations are
solved in three ways:

* forward, tau to (z'', c): c from K c = -P' z' - P M5^-1 (g + S tau - b), K = P M5^-1 G^T;
* inverse, along a curve z(s) with speed s' and acceleration s'': the object's rows leave one free
  number, the internal force lambda, and the joints' rows then give tau;
* the paper's, Eqs. (6)-(16): everything but theta_1 eliminated (`verification.verify`).

Friction can make the reduced inertia vanish or turn negative (jamming). Its sign is that of
det(P M5^-1 G^T) / det(P M5^-1 P^T), which is 1 without friction: `reduced_inertia`.

Configurations are projected onto closed contacts by Gauss-Newton: `close_all`.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..contacts.formation import CurvePoint, Formation, Kinematics
from ..scene.model import Scene

Fixed = tuple[tuple[int, float | Array], ...]
"""Rows of z and their prescribed values, one or (n,)."""


class Directions(NamedTuple):
    """Signs of the velocities that friction opposes."""

    Xi: Array  # (n_c,): sliding directions of the contacts; ignored for rolling ones
    sigma: Array  # (2,): directions of the joints

    @staticmethod
    def of(kinematics: Kinematics, v: Array) -> Directions:
        """Signs of the sliding and joint velocities at velocities v, shape (n, 5)."""
        slip = np.einsum("nij,nj->ni", kinematics.A_t, v)
        return Directions(np.sign(slip), np.sign(v[:, 3:]))


ONE, A, B, V, LAMBDA = range(5)
"""Columns of coefficients along a path: of 1, a = s'', b = s'^2, s' and the internal force."""


class PathForces(NamedTuple):
    """Forces at n places of a path, as coefficients of (1, a, b, s', lambda).

    The forces are c = [c_n; c_t(rolling)] and the joint torques tau.
    """

    of_c: Array  # (n, n_c + R, 5) [N]
    of_tau: Array  # (n, 2, 5) [N m]

    def c(self, a: Array, b: Array, internal: Array) -> Array:
        """Contact forces, shape (n, n_c + R) [N], for a, b and lambda of shape (n,)."""
        return apply(self.of_c, a, b, internal)

    def tau(self, a: Array, b: Array, internal: Array) -> Array:
        """Joint torques, shape (n, 2) [N m], for a, b and lambda of shape (n,)."""
        return apply(self.of_tau, a, b, internal)


def stack_motion(a: Array, b: Array, internal: Array) -> Array:
    """Factors of the coefficients: (1, a, b, s', lambda), shape (n, 5)."""
    return np.stack([np.ones_like(b), a, b, np.sqrt(np.maximum(b, 0.0)), internal], axis=-1)


def apply(coefficients: Array, a: Array, b: Array, internal: Array) -> Array:
    """Values of coefficients, (n, ..., 5), for motions a, b and lambda of shape (n,)."""
    motion = stack_motion(a, b, internal)
    return np.asarray(np.einsum("n...q,nq->n...", coefficients, motion))


def forward(
    formation: Formation, kinematics: Kinematics, v: Array, tau: Array, directions: Directions
) -> tuple[Array, Array]:
    """Accelerations (n, 5) and contact forces (n, n_c + R) at velocities v under torques tau."""
    scene, G = formation.scene, force_rows(formation, kinematics, directions)
    P_M, applied = kinematics.P / scene.mass_diagonal, scene.applied_force - scene.viscous * v
    applied[:, 3:] += tau - scene.dry[3:] * directions.sigma
    rhs = -kinematics.P_dot_v - np.einsum("nij,nj->ni", P_M, applied)
    c = np.linalg.solve(P_M @ G.transpose(0, 2, 1), rhs[..., None])[..., 0]
    return (applied + np.einsum("nij,ni->nj", G, c)) / scene.mass_diagonal, c


def build_force_rows(
    formation: Formation, P: Expression, A_t: Expression, Xi: Expression
) -> Expression:
    """G, an expression of shape (n_c + R, 5), from those of P, A_t and Xi."""
    slip = ca.diag(ca.DM(formation.sliding_friction) * Xi) @ A_t
    return P - ca.vertcat(slip, ca.SX(formation.n_rolling, 5))


def split_forces(formation: Formation, c: Array, Xi: Array) -> tuple[Array, Array]:
    """Normal and tangential forces of every contact, (..., n_c) each, from c (..., n_c + R) [N]."""
    n_c = formation.n_contacts
    c_n = c[..., :n_c]
    c_t = np.asarray(-formation.sliding_friction * Xi * c_n)
    if formation.rolling:
        c_t[..., list(formation.rolling_rows)] = c[..., n_c:]
    return c_n, c_t


def reduced_inertia(formation: Formation, kinematics: Kinematics, directions: Directions) -> Array:
    """Reduced inertia over that without friction, (n,): jamming if not positive or not finite."""
    inverse_mass = 1 / formation.scene.mass_diagonal
    P = kinematics.P
    G = force_rows(formation, kinematics, directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.linalg.det((P * inverse_mass) @ G.transpose(0, 2, 1))
            / np.linalg.det((P * inverse_mass) @ P.transpose(0, 2, 1))
        )


def inverse(formation: Formation, point: CurvePoint, directions: Directions) -> PathForces:
    """Inverse dynamics along a curve, z' = z_s s', z'' = z_s s'' + z_ss s'^2.

    The object's rows M q'' = g + [W_n - W_t U Xi, W_t(rolling)] c leave four forces c one free
    number: the internal force lambda along a unit null vector; three leave none. `directions` are
    signs for motion along +s, in one row or n.
    """
    scene, (z, z_s, z_ss, kinematics) = formation.scene, point
    G = force_rows(formation, kinematics, directions)
    wrench = G[:, :, :3].transpose(0, 2, 1)
    mass, count = scene.mass_diagonal, wrench.shape[2]
    # At rank two, as for a tip on a vertex of a flush edge, the null vector is not unique.
    null = np.zeros((len(z), count)) if count == 3 else null_vector(wrench)
    rhs = np.zeros((len(z), count, 3))
    rhs[:, :3, ONE] = -scene.applied_force[:3]
    rhs[:, :3, A] = mass[:3] * z_s[:, :3]
    rhs[:, :3, B] = mass[:3] * z_ss[:, :3]
    # With the null vector as last row each solution has the least norm.
    matrix = wrench if count == 3 else np.concatenate([wrench, null[:, None, :]], axis=1)
    C = np.zeros((len(z), count, 5))
    C[..., :3], C[..., LAMBDA] = np.linalg.solve(matrix, rhs), null
    T = -np.einsum("nij,niq->njq", G[:, :, 3:], C)
    T[..., ONE] += scene.dry[3:] * directions.sigma
    T[..., A] += mass[3:] * z_s[:, 3:]
    T[..., B] += mass[3:] * z_ss[:, 3:]
    T[..., V] = scene.viscous[3:] * z_s[:, 3:]
    return PathForces(C, T)


def null_vector(matrix: Array, min_size: float = 0.0) -> Array:
    """Unit null vector of each (k, k + 1) matrix, by its minors (continuous), shape (n, k + 1).

    NaN if the norm of the minors is at most `min_size`: it is not unique.
    """
    count = matrix.shape[2]
    minors = [np.linalg.det(np.delete(matrix, k, axis=2)) for k in range(count)]
    null = np.stack(minors, axis=1) * (-1.0) ** np.arange(count)
    size = np.linalg.norm(null, axis=1)[:, None]
    return np.asarray(np.divide(null, size, out=np.full_like(null, np.nan), where=size > min_size))


def force_rows(formation: Formation, kinematics: Kinematics, directions: Directions) -> Array:
    """G at n configurations, shape (n, n_c + R, 5)."""
    slip = formation.sliding_friction * directions.Xi
    G = kinematics.A - slip[..., :, None] * kinematics.A_t
    if formation.rolling:
        G = np.concatenate([G, kinematics.P[:, formation.n_contacts :]], axis=1)
    return G


def metric_weights(scene: Scene) -> Array:
    """Diagonal of the metric of arc length, shape (5,): 1 for lengths, rho^2 for angles."""
    rho = scene.polygon.gyration_radius
    return np.array([1.0, 1.0, rho**2, rho**2, rho**2])


def solve_min_norm(P: Array, rhs: Array, metric: Array) -> Array:
    """Displacements of least norm with P dz = rhs, (n, n_p), in a diagonal metric, shape (n, 5)."""
    P_M = P / metric
    multipliers = np.linalg.solve(P_M @ P.transpose(0, 2, 1), rhs[..., None])[..., 0]
    return np.asarray(np.einsum("nij,ni->nj", P_M, multipliers))


def find_freedoms(P: Array, metric: Array, tolerance: float) -> Array:
    """Directions with P dz = 0 for P (n_p, 5), orthonormal in a diagonal metric, shape (5, f).

    Singular values up to `tolerance` times the largest one count as zero.
    """
    root = np.sqrt(metric)
    _, values, vectors = np.linalg.svd(P / root)
    return np.asarray(vectors[int((values > tolerance * values[0]).sum()) :].T / root[:, None])


def measure_speed(scene: Scene, v: Array) -> float:
    """Norm of a velocity [m/s] or displacement [m], shape (5,), in the metric of arc length."""
    return float(np.sqrt(metric_weights(scene) @ v**2))


def close_contacts(
    formation: Formation, z: Array, slip: Array, fixed: Fixed = (), active: tuple[int, ...] = ()
) -> Array | None:
    """As `close_all` for one configuration, shape (5,); None if there is none."""
    closed = close_all(formation, z[None], slip, fixed, active)[0]
    return closed if np.isfinite(closed).all() else None


def close_all(
    formation: Formation,
    z: Array,
    slip: Array,
    fixed: Fixed = (),
    active: tuple[int, ...] = (),
    metric: Array | None = None,
) -> Array:
    """Nearest configurations with all contacts closed, by Gauss-Newton, shape (n, 5), or NaN.

    Parameters
    ----------
    z : (n, 5)       initial values
    slip : (R,) [m]  slip coordinates of rolling contacts
    fixed            rows of z and their values
    active           limits of the formation that are zero
    metric : (5,)    diagonal of the metric, by default that of arc length
    """
    metric = metric_weights(formation.scene) if metric is None else metric
    rho = formation.scene.scales.length
    steps = 1e-5 * np.diag([rho, rho, 1.0, 1.0, 1.0])
    units = [rho if row < 2 else 1.0 for row, _ in fixed]
    sizes = np.array([rho] * formation.n_constraints + units + [rho] * len(active))
    solutions, z, remaining = np.full(z.shape, np.nan), z.copy(), np.arange(len(z))
    for _ in range(50):
        kinematics = formation.evaluate(z, np.zeros(z.shape))
        residual = np.hstack([kinematics.C, formation.evaluate_slip(z) - slip])
        rows = kinematics.P
        for row, value in fixed:
            values = np.broadcast_to(value, len(solutions))[remaining]
            residual = np.column_stack([residual, z[:, row] - values])
            unit = np.broadcast_to(np.eye(5)[row], (len(z), 1, 5))
            rows = np.concatenate([rows, unit], axis=1)
        if active:
            residual = np.hstack([residual, formation.evaluate_limits(z)[:, active]])
            neighbours = (z[:, None] + np.vstack([steps, -steps])).reshape(-1, 5)
            differences = formation.evaluate_limits(neighbours)[:, active].reshape(len(z), 2, 5, -1)
            slopes = (differences[:, 0] - differences[:, 1]) / (2 * steps.diagonal()[:, None])
            rows = np.concatenate([rows, slopes.swapaxes(1, 2)], axis=1)
        rows, residual = rows / sizes[:, None], residual / sizes
        lift = (rows / metric).swapaxes(1, 2)
        change = (lift @ np.linalg.pinv(rows @ lift, rcond=1e-12) @ residual[..., None])[..., 0]
        # Long steps of the angles could lead to another solution: at most a tenth of a radian.
        rotation = np.abs(change[:, 2:]).max(axis=1, keepdims=True)
        z = z - change * np.minimum(1.0, 0.1 / np.maximum(rotation, 1e-12))
        closed = np.abs(residual).max(axis=1) < 3e-11
        solutions[remaining[closed]] = z[closed]
        z, remaining = z[~closed], remaining[~closed]
        if not len(remaining):
            break
    return solutions
