"""How far object, links and palm are apart, by separating axes: a check that uses no contacts."""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from ...scene.model import Scene
from .newton import link_axis, place_object


def clearances(scene: Scene, z: Array) -> dict[str, Array]:
    """Signed distances [m] of every solid pair at n configurations, each of shape (n,).

    Exact where a pair overlaps by a little or faces flat to vertex; elsewhere a lower bound of the
    distance, with the right sign. The palm does not stop a link.
    """
    corners = place_object(scene, z)
    bones = [link_bone(scene, z, finger) for finger in (0, 1)]
    apart = {"object and palm": corners[..., 1].min(axis=1)}
    for finger, link in enumerate(scene.fingers):
        gap = separate(corners, bones[finger]) - link.radius
        apart[f"object and finger {finger + 1}"] = gap
    if getattr(scene, "fingers_collide", True):
        thick = sum(link.radius for link in scene.fingers)
        apart["finger 1 and finger 2"] = separate(bones[0], bones[1]) - thick
    return apart


def link_bone(scene: Scene, z: Array, finger: int) -> Array:
    """The segment from joint to tip centre, shape (n, 2, 2) [m]."""
    link = scene.fingers[finger]
    base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
    return np.stack([base, base + link.length * link_axis(scene, z, finger)], axis=1)


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
    along = along / np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-300)[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    own = (outward * first).sum(axis=-1)
    other = np.einsum("nkd,nmd->nkm", outward, second).min(axis=2)
    return np.asarray((other - own).max(axis=1))


def _nearest(points: Array, body: Array) -> Array:
    """Least distance of the points of one body to the edges of another, shape (n,)."""
    start, along = body, np.roll(body, -1, axis=1) - body
    square = np.maximum((along**2).sum(axis=-1), 1e-300)
    apart = points[:, :, None] - start[:, None]
    share = np.clip((apart * along[:, None]).sum(axis=-1) / square[:, None], 0.0, 1.0)
    away = apart - share[..., None] * along[:, None]
    return np.asarray(np.hypot(away[..., 0], away[..., 1]).min(axis=(1, 2)))
