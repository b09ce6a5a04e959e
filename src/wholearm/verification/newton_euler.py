"""Newton's and Euler's equations, body by body, as an independent check of motion and forces.

Geometry, velocities and forces are derived here in NumPy from the data model: nothing is shared
with the equations of motion that planner and simulator use. With the contact point p and the normal
n into the object, t = (n_y, -n_x), and the force f = c_n n + c_t t,

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

from ..common.arrays import Array, Flags
from ..scene.model import Scene, cross_product

if TYPE_CHECKING:
    from ..contacts.elemental import Contact
    from ..results.trajectory import Samples

REST_SPEED = 1e-4  # largest speed of rest, relative to the scene's speed
# Tolerance of static friction outside its cone, relative to the scene's force: plans keep limits to
# 1e-7 of the largest forces. Case: a contact of query 54 that slips under rate limits.
CONE_TOLERANCE = 2e-6
BODIES = (
    "the object along x",
    "the object along y",
    "the object's turning",
    "finger 1",
    "finger 2",
)


class Balance(NamedTuple):
    """Residuals of the equations of motion and contact conditions at n instants."""

    forces: Array  # (n, 5): residuals of `BODIES`, relative to the scene's force or torque
    gaps: Array  # (n, n_c): of the contacts, relative to the scene's length
    # (n, n_c): normal velocities of the contacts, and of rolling ones the larger of normal and
    # tangential velocity, relative to the scene's speed
    rates: Array
    # (n, n_c + 2): whether contacts slide or joints turn in the direction opposite to the one that
    # the motion's friction assumes
    wrong_sign: Flags
    names: tuple[str, ...]  # of the contacts

    def find_worst(self) -> tuple[float, int, str]:
        """The largest residual, its instant, and a description."""
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
        movers = [name for name, wrong in zip(names, self.wrong_sign[row], strict=True) if wrong]
        if worst == 0 and movers:
            text += f", as {' and '.join(movers)} moves against the sense that its friction assumes"
        return sizes[worst], row, text


class ContactGeometry(NamedTuple):
    """A contact at n configurations."""

    gap: Array  # (n,) [m]
    # low, high (n,) [m]: distances of the contact from both ends of the feature that it slides on;
    # infinite where the feature has no end of its own
    low: Array
    high: Array
    # normal, tangent (n, 5): rows that give the rate of separation and of sliding from z', and the
    # force on z from c_n and c_t
    normal: Array
    tangent: Array
    friction: float  # coefficient mu
    point: Array  # (n, 2) [m]


def balance(
    scene: Scene,
    contacts: Sequence[Contact],
    rolling: Sequence[Contact],
    samples: Samples,
    rest_speed: float = REST_SPEED,
) -> Balance:
    """Residuals of a motion with its forces in the Newton-Euler equations.

    Contacts are in the order of the samples' forces; `rolling` ones do not slide. Speeds below
    `rest_speed`, relative to the scene's, angular ones times the scene's length, count as rest.
    """
    z, v, scales = samples.z, samples.z_dot, scene.scales
    slow = rest_speed * scales.speed
    residual = scene.applied_force - scene.mass_diagonal * samples.z_ddot
    residual[:, 3:] += samples.tau
    gaps, rates = np.zeros(samples.c_n.shape), np.zeros(samples.c_n.shape)
    wrong_sign = np.zeros((len(z), len(contacts) + 2), dtype=bool)
    for k, contact in enumerate(contacts):
        place, c_n, c_t = locate(scene, contact.name, z), samples.c_n[:, k], samples.c_t[:, k]
        v_n, v_t = dot(place.normal, v), dot(place.tangent, v)
        bound = place.friction * c_n
        slides = np.abs(v_t) > slow
        if contact in rolling:
            slides[:] = False
            v_n = np.maximum(np.abs(v_n), np.abs(v_t))
        static = bound + CONE_TOLERANCE * scales.force
        friction = np.where(slides, -bound * np.sign(v_t), np.clip(c_t, -static, static))
        residual += c_n[:, None] * place.normal + friction[:, None] * place.tangent
        gaps[:, k], rates[:, k] = place.gap, v_n
        wrong_sign[:, k] = slides & (np.abs(friction - c_t) > 1e-6 * scales.force)
    for k, link in enumerate(scene.fingers):
        rate, row = v[:, 3 + k], residual[:, 3 + k]
        row -= link.viscous * rate
        turning = scales.length * np.abs(rate) > slow
        row -= np.where(turning, link.dry * np.sign(rate), np.clip(row, -link.dry, link.dry))
        opposite = np.abs(row + 2 * link.dry * np.sign(rate)) < 1e-6 * scales.torque
        wrong_sign[:, len(contacts) + k] = turning & opposite & (np.abs(row) > 1e-6 * scales.torque)
    residual /= np.array([scales.force] * 2 + [scales.torque] * 3)
    names = tuple(contact.name for contact in contacts)
    return Balance(residual, gaps / scales.length, rates / scales.speed, wrong_sign, names)


def place_object(scene: Scene, z: Array) -> Array:
    """World positions of the vertices at n configurations, shape (n, n_v, 2) [m]."""
    turn = np.cos(z[:, 2]), np.sin(z[:, 2])
    return z[:, None, :2] + np.stack([_rotate(v, *turn) for v in scene.polygon.vertices], axis=1)


def link_axis(z: Array, finger: int) -> Array:
    """Unit vectors from joint to tip, shape (n, 2)."""
    return np.array([np.cos(z[:, 3 + finger]), np.sin(z[:, 3 + finger])]).T


def locate(scene: Scene, name: str, z: Array) -> ContactGeometry:
    """Geometry of contact `name` at n configurations `z`, shape (n, 5), which may be complex."""
    feature, part = name.split("-")
    index, vertices = int(feature[1:]), scene.polygon.vertices
    turn = np.cos(z[:, 2]), np.sin(z[:, 2])
    point = corner = z[:, :2] + _rotate(vertices[index], *turn)
    low = high = np.full(len(z), np.inf)
    gap, finger = corner[:, 1], None if part == "palm" else int(part[-1]) - 1
    if finger is None:
        normal = np.zeros((len(z), 2), dtype=z.dtype)
        normal[:, 1] = 1.0
    else:
        link, axis = scene.fingers[finger], link_axis(z, finger)
        base = np.asarray(link.base)
        tip = base + link.length * axis
        if part.startswith("finger"):
            normal = (1 - 2 * finger) * np.array([-axis[:, 1], axis[:, 0]]).T
            gap, low = dot(normal, corner - base) - link.radius, dot(axis, corner - base)
            high = link.length - low
        elif feature[0] == "v":
            distance = norm(corner - tip)
            normal = (corner - tip) / np.where(distance == 0, 1.0, distance)[:, None]
            gap, low = distance - link.radius, dot(axis, corner - tip)
        else:
            edge = vertices[(index + 1) % len(vertices)] - vertices[index]
            along = _rotate(edge / norm(edge), *turn)
            normal = np.array([-along[:, 1], along[:, 0]]).T
            gap, low = -dot(normal, tip - corner) - link.radius, dot(along, tip - corner)
            high, point = norm(edge) - low, tip + link.radius * normal
    tangent = np.array([normal[:, 1], -normal[:, 0]]).T
    rows = np.zeros((2, len(z), 5), dtype=z.dtype)
    for row, direction in zip(rows, (normal, tangent), strict=True):
        row[:, :2], row[:, 2] = direction, cross_product(point - z[:, :2], direction)
        if finger is not None:
            row[:, 3 + finger] = -cross_product(point - base, direction)
    return ContactGeometry(gap, low, high, rows[0], rows[1], scene.friction.of(finger), point)


def _rotate(vector: Array, c: Array, s: Array) -> Array:
    """A vector, shape (2,), turned by n angles with cosines `c` and sines `s`, shape (n, 2)."""
    x, y = vector
    return np.array([x * c - y * s, x * s + y * c]).T


def dot(a: Array, b: Array) -> Array:
    """Scalar products of vectors along the last axis."""
    return np.asarray((a * b).sum(axis=-1))


def norm(a: Array) -> Array:
    """Lengths of vectors along the last axis, also as analytic functions of complex ones."""
    return np.sqrt(dot(a, a))
