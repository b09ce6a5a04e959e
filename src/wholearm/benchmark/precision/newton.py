"""The equations of motion as an ordinary user would write them, to measure the package against.

The Newton-Euler equations of object and fingers are written out in NumPy, contact by contact, and
solved together with the contact conditions as one linear system. Nothing is shared with the
package's own contacts and dynamics, so this is an independent second formulation. Friction keeps
the directions it is given.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.arrays import Array
from ...contacts.elemental import Contact
from ...results.torque import TorqueProfile
from ...scene.model import Scene


def find_piece(torque: TorqueProfile, t: float) -> int:
    """The piece of the torques that a time is in, or the nearest one."""
    piece = int(np.searchsorted(torque.breaks, t, side="right")) - 1
    return min(max(piece, 0), len(torque.coefficients) - 1)


def evaluate_piece(torque: TorqueProfile, piece: int, t: float) -> Array:
    """Torques of one piece at a time, shape (2,) [N m]."""
    start, stop = torque.breaks[piece], torque.breaks[piece + 1]
    x = (2 * t - start - stop) / (stop - start)
    return np.asarray(torque.coefficients[piece] @ x ** np.arange(torque.coefficients.shape[2]))


def solve_motion(
    scene: Scene,
    contacts: tuple[Contact, ...],
    z: Array,
    z_dot: Array,
    tau: Array,
    Xi: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """Accelerations z'', shape (5,), and c_n, shape (n_c,) [N], from one linear system.

    The unknowns are those of Eqs. (1) and (2) with the friction of Eq. (3) put in, together with
    the contact conditions differentiated twice. Extended precision is kept.
    """
    count = len(contacts)
    matrix = np.zeros((5 + count, 5 + count), dtype=z.dtype)
    right = np.zeros(5 + count, dtype=z.dtype)
    matrix[range(5), range(5)] = scene.mass_diagonal
    right[1] = -scene.polygon.mass * scene.gravity
    for i, finger in enumerate(scene.fingers):
        friction = finger.viscous * z_dot[3 + i] + finger.dry * sigma[i]
        right[3 + i] = tau[i] - friction
    for k, contact in enumerate(contacts):
        point, normal, bend = _touch(scene, contact, z, z_dot)
        tangent = np.array([normal[1], -normal[0]])
        coefficient = scene.friction.of(contact.finger)
        row = _lever(scene, contact, z, point, normal)
        force = row - coefficient * Xi[k] * _lever(scene, contact, z, point, tangent)
        matrix[:5, 5 + k] = -force
        matrix[5 + k, :5] = row
        right[5 + k] = -bend
    solution = solve_linear(matrix, right)
    return np.asarray(solution[:5]), np.asarray(solution[5:])


def solve_linear(matrix: Array, right: Array) -> Array:
    """Solve a linear system: by LAPACK, or by elimination what that has no precision for."""
    if matrix.dtype == np.float64:
        return np.asarray(np.linalg.solve(matrix, right))
    table = np.column_stack([matrix, right])
    for k in range(len(table)):
        pivot = k + int(np.abs(table[k:, k]).argmax())
        table[[k, pivot]] = table[[pivot, k]]
        table[k] /= table[k, k]
        factors = table[:, k].copy()
        factors[k] = 0.0
        table -= factors[:, None] * table[k]
    return np.asarray(table[:, -1])


def find_sliding(scene: Scene, contact: Contact, z: Array, z_dot: Array) -> Any:
    """Sliding velocity of a contact [m/s]."""
    point, normal, _ = _touch(scene, contact, z, z_dot)
    tangent = np.array([normal[1], -normal[0]])
    return _lever(scene, contact, z, point, tangent) @ z_dot


def _lever(scene: Scene, contact: Contact, z: Array, point: Array, force: Array) -> Array:
    """Generalised force of a unit force on the object at `point` and its reaction on the finger."""
    row = np.zeros(5, dtype=z.dtype)
    arm = point - z[:2]
    row[:3] = force[0], force[1], arm[0] * force[1] - arm[1] * force[0]
    if contact.finger is not None:
        arm = point - np.asarray(scene.fingers[contact.finger].base)
        row[3 + contact.finger] = -(arm[0] * force[1] - arm[1] * force[0])
    return row


def _touch(scene: Scene, contact: Contact, z: Array, z_dot: Array) -> tuple[Array, Array, float]:
    """Contact point, normal into the object, and the gap's second derivative less A z''."""
    c, s = np.cos(z[2]), np.sin(z[2])
    turn = np.array([[c, -s], [s, c]])
    spin = z_dot[2]
    arm = turn @ scene.polygon.vertices[contact.index]
    vertex = z[:2] + arm
    velocity = z_dot[:2] + spin * np.array([-arm[1], arm[0]])
    if contact.finger is None:
        return vertex, np.array([0.0, 1.0]), -(spin**2) * arm[1]
    finger = scene.fingers[contact.finger]
    angle, rate = z[3 + contact.finger], z_dot[3 + contact.finger]
    axis = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-axis[1], axis[0]])
    if contact.surface == "finger":
        side = 1.0 if contact.finger == 0 else -1.0
        normal = side * across
        swing = -side * rate * axis
        reach = vertex - np.asarray(finger.base)
        bend = 2 * swing @ velocity - rate**2 * normal @ reach - spin**2 * normal @ arm
        return vertex, normal, bend
    if contact.feature != "e":
        raise ValueError(f"{contact.name}: the baseline knows no contacts with a tip's arc")
    following = scene.polygon.vertices[(contact.index + 1) % scene.polygon.n_vertices]
    along = turn @ following - arm
    along = along / np.hypot(*along)
    outward = np.array([along[1], -along[0]])
    tip = np.asarray(finger.base) + finger.length * axis
    tip_velocity = finger.length * rate * across
    swing = spin * np.array([-outward[1], outward[0]])
    bend = (
        2 * swing @ (tip_velocity - velocity)
        - spin**2 * outward @ (tip - vertex)
        + outward @ (spin**2 * arm - rate**2 * finger.length * axis)
    )
    return tip - finger.radius * outward, -outward, bend
