"""Contacts, equations of motion and distances written out for single bodies, to check plans with.

Nothing here uses the C-functions, Jacobians or dynamics of the planner: a contact is a point with a
normal, bodies move rigidly, and Newton's and Euler's laws hold for each of them. Distances are by
separating axes. The names are those of `scene.model`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...scene.model import Scene, cross_product


class Touch(NamedTuple):
    """A contact at n configurations."""

    gap: Array  # (n,) [m]
    # low, high (n,) [m]: how far the contact is inside both ends of the feature that it slides on;
    # infinite where the feature has no end of its own
    low: Array
    high: Array
    # normal, tangent (n, 5): rows that give the rate of separation and of sliding from z', and the
    # force on z from c_n and c_t
    normal: Array
    tangent: Array
    friction: float  # coefficient mu


def place_object(scene: Scene, z: Array) -> Array:
    """World positions of the vertices at n configurations, shape (n, n_v, 2) [m]."""
    c, s = np.cos(z[:, 2]), np.sin(z[:, 2])
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.asarray(z[:, None, :2] + scene.polygon.vertices @ turn.transpose(0, 2, 1))


def link_axis(scene: Scene, z: Array, finger: int) -> Array:
    """Unit vectors from joint to tip, shape (n, 2)."""
    return np.stack([np.cos(z[:, 3 + finger]), np.sin(z[:, 3 + finger])], axis=1)


def locate(scene: Scene, name: str, z: Array) -> Touch:
    """The contact called `name` at n configurations `z`, shape (n, 5), which may be complex."""
    feature, part = name.split("-")
    index, corners = int(feature[1:]), place_object(scene, z)
    point = corner = corners[:, index]
    normal, low, high = np.tile([0.0, 1.0], (len(z), 1)), *2 * [np.full(len(z), np.inf)]
    gap, finger = corner[:, 1], None if part == "palm" else int(part[-1]) - 1
    if finger is not None:
        link, axis = scene.fingers[finger], link_axis(scene, z, finger)
        base = np.asarray(link.base)
        tip = base + link.length * axis
        if part.startswith("finger"):
            normal = (1 - 2 * finger) * np.stack([-axis[:, 1], axis[:, 0]], axis=1)
            gap, low = _dot(normal, corner - base) - link.radius, _dot(axis, corner - base)
            high = link.length - low
        elif feature[0] == "v":
            distance = _norm(corner - tip)
            normal = (corner - tip) / np.where(distance == 0, 1.0, distance)[:, None]
            gap, low = distance - link.radius, _dot(axis, corner - tip)
        else:
            along = corners[:, (index + 1) % corners.shape[1]] - corner
            length = _norm(along)
            along = along / length[:, None]
            normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
            gap, low = -_dot(normal, tip - corner) - link.radius, _dot(along, tip - corner)
            high, point = length - low, tip + link.radius * normal
    tangent = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    rows = np.zeros((2, len(z), 5), dtype=z.dtype)
    for row, direction in zip(rows, (normal, tangent), strict=True):
        row[:, :2], row[:, 2] = direction, cross_product(point - z[:, :2], direction)
        if finger is not None:
            row[:, 3 + finger] = -cross_product(point - base, direction)
    return Touch(gap, low, high, rows[0], rows[1], scene.friction.of(finger))


def balance(
    scene: Scene, touches: list[Touch], motion: tuple[Array, Array], tau: Array, forces: Array
) -> Array:
    """What is left of Newton's and Euler's laws at n instants, shape (n, 5) [N, N m].

    Parameters
    ----------
    motion : (n, 5)           z' and z''
    tau : (n, 2) [N m]
    forces : (2, n, n_c) [N]  c_n and c_t
    """
    z_dot, z_ddot = motion
    rest = scene.mass_diagonal * z_ddot + scene.viscous * z_dot + scene.dry * np.sign(z_dot)
    rest = rest - scene.applied_force
    rest[:, 3:] -= tau
    for touch, c_n, c_t in zip(touches, forces[0].T, forces[1].T, strict=True):
        rest -= c_n[:, None] * touch.normal + c_t[:, None] * touch.tangent
    return np.asarray(rest)


def clearances(scene: Scene, z: Array) -> dict[str, Array]:
    """Signed distances [m] of every solid pair at n configurations, each of shape (n,).

    Exact where a pair overlaps by a little or faces flat to vertex; elsewhere a lower bound of the
    distance, with the right sign. The palm does not stop a link.
    """
    corners, bones = place_object(scene, z), list[Array]()
    apart = {"object and palm": corners[..., 1].min(axis=1)}
    for finger, link in enumerate(scene.fingers):
        base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
        bones.append(np.stack([base, base + link.length * link_axis(scene, z, finger)], axis=1))
        gap = separate(corners, bones[finger]) - link.radius
        apart[f"object and finger {finger + 1}"] = gap
    if scene.fingers_collide:
        thick = sum(link.radius for link in scene.fingers)
        apart["finger 1 and finger 2"] = separate(*bones) - thick
    return apart


def separate(first: Array, second: Array) -> Array:
    """Signed distance of convex polygons or segments, shape (n, k, 2) and (n, m, 2), as (n,).

    Positive: the distance. Negative: minus the depth of the overlap.
    """
    depth = np.maximum(_reach(first, second), _reach(second, first))
    distance = np.minimum(_nearest(first, second), _nearest(second, first))
    return np.where(depth > 0, distance, depth)


def _reach(first: Array, second: Array) -> Array:
    """Largest gap along the normals of the first body's edges, both ways for a segment."""
    along = np.roll(first, -1, axis=1) - first
    along = along / np.maximum(_norm(along), 1e-300)[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    other = np.einsum("nkd,nmd->nkm", outward, second).min(axis=2)
    return np.asarray((other - _dot(outward, first)).max(axis=1))


def _nearest(points: Array, body: Array) -> Array:
    """Least distance of the points of one body to the edges of another, shape (n,)."""
    along = np.roll(body, -1, axis=1) - body
    apart = points[:, :, None] - body[:, None]
    square = np.maximum(_dot(along, along), 1e-300)
    share = np.clip(_dot(apart, along[:, None]) / square[:, None], 0.0, 1.0)
    return np.asarray(_norm(apart - share[..., None] * along[:, None]).min(axis=(1, 2)))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=-1))


def _norm(a: Array) -> Array:
    return np.sqrt(_dot(a, a))
