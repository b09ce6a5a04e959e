"""Newton's and Euler's equations, body by body, as an independent check of motion and forces.

Geometry, velocities and forces are written out anew here, in plain NumPy, from the data model:
nothing is shared with the equations of motion that planner and simulator use. With the contact
point p and the normal n into the object, t = (n_y, -n_x), and the force f = c_n n + c_t t,

    m (x'', y'') = (0, -m g) + sum f,             I phi'' = sum (p - (x, y)) x f,
    J_i theta_i'' = tau_i - B_i theta_i' - d_i - sum (p - base_i) x f.

Friction is taken from the actual velocities and not from the directions that a plan assumes: where
a contact slides c_t = -mu c_n sgn(v_t), and where a joint turns d_i = D_i sgn(theta_i'). Where a
velocity is zero within a tolerance the friction may be anything inside its cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..scene.model import Scene, cross_product

if TYPE_CHECKING:
    from ..contacts.elemental import Contact
    from ..results.trajectory import Samples

STILL = 1e-4  # speed that counts as none, relative to the scene's speed
BODIES = (
    "the object along x",
    "the object along y",
    "the object's turning",
    "finger 1",
    "finger 2",
)


class Balance(NamedTuple):
    """Residuals of the equations of motion and contact conditions at n instants."""

    forces: Array  # (n, 5): left over in each of `BODIES`, relative to the scene's force or torque
    gaps: Array  # (n, n_c): of the contacts, relative to the scene's length
    # (n, n_c): normal velocities of the contacts, and of rolling ones the larger of normal and
    # tangential velocity, relative to the scene's speed
    rates: Array
    # (n, n_c + 2): where contacts slide and joints turn against the sense that the motion's
    # friction assumes
    against: NDArray[np.bool_]
    names: tuple[str, ...]  # of the contacts

    def find_worst(self) -> tuple[float, int, str]:
        """The largest of all numbers, at which instant, and what it is of in words."""
        contacts = self.names
        tables = (
            (self.forces, BODIES, "the equation of motion of {} misses {:.2g} of {}"),
            (self.gaps, contacts, "{} has a gap of {:.2g} of {}"),
            (self.rates, contacts, "{} opens, or slips though it rolls, at {:.2g} of {}"),
        )
        sizes = [float(np.abs(table).max()) for table, _, _ in tables]
        worst = int(np.argmax(sizes))
        table, names, text = tables[worst]
        row, column = divmod(int(np.abs(table).argmax()), table.shape[1])
        unit = ("the scene's force or torque", "the scene's length", "the scene's speed")[worst]
        text = text.format(names[column], sizes[worst], unit)
        names = (*contacts, "joint 1", "joint 2")
        turned = [name for name, wrong in zip(names, self.against[row], strict=True) if wrong]
        if worst == 0 and turned:
            text += f", as {' and '.join(turned)} moves against the sense that its friction assumes"
        return sizes[worst], row, text


class _ContactForce(NamedTuple):
    """A contact at n instants: its point and normal, shape (n, 2), and gap, shape (n,) [m]."""

    point: Array
    normal: Array
    gap: Array


def balance(
    scene: Scene,
    contacts: Sequence[Contact],
    rolling: Sequence[Contact],
    samples: Samples,
    still: float = STILL,
) -> Balance:
    """Residuals of a motion with its forces in the Newton-Euler equations.

    Parameters
    ----------
    contacts, rolling  in the order of the samples' forces; those of them that roll
    still              speed that counts as none, relative to the scene's speed; angular speeds
                       count times the scene's length
    """
    z, v, scales, body = samples.z, samples.z_dot, scene.scales, scene.polygon
    slow = still * scales.speed
    assert body.inertia is not None
    inertias = np.array([body.mass, body.mass, body.inertia, *(f.inertia for f in scene.fingers)])
    left = -inertias * samples.z_ddot
    left[:, 1] -= body.mass * scene.gravity
    left[:, 3:] += samples.tau
    gaps, rates = np.zeros(samples.c_n.shape), np.zeros(samples.c_n.shape)
    against = np.zeros((len(z), len(contacts) + 2), dtype=bool)
    for k, contact in enumerate(contacts):
        touch = _touch(scene, contact, z)
        n, t = touch.normal, -_quarter(touch.normal)
        base = (0.0, 0.0) if contact.finger is None else scene.fingers[contact.finger].base
        arm, lever = touch.point - z[:, :2], touch.point - np.asarray(base)
        slip = v[:, :2] + v[:, 2:3] * _quarter(arm)
        if contact.finger is not None:
            slip = slip - v[:, 3 + contact.finger, None] * _quarter(lever)
        v_n, v_t = (slip * n).sum(axis=1), (slip * t).sum(axis=1)
        c_n, c_t = samples.c_n[:, k], samples.c_t[:, k]
        bound = scene.friction.of(contact.finger) * c_n
        slides = np.abs(v_t) > slow
        if contact in rolling:
            slides[:] = False
            v_n = np.maximum(np.abs(v_n), np.abs(v_t))
        friction = np.where(slides, -bound * np.sign(v_t), np.clip(c_t, -bound, bound))
        force = c_n[:, None] * n + friction[:, None] * t
        left[:, :2] += force
        left[:, 2] += cross_product(arm, force)
        if contact.finger is not None:
            left[:, 3 + contact.finger] -= cross_product(lever, force)
        gaps[:, k], rates[:, k] = touch.gap, v_n
        against[:, k] = slides & (np.abs(friction - c_t) > 1e-6 * scales.force)
    for k, link in enumerate(scene.fingers):
        turn, row = v[:, 3 + k], left[:, 3 + k]
        row -= link.viscous * turn
        turns = scales.length * np.abs(turn) > slow
        row -= np.where(turns, link.dry * np.sign(turn), np.clip(row, -link.dry, link.dry))
        other = np.abs(row + 2 * link.dry * np.sign(turn)) < 1e-6 * scales.torque
        against[:, len(contacts) + k] = turns & other & (np.abs(row) > 1e-6 * scales.torque)
    left /= np.array([scales.force] * 2 + [scales.torque] * 3)
    names = tuple(contact.name for contact in contacts)
    return Balance(left, gaps / scales.length, rates / scales.speed, against, names)


def _touch(scene: Scene, contact: Contact, z: Array) -> _ContactForce:
    """Where a contact touches at n configurations."""
    corners = scene.polygon.vertices
    count = len(corners)
    vertex = z[:, :2] + _rotate(z[:, 2], corners[contact.index])
    if contact.finger is None:
        return _ContactForce(vertex, np.tile([0.0, 1.0], (len(z), 1)), vertex[:, 1])
    link = scene.fingers[contact.finger]
    heading = z[:, 3 + contact.finger]
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    if contact.surface == "finger":
        normal = _quarter(along) if contact.finger == 0 else -_quarter(along)
        gap = ((vertex - np.asarray(link.base)) * normal).sum(axis=1) - link.radius
        return _ContactForce(vertex, normal, gap)
    tip = np.asarray(link.base) + link.length * along
    if contact.feature == "v":
        offset = vertex - tip
        distance = np.linalg.norm(offset, axis=1)
        return _ContactForce(vertex, offset / distance[:, None], distance - link.radius)
    run = _rotate(z[:, 2], corners[(contact.index + 1) % count] - corners[contact.index])
    # The corners go round anticlockwise, so the inside is to the left of an edge.
    normal = _quarter(run / np.linalg.norm(run, axis=1)[:, None])
    gap = -((tip - vertex) * normal).sum(axis=1) - link.radius
    return _ContactForce(tip + link.radius * normal, normal, gap)


def _rotate(angle: Array, vector: Array) -> Array:
    """A vector turned by n angles, shape (n, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]], axis=1)


def _quarter(vectors: Array) -> Array:
    """Vectors, shape (n, 2), turned by a right angle to the left."""
    return np.stack([-vectors[:, 1], vectors[:, 0]], axis=1)
