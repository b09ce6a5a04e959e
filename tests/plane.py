"""Plane geometry, hands and objects in plain NumPy: what the tests check the package against."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from wholearm.contact import Contact, parse_contact
from wholearm.curve import Curve
from wholearm.formation import Formation
from wholearm.model import Array, Finger, Friction, Polygon, Scene
from wholearm.trajectory import Samples

SQUARE = [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]]


def rotate(angle: float, points: ArrayLike) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.asarray(points, dtype=float) @ np.array([[c, s], [-s, c]]))


def cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def point_to_segment(points: Array, start: Array, end: Array) -> Array:
    """Distance of points, shape (..., 2), from segments, shape (..., 2)."""
    run = end - start
    part = np.clip(((points - start) * run).sum(-1) / (run * run).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(points - start - part[..., None] * run, axis=-1))


def nearest_on_segment(point: Array, start: Array, end: Array) -> Array:
    run = end - start
    return np.asarray(start + np.clip((point - start) @ run / (run @ run), 0, 1) * run)


def polygon_to_segments(corners: Array, start: Array, ends: Array) -> Array:
    """Distance of a polygon from n segments that leave one point, shape (n,); 0 if they overlap."""
    after = np.roll(corners, -1, axis=0)
    distances = np.concatenate(
        [
            point_to_segment(corners, start, ends[:, None]),
            point_to_segment(ends[:, None], corners, after),
            np.broadcast_to(point_to_segment(start, corners, after), (len(ends), len(corners))),
        ],
        axis=1,
    ).min(axis=1)
    run = (ends - start)[:, None]
    side = cross(run, corners - start) * cross(run, after - start) < 0
    turn = cross(after - corners, start - corners) * cross(after - corners, ends[:, None] - corners)
    inside = (cross(after - corners, start - corners) > 0).all()
    return np.where((side & (turn < 0)).any(axis=1) | inside, 0.0, distances)


def place_corners(scene: Scene, z: Array) -> Array:
    """World positions of the object's corners, shape (n_v, 2)."""
    return np.asarray(z[:2] + rotate(z[2], scene.polygon.vertices))


def place_tips(scene: Scene, finger: int, angles: ArrayLike) -> Array:
    """Centres of a finger's tip at some joint angles, shape (..., 2)."""
    link = scene.fingers[finger]
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.asarray(np.asarray(link.base) + link.length * heading)


def finger_gap(scene: Scene, q: Array, finger: int, angles: ArrayLike) -> Array:
    """Distance between object and link at some joint angles, shape (n,); negative: overlap."""
    link = scene.fingers[finger]
    corners = place_corners(scene, q)
    tips = place_tips(scene, finger, np.atleast_1d(angles))
    return polygon_to_segments(corners, np.asarray(link.base), tips) - link.radius


def convex_polygon(rng: np.random.Generator, count: int, size: float = 0.05) -> Array:
    """Corners of a random convex polygon on an ellipse, anticlockwise, off its centroid."""
    even = np.arange(count) + rng.uniform(-0.3, 0.3, count)
    angles = 2 * np.pi * even / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.6, 1.0) * np.sin(angles)])
    return rotate(rng.uniform(-np.pi, np.pi), corners) + rng.uniform(-size, size, 2)


def make_finger(base: ArrayLike, length: float = 0.18, radius: float = 0.005) -> Finger:
    return Finger(
        base=np.asarray(base, dtype=float),
        length=length,
        radius=radius,
        inertia=0.005,
        viscous=0.01,
        dry=0.01,
        torque_limit=2.0,
    )


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
    slow = Scene(scene.polygon, (right, left), scene.friction, scene.gravity)
    return replace(curve, formation=Formation(slow, curve.formation.contacts))


def touch(scene: Scene, contact: Contact, z: Array) -> tuple[Array, Array]:
    """Contact point and normal into the object of a vertex on the palm or on a link's side."""
    assert contact.feature == "v" and contact.surface in ("palm", "finger")
    corner = place_corners(scene, z)[contact.index]
    if contact.finger is None:
        return corner, np.array([0.0, 1.0])
    heading = z[3 + contact.finger]
    side = 1.0 if contact.finger == 0 else -1.0
    return corner, side * np.array([-np.sin(heading), np.cos(heading)])


