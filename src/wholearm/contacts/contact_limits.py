"""Gap limits of a contact formation: ranges of its contacts, other features, link against link."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, exclusive
from ..scene.model import Scene
from .elemental import (
    Contact,
    GapLimit,
    build_features,
    build_gap,
    build_once,
    candidate_contacts,
    rotate_quarter,
)

FINGERS_TOUCH = "finger 1 touches finger 2"  # sentence for where the gap of the fingers is zero
ROUNDING = 1e-30  # added to squared distances over squared lengths: normals at coincident points


def build_finger_gap(scene: Scene) -> Expression:
    """Return the gap between the two links [m], an expression of the features' symbol z."""
    axes, _ = _build_separation()
    thickness = sum(link.radius for link in scene.fingers)
    return axes(build_features(scene).z[3:], _list_numbers(scene)) - thickness


def _list_numbers(scene: Scene) -> Array:
    """Base and length of both links, shape (6,) [m]."""
    return np.concatenate([[*np.asarray(link.base), link.length] for link in scene.fingers])


@lru_cache(maxsize=1)
def _build_separation() -> tuple[Expression, Batch]:
    """CasADi function of theta and (base, length) of both links: the gap between their axes.

    The distance of two convex bodies is the largest separation of their projections over all
    directions d, or minus the penetration depth. For two segments the candidates are both sides of
    each link and the lines from an end of one to an end of the other, so that

        gap = max_d (min_(q on link 2) d . q - max_(p on link 1) d . p)

    is their distance when apart, minus the depth when they overlap, and continuous.
    """
    theta, numbers = ca.SX.sym("theta", 2), ca.SX.sym("numbers", 6)
    bases, lengths = (numbers[:2], numbers[3:5]), (numbers[2], numbers[5])
    axes = [ca.vertcat(ca.cos(theta[k]), ca.sin(theta[k])) for k in range(2)]
    tips = [bases[k] + lengths[k] * axes[k] for k in range(2)]
    parts = []
    for k, other in ((0, 1), (1, 0)):
        away = ca.horzcat(bases[other] - bases[k], tips[other] - bases[k])
        ends = rotate_quarter(axes[k]).T @ away
        parts += [ca.fmin(ends[0], ends[1]), -ca.fmax(ends[0], ends[1])]
    # From base and tip of link 1 to base and tip of link 2; each link goes on from there along its
    # axis or against it, and what goes on towards the other link takes from the separation.
    first = ca.horzcat(bases[0], bases[0], tips[0], tips[0])
    run = ca.horzcat(bases[1], tips[1], bases[1], tips[1]) - first
    distance = ca.sqrt(ca.sum1(run**2) + ROUNDING * (lengths[0] + lengths[1]) ** 2)
    onwards = axes[0].T @ run * ca.DM([[1.0, 1.0, -1.0, -1.0]]) * lengths[0]
    backwards = axes[1].T @ run * ca.DM([[-1.0, 1.0, -1.0, 1.0]]) * lengths[1]
    parts.append((distance - (ca.fmax(onwards, 0) + ca.fmax(backwards, 0)) / distance).T)
    function = ca.Function("finger_gap", [theta, numbers], [ca.mmax(ca.vertcat(*parts))])
    return function, Batch(function)


@exclusive
def evaluate_finger_gap(scene: Scene, z: Array) -> Array:
    """Signed distance of the links at configurations z (n, 5), (n,) [m]; NaN where theta is."""
    numbers = np.broadcast_to(_list_numbers(scene), (len(z), 6))
    gaps = _build_separation()[1](z[:, 3:], numbers)[0][:, 0, 0]
    return np.asarray(gaps - sum(link.radius for link in scene.fingers))


def list_limits(scene: Scene, contacts: Sequence[Contact]) -> list[GapLimit]:
    """Return every limit of a formation: of its contacts, of other features, and of the links."""
    limits = [limit for c in contacts for limit in build_once(build_limits, c, scene)]
    for finger in (None, 0, 1):
        held = [contact for contact in contacts if contact.finger == finger]
        clearances = _list_clearances(scene, finger, held)
        limits += clearances if finger is None else _list_obstacles(scene, finger, held, clearances)
    if scene.fingers_collide:
        limits.append(GapLimit(build_finger_gap(scene), FINGERS_TOUCH))
    return limits


