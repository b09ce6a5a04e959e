"""Gap limits of a formation: ranges of its contacts, clearances of other features, of the links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import accumulate, product

import casadi as ca

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, stored
from ..scene.model import Scene
from .elemental import Contact, GapLimit, build_features, candidate_contacts

FINGERS_TOUCH = "finger 1 touches finger 2"  # text of the limit of the gap between the links
ROUNDING = 1e-30  # added to squared distances over squared lengths: normals at coincident points


def separate(first: Expression, second: Expression, size: Expression) -> Expression:
    """Return the signed distance [m] of convex bodies from their corners, (2, n), anticlockwise.

    The distance is the largest separation of their projections over all directions d, or minus the
    penetration depth:

        max_d (min_(p in first) d . p - max_(q in second) d . q)

    Candidates are the normals of edges, of a segment on both sides, and the lines from corner to
    corner; `size` [m] is that of a body, for lines between coincident corners.
    """
    parts = []
    for body, other in ((first, second), (second, first)):
        edges = ca.horzcat(body[:, 1:], body[:, 0]) - body
        outward = ca.vertcat(edges[1, :], -edges[0, :])
        heights = outward.T @ other - ca.repmat(ca.sum1(outward * body).T, 1, other.shape[1])
        nearest = reduce(ca.fmin, ca.horzsplit(heights))
        parts.append(nearest / ca.hypot(edges[0, :], edges[1, :]).T)
    for corner in ca.horzsplit(second):
        vectors, others = (body - ca.repmat(corner, 1, body.shape[1]) for body in (first, second))
        distance = ca.sqrt(ca.sum1(vectors**2) + ROUNDING * size**2).T
        nearest, farthest = (
            reduce(extreme, ca.horzsplit(vectors.T @ points))
            for extreme, points in ((ca.fmin, vectors), (ca.fmax, others))
        )
        parts.append((nearest - farthest) / distance)
    return ca.mmax(ca.vertcat(*parts))


def build_finger_gap(scene: Scene) -> Expression:
    """Return the gap between the two links [m], an expression of the features' symbol z."""
    first, second = (ca.horzcat(link.base, link.tip) for link in build_features(scene).links)
    size = sum(finger.length for finger in scene.fingers)
    thickness = sum(finger.radius for finger in scene.fingers)
    return separate(first, second, size) - thickness


@stored(lambda scene: scene.shape)
def _build_finger_gaps(scene: Scene) -> Batch:
    return Batch(ca.Function("gap", [build_features(scene).z], [build_finger_gap(scene)]))


def evaluate_finger_gap(scene: Scene, z: Array) -> Array:
    """Signed distance of the links at configurations z (n, 5), shape (n,) [m]."""
    return _build_finger_gaps(scene)(z)[0][:, 0, 0]


def list_limits(scene: Scene, contacts: Sequence[Contact]) -> list[GapLimit]:
    """Return every limit of a formation: of its contacts, of other features, and of the links."""
    limits = [limit for c in contacts for limit in build_limits(c, scene)]
    for finger in (None, 0, 1):
        closed = [contact for contact in contacts if contact.finger == finger]
        limits += _list_clearances(scene, finger, closed)
    if scene.fingers_collide:
        limits.append(GapLimit(build_finger_gap(scene), FINGERS_TOUCH))
    return limits


def _list_clearances(scene: Scene, finger: int | None, closed: Sequence[Contact]) -> list[GapLimit]:
    """Clearances of the features that do not touch a part of the hand with `closed` contacts."""
    side = {contact.index for contact in closed if contact.surface == "finger"}
    count = scene.polygon.n_vertices
    # A link that touches a vertex can only turn onto the edge from this vertex towards the tip.
    # A link whose tip touches an edge is outside the edge's line; only the end of the edge behind
    # the tip can reach its side.
    next_edges = {(index - (finger or 0)) % count for index in side}
    tips = [contact for contact in closed if contact.surface == "tip"]
    end_vertices = {(c.index + (finger or 0)) % count for c in tips if c.feature == "e"}

    def may_touch(contact: Contact) -> bool:
        on_tip = contact.surface == "tip"
        if side:
            return not on_tip or (contact.feature == "e" and contact.index in next_edges)
        return not tips or (not on_tip and contact.index in end_vertices)

    contacts = [c for c in candidate_contacts(scene, finger) if c not in closed and may_touch(c)]
    if finger is not None and not closed:
        kinds = [("v", "back"), ("e", "joint"), ("v", "joint")]
        kinds = kinds if scene.fingers[finger].radius > 0 else kinds[:2]
        contacts += [Contact(kind, i, part, finger) for kind, part in kinds for i in range(count)]
    elif all((c.surface, c.feature) == ("tip", "e") for c in closed):
        for contact in closed:
            end = (contact.index + 1 - (finger or 0)) % count
            contacts += [Contact("v", end, "back", finger), replace(contact, surface="joint")]
    limits = [
        build_clearance(c, scene, bool(closed if c.surface == "joint" else side)) for c in contacts
    ]
    if finger is None or closed:
        return limits
    # The object may be on either side of the link: other gaps count where the bodies are apart.
    distance, pairs = build_distance(scene, finger), build_features(scene).pairs
    return [
        limit._replace(value=ca.fmax(limit.value, distance - pairs[c].gap / 2))
        if c.surface in ("finger", "back")
        else limit
        for c, limit in zip(contacts, limits, strict=True)
    ]