def measure_gaps(formation: Formation, z: Array) -> Array:
    """Gaps of a formation of vertex contacts, shape (n_c,) [m]."""
    gaps = []
    for contact in formation.contacts:
        point, normal = touch(formation.scene, contact, z)
        link = None if contact.finger is None else formation.scene.fingers[contact.finger]
        base = np.zeros(2) if link is None else np.asarray(link.base)
        gaps.append((point - base) @ normal - (0.0 if link is None else link.radius))
    return np.array(gaps)


def measure_slip(formation: Formation, z: Array, v: Array) -> Array:
    """Sliding velocities of a formation of vertex contacts, shape (n_c,) [m/s]."""
    slips = []
    for contact in formation.contacts:
        point, n = touch(formation.scene, contact, z)
        arm = point - z[:2]
        speed = v[:2] + v[2] * np.array([-arm[1], arm[0]])
        if contact.finger is not None:
            lever = point - np.asarray(formation.scene.fingers[contact.finger].base)
            speed = speed - v[3 + contact.finger] * np.array([-lever[1], lever[0]])
        slips.append(speed @ np.array([n[1], -n[0]]))
    return np.array(slips)


def stack_rows(formation: Formation, z: Array) -> tuple[Array, Array]:
    """A and A_t of a formation of vertex contacts, shape (n_c, 5) each."""
    normal: list[Array] = []
    tangent: list[Array] = []
    for contact in formation.contacts:
        point, n = touch(formation.scene, contact, z)
        for rows, along in ((normal, n), (tangent, np.array([n[1], -n[0]]))):
            row = np.array([*along, cross(point - z[:2], along), 0.0, 0.0])
            if contact.finger is not None:
                base = np.asarray(formation.scene.fingers[contact.finger].base)
                row[3 + contact.finger] = -cross(point - base, along)
            rows.append(row)
    return np.array(normal), np.array(tangent)


def accelerate(
    formation: Formation, z: Array, v: Array, tau: Array, Xi: Array, sigma: Array
) -> tuple[Array, Array]:
    """Accelerations, shape (5,), and normal forces, shape (n_c,), of sliding vertex contacts."""
    scene = formation.scene
    body = scene.polygon
    assert body.inertia is not None
    mass = np.array([body.mass, body.mass, body.inertia, *(f.inertia for f in scene.fingers)])
    drag = [f.viscous * v[3 + k] + f.dry * sigma[k] for k, f in enumerate(scene.fingers)]
    applied = np.array([0.0, -body.mass * scene.gravity, 0.0, *(tau - drag)])
    A, A_t = stack_rows(formation, z)
    # Central differences along the motion, over a microsecond.
    ahead, behind = (stack_rows(formation, z + step * v)[0] for step in (1e-6, -1e-6))
    A_dot_v = (ahead - behind) @ v / 2e-6
    G = A - (formation.friction * Xi)[:, None] * A_t
    c_n = np.linalg.solve((A / mass) @ G.T, -A_dot_v - A @ (applied / mass))
    return (applied + G.T @ c_n) / mass, c_n


def unbalance(formation: Formation, row: Samples, sigma: Array) -> tuple[Array, Array]:
    """What each body's balance misses, and the largest term in it, shape (5,) each.

    Forces x and y and the moment of the object, then the moments of the joints.

    Parameters
    ----------
    row : Samples
        Of one instant, without the axis over instants.
    sigma : ndarray, shape (2,)
        Directions of the joints.
    """
    scene = formation.scene
    body, terms = scene.polygon, [np.zeros(5)]
    assert body.inertia is not None
    terms.append(np.array([0.0, -body.mass * scene.gravity, 0.0, 0.0, 0.0]))
    masses = [body.mass, body.mass, body.inertia, *(link.inertia for link in scene.fingers)]
    terms.append(-np.array(masses) * row.z_ddot)
    terms.append(np.array([0.0, 0.0, 0.0, *row.tau]))
    drag = [
        link.viscous * row.z_dot[3 + k] + link.dry * sigma[k]
        for k, link in enumerate(scene.fingers)
    ]
    terms.append(-np.array([0.0, 0.0, 0.0, *drag]))
    for k, contact in enumerate(formation.contacts):
        point, n = touch(scene, contact, row.z)
        for force in (row.c_n[k] * n, row.c_t[k] * np.array([n[1], -n[0]])):
            term = np.array([*force, cross(point - row.z[:2], force), 0.0, 0.0])
            if contact.finger is not None:
                base = np.asarray(scene.fingers[contact.finger].base)
                term[3 + contact.finger] = cross(point - base, -force)
            terms.append(term)
    return np.sum(terms, axis=0), np.abs(terms).max(axis=0)