def _list_clearances(scene: Scene, finger: int | None, held: Sequence[Contact]) -> list[GapLimit]:
    """Limits at which contacts with one part of the hand are gained that it does not have."""
    on_side = {contact.index for contact in held if contact.surface == "finger"}
    count = scene.polygon.n_vertices
    # A link that touches a vertex can only turn onto the edge that leads from it to the tip;
    # one whose tip touches an edge is outside the edge's line, and only the end of the edge
    # that is behind the tip can come to its side.
    ahead = {(index - (finger or 0)) % count for index in on_side}
    tips = [contact for contact in held if contact.surface == "tip"]
    behind = {(c.index + (finger or 0)) % count for c in tips if c.feature == "e"}
    limits = []
    for contact in candidate_contacts(scene, finger):
        if contact in held:
            continue
        on_tip = contact.surface == "tip"
        if on_side and on_tip and not (contact.feature == "e" and contact.index in ahead):
            continue
        if tips and not on_side and (on_tip or contact.index not in behind):
            continue
        limits.append(build_once(build_clearance, contact, scene, bool(on_side)))
    return limits


def build_limits(contact: Contact, scene: Scene) -> list[GapLimit]:
    """Return the limits of one contact's own range: between base and tip, between two vertices.

    Where the range goes over into that of a neighbour, the neighbour is the contact gained.
    """
    finger = contact.finger
    if finger is None:
        return []
    link = build_features(scene).links[finger]
    lengths = build_features(scene).edge_lengths
    i, part, count = contact.index, contact.part, len(lengths)
    before, after = (i - 1) % count, (i + 1) % count
    pointed = scene.fingers[finger].radius == 0

    def gains(feature: str, index: int, surface: str = "tip") -> Contact | None:
        if (feature, surface) == ("v", "tip") and pointed:
            return None
        return Contact(feature, index, surface, finger)

    def meeting(vertex: int) -> tuple[Contact, ...]:
        """What else a pointed tip touches at a vertex."""
        side = Contact("v", vertex, "finger", finger)
        edges = [Contact("e", (vertex - k) % count, "tip", finger) for k in (0, 1)]
        return tuple(c for c in (side, *edges) if c != contact) if pointed else ()

    if contact.surface == "finger":
        run = link.vertex_run[i]
        off = f"v{i} runs off {part} at its"
        return [
            GapLimit(run, f"{off} base"),
            GapLimit(scene.fingers[finger].length - run, f"{off} tip", gains("v", i), meeting(i)),
        ]
    if contact.feature == "e":
        run = link.edge_run[i]
        off = f"{part} runs off edge {i} at v"
        return [
            GapLimit(run, f"{off}{i}", gains("v", i), meeting(i)),
            GapLimit(lengths[i] - run, f"{off}{after}", gains("v", after), meeting(after)),
        ]
    # Both sides of the link begin where the arc ends.
    beyond, side = link.arc_run[i], link.vertex_gap[i] + scene.fingers[finger].radius
    off = f"v{i} leaves {part} for the"
    return [
        GapLimit(ca.fmax(beyond, -side), f"{off} side of the link", gains("v", i, "finger")),
        GapLimit(ca.fmax(beyond, side), f"{off} far side of the link"),
        GapLimit(
            link.edge_run[before] - lengths[before],
            f"edge {before} turns onto {part}",
            gains("e", before),
        ),
        GapLimit(-link.edge_run[i], f"edge {i} turns onto {part}", gains("e", i)),
    ]


def takes_over(contact: Contact, scene: Scene, held: Sequence[Contact]) -> bool:
    """Whether `contact` is the neighbour of one of `held` at the end of its range."""
    limits = (limit for contact in held for limit in build_once(build_limits, contact, scene))
    return any(limit.gained == contact for limit in limits)


def list_renamed(
    scene: Scene, before: Sequence[Contact], after: Sequence[Contact]
) -> dict[Contact, Contact]:
    """Contacts that go on as those of a neighbouring feature, which their normals agree with."""
    lost, new = (
        [c for c in contacts if c not in other]
        for contacts, other in ((before, after), (after, before))
    )
    return {old: c for old in lost for c in new if takes_over(c, scene, [old])}