@stored(lambda contact, scene: (contact, scene.shape))
def build_limits(contact: Contact, scene: Scene) -> list[GapLimit]:
    """Return the limits of the range of one contact: between base and tip, or two vertices.

    If the range of a neighbouring contact begins there, that contact is gained.
    """
    finger = contact.finger
    if finger is None:
        return []
    pairs, count = build_features(scene).pairs, scene.polygon.n_vertices
    ranges, i, part = pairs[contact].ranges, contact.index, contact.part
    before, after = (i - 1) % count, (i + 1) % count
    pointed = scene.fingers[finger].radius == 0

    def make_contact(feature: str, index: int, surface: str = "tip") -> Contact | None:
        if (feature, surface) == ("v", "tip") and pointed:
            return None
        return Contact(feature, index, surface, finger)

    def list_others(vertex: int) -> tuple[Contact, ...]:
        """Other contacts of a pointed tip at a vertex."""
        side = Contact("v", vertex, "finger", finger)
        edges = [Contact("e", (vertex - k) % count, "tip", finger) for k in (0, 1)]
        return tuple(c for c in (side, *edges) if c != contact) if pointed else ()

    if contact.surface == "finger":
        text = f"v{i} runs off {part} at its"
        return [
            GapLimit(ranges[0], f"{text} base"),
            GapLimit(ranges[1], f"{text} tip", make_contact("v", i), list_others(i)),
        ]
    if contact.feature == "e":
        text = f"{part} runs off edge {i} at v"
        return [
            GapLimit(ranges[0], f"{text}{i}", make_contact("v", i), list_others(i)),
            GapLimit(ranges[1], f"{text}{after}", make_contact("v", after), list_others(after)),
        ]
    # The arc ends at both sides of the link.
    axial, before_range, after_range = ranges
    side = pairs[replace(contact, surface="finger")].gap + scene.fingers[finger].radius
    text = f"v{i} leaves {part} for the"
    return [
        GapLimit(ca.fmax(axial, -side), f"{text} side of the link", make_contact("v", i, "finger")),
        GapLimit(ca.fmax(axial, side), f"{text} far side of the link"),
        GapLimit(before_range, f"edge {before} turns onto {part}", make_contact("e", before)),
        GapLimit(after_range, f"edge {i} turns onto {part}", make_contact("e", i)),
    ]


def takes_over(contact: Contact, scene: Scene, contacts: Sequence[Contact]) -> bool:
    """Whether `contact` is the neighbour of one of `contacts` at the end of its range."""
    limits = (limit for contact in contacts for limit in build_limits(contact, scene))
    return any(limit.gained == contact for limit in limits)


def list_renamed(
    scene: Scene, before: Sequence[Contact], after: Sequence[Contact]
) -> dict[Contact, Contact]:
    """Contacts that continue as those of a neighbouring feature, with the same normal."""
    return {
        old: new
        for old, new in product(before, after)
        if old not in after and new not in before and takes_over(new, scene, [old])
    }


@stored(lambda contact, scene, touching: (contact, scene.shape, touching))
def build_clearance(contact: Contact, scene: Scene, touching: bool) -> GapLimit:
    """Limit at which `contact`, not in the formation, is gained; it counts within its range only.

    If the side of the link is `touching` a vertex, it counts everywhere, by convexity; so does the
    gap between the joint and the edge that the tip touches.
    """
    pair = build_features(scene).pairs[contact]
    gained = contact if contact.surface in ("palm", "finger", "tip") else None
    if contact.finger is None or (touching and contact.surface == "finger"):
        return GapLimit(pair.gap, pair.text, gained)
    gap, ranges = pair.gap, pair.ranges
    if (contact.feature, contact.surface) == ("v", "tip"):
        ranges = tuple(limit.value for limit in build_limits(contact, scene))
    for range_value in ranges:
        gap = ca.fmax(gap, -range_value)
    if contact.feature == "e" and not touching:
        others = _list_other_gaps(scene)[contact.surface, contact.finger]
        gap = ca.fmax(gap, others[contact.index] - pair.gap)
    return GapLimit(gap, pair.text, gained)


@stored(lambda scene: scene.shape)
def _list_other_gaps(scene: Scene) -> dict[tuple[str, int], list[Expression]]:
    """Largest gap of all other edges (running maxima), for each edge, by end of a link."""
    pairs, edges, others = build_features(scene).pairs, range(scene.polygon.n_vertices), {}
    for end, finger in product(("tip", "joint"), (0, 1)):
        values = [pairs[Contact("e", edge, end, finger)].gap for edge in edges]
        maxima_before = list(accumulate(values[:-1], ca.fmax))
        maxima_after = list(accumulate(values[:0:-1], ca.fmax))[::-1]
        inner = [ca.fmax(*pair) for pair in zip(maxima_before[:-1], maxima_after[1:], strict=True)]
        others[end, finger] = [maxima_after[0], *inner, maxima_before[-1]]
    return others


def build_distance(scene: Scene, finger: int) -> Expression:
    """Return the signed distance between a link and the object [m]."""
    features, part = build_features(scene), scene.fingers[finger]
    link = features.links[finger]
    ends = ca.horzcat(link.base, link.tip)
    return separate(features.vertices, ends, part.length) - part.radius


def measure_gaps(scene: Scene, z: Array) -> Array:
    """Gaps of the bodies at n configurations, shape (n, 4) [m], negative where they overlap.

    Object and palm, object and links 1 and 2, link and link (infinite if they do not collide): the
    largest separation in any direction, independent of the elemental contacts.
    """
    return _build_gaps(scene)(z)[0][..., 0]


@stored(lambda scene: (scene.shape, scene.fingers_collide))
def _build_gaps(scene: Scene) -> Batch:
    features = build_features(scene)
    gaps = [ca.mmin(features.vertices[1, :]), *(build_distance(scene, k) for k in range(2))]
    gaps.append(build_finger_gap(scene) if scene.fingers_collide else ca.inf)
    return Batch(ca.Function("gaps", [features.z], [ca.densify(ca.vertcat(*gaps))]))
