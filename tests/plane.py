"""Plane geometry, hands and objects in plain NumPy: what the tests check the package against.

Configurations, velocities and angles may have leading axes, which results then have too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from wholearm import Finger, Formation, Friction, Polygon, Scene
from wholearm.benchmark.precision import solve_motion
from wholearm.benchmark.refusals import separate
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.geometry.curve import Curve
from wholearm.results.trajectory import Samples
from wholearm.verification.newton_euler import ContactGeometry, locate

SQUARE = [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]]


def rotate(angle: ArrayLike, points: ArrayLike) -> Array:
    """Points, shape (2,) or (n, 2), turned by one angle or each of several."""
    places, angle = np.asarray(points, dtype=float), np.asarray(angle, dtype=float)
    x, y = places[..., 0], places[..., 1]
    c, s = (f(angle)[(..., *[None] * x.ndim)] for f in (np.cos, np.sin))
    turned = np.empty((*angle.shape, *places.shape))
    turned[..., 0], turned[..., 1] = c * x - s * y, s * x + c * y
    return turned


def find_null_vector(rows: Array) -> Array:
    """Null vector of rows, shape (4, 5), by their signed minors."""
    minors = [(-1) ** k * np.linalg.det(np.delete(rows, k, axis=1)) for k in range(5)]
    return np.array(minors)


def dot(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])


def cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def point_to_segment(points: Array, start: Array, end: Array) -> Array:
    """Distance of points, shape (..., 2), from segments, shape (..., 2)."""
    run = end - start
    # Borders may have a point twice, by rounding.
    square = np.maximum(dot(run, run), np.finfo(float).tiny)
    part = np.clip(dot(points - start, run) / square, 0, 1)
    away = points - start - part[..., None] * run
    return np.asarray(np.hypot(away[..., 0], away[..., 1]))


def place_corners(scene: Scene, z: Array) -> Array:
    """World positions of the object's corners, shape (..., n_v, 2)."""
    return np.asarray(z[..., None, :2] + rotate(z[..., 2], scene.polygon.vertices))


def place_tips(scene: Scene, finger: int, angles: ArrayLike) -> Array:
    """Centres of a finger's tip at some joint angles, shape (..., 2)."""
    link = scene.fingers[finger]
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.asarray(np.asarray(link.base) + link.length * heading)


def finger_gap(scene: Scene, q: Array, finger: int, angles: ArrayLike) -> Array:
    """Distance between object and link at poses and joint angles, shape (n,); negative: overlap."""
    link, corners = scene.fingers[finger], place_corners(scene, q)
    tips = place_tips(scene, finger, np.atleast_1d(angles))
    corners = np.broadcast_to(corners, (len(tips), *corners.shape[-2:]))
    bones = np.stack(np.broadcast_arrays(np.asarray(link.base), tips), axis=1)
    return separate(corners, bones) - link.radius


def is_first_touch(
    scene: Scene, q: Array, finger: int, angle: float, close: float = 1e-14, count: int = 1500
) -> bool:
    """Whether a link that closes from pointing down, outside, touches the object there at last."""
    first = -np.pi / 2 if finger == 0 else 3 * np.pi / 2
    *before, last = finger_gap(scene, q, finger, np.linspace(first, angle, count))
    return bool(abs(last) < close and min(before) > 0)


def convex_polygon(rng: np.random.Generator, count: int, size: float = 0.05) -> Array:
    """Corners of a random convex polygon on an ellipse, anticlockwise, off its centroid."""
    even = np.arange(count) + rng.uniform(-0.3, 0.3, count)
    angles = 2 * np.pi * even / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.6, 1.0) * np.sin(angles)])
    return rotate(rng.uniform(-np.pi, np.pi), corners) + rng.uniform(-size, size, 2)


def make_finger(base: ArrayLike, length: float = 0.18, radius: float = 0.005) -> Finger:
    inertia, viscous, dry, torque_limit = 0.005, 0.01, 0.01, 2.0
    return Finger(base, length, radius, inertia, viscous, dry, torque_limit)


def make_scene(
    points: ArrayLike = SQUARE,
    *,
    base: float = 0.08,
    depth: float = -0.01,
    length: float = 0.18,
    radius: float = 0.005,
    friction: float = 0.1,
    lengths: tuple[float, float] | None = None,
) -> Scene:
    """A hand with mirrored joints, and an object."""
    right, left = lengths or (length, length)
    return Scene(
        Polygon(np.asarray(points, dtype=float), 0.2),
        (make_finger([base, depth], right, radius), make_finger([-base, depth], left, radius)),
        Friction(friction, friction, friction),
    )


def make_formation(scene: Scene, names: str) -> Formation:
    return Formation(scene, tuple(parse_contact(name, scene) for name in names.split()))


def with_speed_limit(curve: Curve, limits: tuple[float, float]) -> Curve:
    scene = curve.formation.scene
    right, left = (
        replace(link, speed_limit=limit) for link, limit in zip(scene.fingers, limits, strict=True)
    )
    return replace(
        curve, formation=replace(curve.formation, scene=replace(scene, fingers=(right, left)))
    )


def locate_all(formation: Formation, z: Array) -> list[ContactGeometry]:
    """The contacts of a formation at configurations, shape (..., 5)."""
    return [locate(formation.scene, name, z.reshape(-1, 5)) for name in formation.names]


def measure_gaps(formation: Formation, z: Array) -> Array:
    """Gaps of a formation, shape (..., n_c) [m]."""
    gaps = np.stack([own.gap for own in locate_all(formation, z)], axis=-1)
    return np.asarray(gaps.reshape(*z.shape[:-1], -1))


def measure_slip(formation: Formation, z: Array, v: Array) -> Array:
    """Sliding velocities of a formation, shape (..., n_c) [m/s]."""
    return np.asarray((stack_rows(formation, z)[1] @ v[..., None])[..., 0])


def stack_rows(formation: Formation, z: Array) -> tuple[Array, Array]:
    """A and A_t of a formation, shape (..., n_c, 5) each."""
    rows = np.array([(own.normal, own.tangent) for own in locate_all(formation, z)])
    A, A_t = rows.transpose(1, 2, 0, 3).reshape(2, *z.shape[:-1], -1, 5)
    return A, A_t


def accelerate(
    formation: Formation, z: Array, v: Array, tau: Array, Xi: Array, sigma: Array
) -> tuple[Array, Array]:
    """Accelerations, shape (5,), and normal forces, shape (n_c,), of sliding contacts."""
    return solve_motion(formation, z, v, tau, Xi, sigma)


def unbalance(formation: Formation, row: Samples, sigma: Array) -> tuple[Array, Array]:
    """What each body's balance misses, and the largest term in it, shape (..., 5) each.

    Forces x and y and the moment of the object, then the moments of the joints, at one instant or
    at many along the first axis; `sigma` has the directions of the joints, shape (..., 2).
    """
    scene, joints, dry = formation.scene, np.zeros_like(row.z), np.zeros_like(row.z)
    joints[..., 3:], dry[..., 3:] = row.tau, sigma
    weight = np.broadcast_to(scene.applied_force, row.z.shape)
    drag = -scene.viscous * row.z_dot - scene.dry * dry
    terms = [weight, -scene.mass_diagonal * row.z_ddot, joints, drag]
    A, A_t = stack_rows(formation, row.z)
    pushes = [row.c_n[..., None] * A, row.c_t[..., None] * A_t]
    every = np.concatenate([np.stack(terms, axis=-2), *pushes], axis=-2)
    return np.asarray(every.sum(axis=-2)), np.asarray(np.abs(every).max(axis=-2))
