"""Gap limits between the object and the far side of a link or the circle about its joint.

A link that touches a vertex, with side or tip, needs none of these: by convexity its line or the
tangent to the tip separates it from the object. One whose tip touches an edge can only turn onto
the edge's line, with either side.
"""

from __future__ import annotations

import casadi as ca

from ..common.arrays import Expression
from ..scene.model import Scene
from .elemental import Contact, GapLimit, build_features
from .links import ROUNDING


def build_far_side(scene: Scene, finger: int, vertex: int, apart: Expression | None) -> GapLimit:
    """Return the limit at which a vertex touches a link's far side; `apart` as of `confine`."""
    link, part = build_features(scene).links[finger], scene.fingers[finger]
    gap = -link.vertex_gap[vertex] - 2 * part.radius
    text = f"v{vertex} touches the far side of finger {finger + 1}"
    return GapLimit(confine(gap, link.vertex_run[vertex], part.length, apart), text)


def build_joint_edge(scene: Scene, finger: int, edge: int, held: bool) -> GapLimit:
    """Limit at which an edge touches a joint's circle; `held`: the tip touches that edge."""
    features = build_features(scene)
    gaps, runs = _place_joint(scene, finger)
    gap = confine(gaps[edge], runs[edge], float(features.edge_lengths[edge]))
    for other in range(0 if held else gaps.shape[1]):
        if other != edge:
            gap = ca.fmax(gap, gaps[other] - gaps[edge])
    return GapLimit(gap, f"e{edge} touches the joint of finger {finger + 1}")


def build_joint_vertex(scene: Scene, finger: int, vertex: int) -> GapLimit:
    """Return the limit at which a vertex touches the circle about a joint."""
    features = build_features(scene)
    link, lengths = features.links[finger], features.edge_lengths
    _, runs = _place_joint(scene, finger)
    before = (vertex - 1) % len(lengths)
    away = features.vertices[:, vertex] - link.base
    gap = ca.sqrt(ca.sum1(away**2)) - scene.fingers[finger].radius
    beyond = ca.fmax(runs[vertex], float(lengths[before]) - runs[before])
    gap = ca.fmax(gap, ca.fmax(link.vertex_run[vertex], beyond))
    return GapLimit(gap, f"v{vertex} touches the joint of finger {finger + 1}")


def build_obstacles(scene: Scene, finger: int, held: list[Contact]) -> list[GapLimit]:
    """Return the limits of a link's far side and joint, with its contacts `held`."""
    vertices = range(scene.polygon.n_vertices)
    if not held:
        apart = build_apart(scene, finger)
        limits = [build_far_side(scene, finger, i, apart) for i in vertices]
        limits += [build_joint_edge(scene, finger, i, held=False) for i in vertices]
        if scene.fingers[finger].radius > 0:
            limits += [build_joint_vertex(scene, finger, i) for i in vertices]
        return limits
    if any((c.surface, c.feature) != ("tip", "e") for c in held):
        return []
    limits = []
    for contact in held:
        ahead = (contact.index + 1 - finger) % len(vertices)
        limits.append(build_far_side(scene, finger, ahead, None))
        limits.append(build_joint_edge(scene, finger, contact.index, held=True))
    return limits


def face(scene: Scene, finger: int, limits: list[GapLimit]) -> list[GapLimit]:
    """Return limits of a link without contacts for an object that may be on its far side, too."""
    apart = build_apart(scene, finger)
    gaps = build_features(scene).links[finger].vertex_gap
    return [
        limit._replace(value=ca.fmax(limit.value, apart - gaps[limit.gained.index] / 2))
        if limit.gained is not None and limit.gained.surface == "finger"
        else limit
        for limit in limits
    ]


def confine(
    gap: Expression, run: Expression, length: float, apart: Expression | None = None
) -> Expression:
    """Return a gap that counts only where 0 <= run <= length.

    With `apart`, the gap of the whole bodies, it counts only where they overlap nowhere else.
    """
    value = ca.fmax(gap, ca.fmax(-run, run - length))
    return value if apart is None else ca.fmax(value, apart - gap / 2)


def build_apart(scene: Scene, finger: int) -> Expression:
    """Return the signed distance between a link and the object [m], by separating axes.

    Candidates are the normals of link and edges, and the lines from ends of the link to vertices.
    """
    features = build_features(scene)
    link, part = features.links[finger], scene.fingers[finger]
    at_joint, _ = _place_joint(scene, finger)
    parts = [
        ca.mmin(link.vertex_gap),
        -ca.mmax(link.vertex_gap) - 2 * part.radius,
        ca.mmax(ca.fmin(at_joint, link.edge_gap)),
    ]
    for own, other in ((link.base, link.tip), (link.tip, link.base)):
        rays = features.vertices - ca.repmat(own, 1, features.vertices.shape[1])
        distance = ca.sqrt(ca.sum1(rays**2) + ROUNDING * part.length**2)
        table = rays.T @ ca.horzcat(rays, other - own) / ca.repmat(distance.T, 1, rays.shape[1] + 1)
        nearest = table[:, 0]
        for column in range(1, rays.shape[1]):
            nearest = ca.fmin(nearest, table[:, column])
        parts.append(ca.mmax(nearest - ca.fmax(table[:, -1], 0)) - part.radius)
    return ca.mmax(ca.vertcat(*parts))


def _place_joint(scene: Scene, finger: int) -> tuple[Expression, Expression]:
    """Gaps of a joint's circle with each edge's line, and runs along it, shape (1, n_v) [m]."""
    features = build_features(scene)
    to_joint = ca.repmat(features.links[finger].base, 1, features.vertices.shape[1])
    to_joint = to_joint - features.vertices
    normals = features.edge_normals
    along = ca.vertcat(normals[1, :], -normals[0, :])
    return -ca.sum1(normals * to_joint) - scene.fingers[finger].radius, ca.sum1(along * to_joint)
