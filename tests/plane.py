"""Plane geometry, hands and objects in plain NumPy: what the tests check the package against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wholearm.contact import parse_contact
from wholearm.formation import Formation
from wholearm.model import Array, Finger, Friction, Polygon, Scene

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
