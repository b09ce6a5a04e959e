"""The constrained equations of motion of object and fingers, forward and inverse.

Eqs. (1)-(4) are together (notation: `README.md`), with b = B z' + D sigma of the joints' friction,

    M5 z'' + b(z') = g + S tau + G^T c,   P z'' + P' z' = 0.

A sliding contact's c_t = -U Xi c_n is part of G, a rolling one's is free, in c. Three routes
through the equations:

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
"""Rows of z, and values that they have to take, one or (n,)."""


class Directions(NamedTuple):
    """Signs that friction depends on."""

    Xi: Array  # (n_c,): sliding directions of the contacts; those of rolling ones do not count
    sigma: Array  # (2,): directions of the joints

    @staticmethod
    def of(kinematics: Kinematics, v: Array) -> Directions:
        """Those of contacts that slide and joints that turn with velocities, shape (n, 5)."""
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
    """What coefficients multiply: (1, a, b, s', lambda), shape (n, 5)."""
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
    over, applied = kinematics.P / scene.mass_diagonal, scene.applied_force - scene.viscous * v
    applied[:, 3:] += tau - scene.dry[3:] * directions.sigma
    right = -kinematics.P_dot_v - np.einsum("nij,nj->ni", over, applied)
    c = np.linalg.solve(over @ G.transpose(0, 2, 1), right[..., None])[..., 0]
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
    """Reduced inertia over the frictionless, (n,): jamming at zero and below, or not finite."""
    inverse_mass = 1 / formation.scene.mass_diagonal
    P = kinematics.P
    G = force_rows(formation, kinematics, directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.linalg.det((P * inverse_mass) @ G.transpose(0, 2, 1))
            / np.linalg.det((P * inverse_mass) @ P.transpose(0, 2, 1))
        )


def inverse(formation: Formation, point: CurvePoint, directions: Directions) -> PathForces:
    """Forces that carry a formation along a curve, z' = z_s s', z'' = z_s s'' + z_ss s'^2.

    The object's rows M q'' = g + [W_n - W_t U Xi, W_t(rolling)] c leave four forces c one free
    number: the internal force lambda along a unit null vector; three leave none. `directions` are
    signs for motion along +s, in one row or n.
    """
    scene, (z, z_s, z_ss, kinematics) = formation.scene, point
    G = force_rows(formation, kinematics, directions)
    wrench = G[:, :, :3].transpose(0, 2, 1)
    mass, count = scene.mass_diagonal, wrench.shape[2]
    # Of rank two, as where a tip is on a flush edge's vertex, it has no single null vector.
    null = np.zeros((len(z), count)) if count == 3 else null_vector(wrench)
    right = np.zeros((len(z), count, 3))
    right[:, :3, ONE] = -scene.applied_force[:3]
    right[:, :3, A] = mass[:3] * z_s[:, :3]
    right[:, :3, B] = mass[:3] * z_ss[:, :3]
    # Bordering by the null vector makes each solution the shortest one.
    matrix = wrench if count == 3 else np.concatenate([wrench, null[:, None, :]], axis=1)
    C = np.zeros((len(z), count, 5))
    C[..., :3], C[..., LAMBDA] = np.linalg.solve(matrix, right), null
    T = -np.einsum("nij,niq->njq", G[:, :, 3:], C)
    T[..., ONE] += scene.dry[3:] * directions.sigma
    T[..., A] += mass[3:] * z_s[:, 3:]
    T[..., B] += mass[3:] * z_ss[:, 3:]
    T[..., V] = scene.viscous[3:] * z_s[:, 3:]
    return PathForces(C, T)


def null_vector(matrix: Array, least: float = 0.0) -> Array:
    """Unit null vector of each (k, k + 1) matrix, by its minors (continuous), shape (n, k + 1).

    NaN where the minors have at most the size `least`: it is not unique.
    """
    count = matrix.shape[2]
    minors = [np.linalg.det(np.delete(matrix, k, axis=2)) for k in range(count)]
    null = np.stack(minors, axis=1) * (-1.0) ** np.arange(count)
    size = np.linalg.norm(null, axis=1)[:, None]
    return np.asarray(np.divide(null, size, out=np.full_like(null, np.nan), where=size > least))


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


def move_least(P: Array, right: Array, metric: Array) -> Array:
    """The least displacements with P dz = right, (n, n_p), in a diagonal metric, shape (n, 5)."""
    over = P / metric
    amounts = np.linalg.solve(over @ P.transpose(0, 2, 1), right[..., None])[..., 0]
    return np.asarray(np.einsum("nij,ni->nj", over, amounts))


def find_freedoms(P: Array, metric: Array, least: float) -> Array:
    """Directions with P dz = 0 for P (n_p, 5), orthonormal in a diagonal metric, shape (5, f).

    Singular values up to `least` times the largest one count as zero.
    """
    root = np.sqrt(metric)
    _, values, right = np.linalg.svd(P / root)
    return np.asarray(right[int((values > least * values[0]).sum()) :].T / root[:, None])


def measure_speed(scene: Scene, v: Array) -> float:
    """Size of a velocity [m/s] or displacement [m], shape (5,), in the metric of curves."""
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
    metric : (5,)    diagonal of what "nearest" is measured in, by default that of curves
    """
    metric = metric_weights(formation.scene) if metric is None else metric
    rho = formation.scene.scales.length
    steps = 1e-5 * np.diag([rho, rho, 1.0, 1.0, 1.0])
    units = [rho if row < 2 else 1.0 for row, _ in fixed]
    sizes = np.array([rho] * formation.n_constraints + units + [rho] * len(active))
    solutions, z, left = np.full(z.shape, np.nan), z.copy(), np.arange(len(z))
    for _ in range(50):
        kinematics = formation.evaluate(z, np.zeros(z.shape))
        residual = np.hstack([kinematics.C, formation.evaluate_slip(z) - slip])
        rows = kinematics.P
        for row, value in fixed:
            values = np.broadcast_to(value, len(solutions))[left]
            residual = np.column_stack([residual, z[:, row] - values])
            one = np.broadcast_to(np.eye(5)[row], (len(z), 1, 5))
            rows = np.concatenate([rows, one], axis=1)
        if active:
            residual = np.hstack([residual, formation.evaluate_limits(z)[:, active]])
            near = (z[:, None] + np.vstack([steps, -steps])).reshape(-1, 5)
            around = formation.evaluate_limits(near)[:, active].reshape(len(z), 2, 5, -1)
            slopes = (around[:, 0] - around[:, 1]) / (2 * steps.diagonal()[:, None])
            rows = np.concatenate([rows, slopes.swapaxes(1, 2)], axis=1)
        rows, residual = rows / sizes[:, None], residual / sizes
        lift = (rows / metric).swapaxes(1, 2)
        change = (lift @ np.linalg.pinv(rows @ lift, rcond=1e-12) @ residual[..., None])[..., 0]
        # Long steps overshoot where links turn; a tenth of a radian keeps to one branch.
        turned = np.abs(change[:, 2:]).max(axis=1, keepdims=True)
        z = z - change * np.minimum(1.0, 0.1 / np.maximum(turned, 1e-12))
        closed = np.abs(residual).max(axis=1) < 3e-11
        solutions[left[closed]] = z[closed]
        z, left = z[~closed], left[~closed]
        if not len(left):
            break
    return solutions