def build_clearance(contact: Contact, scene: Scene, touching: bool) -> GapLimit:
    """Limit at which `contact`, not in the formation, is gained; gaps beyond ends do not count.

    With a link that touches a vertex with its side (`touching`) they do, by convexity.
    """
    gap = line_gap = build_gap(contact, scene)
    text = f"{contact.corner} touches {contact.part}"
    if contact.finger is None or (touching and contact.surface == "finger"):
        return GapLimit(gap, text, contact)
    features, i = build_features(scene), contact.index
    link = features.links[contact.finger]
    if contact.surface == "finger":
        gap = _confine(gap, link.vertex_run[i], scene.fingers[contact.finger].length)
    elif contact.feature == "e":
        gap = _confine(gap, link.edge_run[i], float(features.edge_lengths[i]))
        gap = gap if touching else ca.fmax(gap, link.other_gap[i] - line_gap)
    else:
        for limit in build_limits(contact, scene):
            gap = ca.fmax(gap, -limit.value)
    return GapLimit(gap, text, contact)


def _build_far_side(scene: Scene, finger: int, vertex: int, apart: Expression | None) -> GapLimit:
    """Limit at which a vertex touches a link's far side; `apart` as of `_confine`."""
    link, part = build_features(scene).links[finger], scene.fingers[finger]
    gap = -link.vertex_gap[vertex] - 2 * part.radius
    text = f"v{vertex} touches the far side of finger {finger + 1}"
    return GapLimit(_confine(gap, link.vertex_run[vertex], part.length, apart), text)


def _build_joint_edge(scene: Scene, finger: int, edge: int, held: bool) -> GapLimit:
    """Limit at which an edge touches a joint's circle; `held`: the tip touches that edge."""
    features = build_features(scene)
    gaps, runs = _place_joint(scene, finger)
    gap = _confine(gaps[edge], runs[edge], float(features.edge_lengths[edge]))
    for other in range(0 if held else gaps.shape[1]):
        if other != edge:
            gap = ca.fmax(gap, gaps[other] - gaps[edge])
    return GapLimit(gap, f"e{edge} touches the joint of finger {finger + 1}")


def _build_joint_vertex(scene: Scene, finger: int, vertex: int) -> GapLimit:
    """Limit at which a vertex touches the circle about a joint."""
    features = build_features(scene)
    link, lengths = features.links[finger], features.edge_lengths
    _, runs = _place_joint(scene, finger)
    before = (vertex - 1) % len(lengths)
    away = features.vertices[:, vertex] - link.base
    gap = ca.sqrt(ca.sum1(away**2)) - scene.fingers[finger].radius
    beyond = ca.fmax(runs[vertex], float(lengths[before]) - runs[before])
    gap = ca.fmax(gap, ca.fmax(link.vertex_run[vertex], beyond))
    return GapLimit(gap, f"v{vertex} touches the joint of finger {finger + 1}")


def _list_obstacles(
    scene: Scene, finger: int, held: list[Contact], gained: list[GapLimit]
) -> list[GapLimit]:
    """Limits of a link with its contacts `held`: those `gained`, of its far side and its joint."""
    vertices = range(scene.polygon.n_vertices)
    if held:
        if any((c.surface, c.feature) != ("tip", "e") for c in held):
            return gained
        for contact in held:
            ahead = (contact.index + 1 - finger) % len(vertices)
            gained.append(_build_far_side(scene, finger, ahead, None))
            gained.append(_build_joint_edge(scene, finger, contact.index, held=True))
        return gained
    # The object may be on the far side, too.
    apart, gaps = build_apart(scene, finger), build_features(scene).links[finger].vertex_gap
    limits = [
        limit._replace(value=ca.fmax(limit.value, apart - gaps[limit.gained.index] / 2))
        if limit.gained is not None and limit.gained.surface == "finger"
        else limit
        for limit in gained
    ]
    limits += [_build_far_side(scene, finger, i, apart) for i in vertices]
    limits += [_build_joint_edge(scene, finger, i, held=False) for i in vertices]
    if scene.fingers[finger].radius > 0:
        limits += [_build_joint_vertex(scene, finger, i) for i in vertices]
    return limits


def _confine(
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
    for end, other in ((link.base, link.tip), (link.tip, link.base)):
        rays = features.vertices - ca.repmat(end, 1, features.vertices.shape[1])
        distance = ca.sqrt(ca.sum1(rays**2) + ROUNDING * part.length**2)
        table = rays.T @ ca.horzcat(rays, other - end) / ca.repmat(distance.T, 1, rays.shape[1] + 1)
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
