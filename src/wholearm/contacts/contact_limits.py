"""Gap limits of a contact formation: ranges of its contacts, other features, link against link."""

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

FINGERS_TOUCH = "finger 1 touches finger 2"  # sentence for where the gap of the fingers is zero
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
        along = ca.horzcat(body[:, 1:], body[:, 0]) - body
        outward = ca.vertcat(along[1, :], -along[0, :])
        levels = outward.T @ other - ca.repmat(ca.sum1(outward * body).T, 1, other.shape[1])
        nearest = reduce(ca.fmin, ca.horzsplit(levels))
        parts.append(nearest / ca.hypot(along[0, :], along[1, :]).T)
    for corner in ca.horzsplit(second):
        runs, others = (body - ca.repmat(corner, 1, body.shape[1]) for body in (first, second))
        distance = ca.sqrt(ca.sum1(runs**2) + ROUNDING * size**2).T
        nearest, farthest = (
            reduce(choose, ca.horzsplit(runs.T @ points))
            for choose, points in ((ca.fmin, runs), (ca.fmax, others))
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
        held = [contact for contact in contacts if contact.finger == finger]
        limits += _list_clearances(scene, finger, held)
    if scene.fingers_collide:
        limits.append(GapLimit(build_finger_gap(scene), FINGERS_TOUCH))
    return limits


def _list_clearances(scene: Scene, finger: int | None, held: Sequence[Contact]) -> list[GapLimit]:
    """Limits of the features that do not touch a part of the hand whose contacts are `held`."""
    on_side = {contact.index for contact in held if contact.surface == "finger"}
    count = scene.polygon.n_vertices
    # A link that touches a vertex can only turn onto the edge that leads from it to the tip;
    # one whose tip touches an edge is outside the edge's line, and only the end of the edge
    # that is behind the tip can come to its side.
    ahead = {(index - (finger or 0)) % count for index in on_side}
    tips = [contact for contact in held if contact.surface == "tip"]
    behind = {(c.index + (finger or 0)) % count for c in tips if c.feature == "e"}

    def may_touch(contact: Contact) -> bool:
        on_tip = contact.surface == "tip"
        if on_side:
            return not on_tip or (contact.feature == "e" and contact.index in ahead)
        return not tips or (not on_tip and contact.index in behind)

    contacts = [c for c in candidate_contacts(scene, finger) if c not in held and may_touch(c)]
    if finger is not None and not held:
        kinds = [("v", "back"), ("e", "joint"), ("v", "joint")]
        kinds = kinds if scene.fingers[finger].radius > 0 else kinds[:2]
        contacts += [Contact(kind, i, part, finger) for kind, part in kinds for i in range(count)]
    elif all((c.surface, c.feature) == ("tip", "e") for c in held):
        for contact in held:
            end = (contact.index + 1 - (finger or 0)) % count
            contacts += [Contact("v", end, "back", finger), replace(contact, surface="joint")]
    limits = [
        build_clearance(c, scene, bool(held if c.surface == "joint" else on_side)) for c in contacts
    ]
    if finger is None or held:
        return limits
    # The object may be on either side of the link: gaps count where they overlap nowhere else.
    apart, pairs = build_apart(scene, finger), build_features(scene).pairs
    return [
        limit._replace(value=ca.fmax(limit.value, apart - pairs[c].gap / 2))
        if c.surface in ("finger", "back")
        else limit
        for c, limit in zip(contacts, limits, strict=True)
    ]


@stored(lambda contact, scene: (contact, scene.shape))
def build_limits(contact: Contact, scene: Scene) -> list[GapLimit]:
    """Return the limits of one contact's own range: between base and tip, between two vertices.

    Where the range goes over into that of a neighbour, the neighbour is the contact gained.
    """
    finger = contact.finger
    if finger is None:
        return []
    pairs, count = build_features(scene).pairs, scene.polygon.n_vertices
    ranges, i, part = pairs[contact].ranges, contact.index, contact.part
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
        off = f"v{i} runs off {part} at its"
        return [
            GapLimit(ranges[0], f"{off} base"),
            GapLimit(ranges[1], f"{off} tip", gains("v", i), meeting(i)),
        ]
    if contact.feature == "e":
        off = f"{part} runs off edge {i} at v"
        return [
            GapLimit(ranges[0], f"{off}{i}", gains("v", i), meeting(i)),
            GapLimit(ranges[1], f"{off}{after}", gains("v", after), meeting(after)),
        ]
    # Both sides of the link begin where the arc ends.
    beyond, turned_before, turned = ranges
    side = pairs[replace(contact, surface="finger")].gap + scene.fingers[finger].radius
    off = f"v{i} leaves {part} for the"
    return [
        GapLimit(ca.fmax(beyond, -side), f"{off} side of the link", gains("v", i, "finger")),
        GapLimit(ca.fmax(beyond, side), f"{off} far side of the link"),
        GapLimit(turned_before, f"edge {before} turns onto {part}", gains("e", before)),
        GapLimit(turned, f"edge {i} turns onto {part}", gains("e", i)),
    ]


def takes_over(contact: Contact, scene: Scene, held: Sequence[Contact]) -> bool:
    """Whether `contact` is the neighbour of one of `held` at the end of its range."""
    limits = (limit for contact in held for limit in build_limits(contact, scene))
    return any(limit.gained == contact for limit in limits)


def list_renamed(
    scene: Scene, before: Sequence[Contact], after: Sequence[Contact]
) -> dict[Contact, Contact]:
    """Contacts that go on as those of a neighbouring feature, which their normals agree with."""
    return {
        old: new
        for old, new in product(before, after)
        if old not in after and new not in before and takes_over(new, scene, [old])
    }


@stored(lambda contact, scene, touching: (contact, scene.shape, touching))
def build_clearance(contact: Contact, scene: Scene, touching: bool) -> GapLimit:
    """Limit at which `contact`, not in the formation, is gained; gaps beyond ends do not count.

    With a link that is `touching` a vertex with its side they do, by convexity; as does the gap of
    a joint with the edge that the tip touches, wherever other edges are.
    """
    pair = build_features(scene).pairs[contact]
    gained = contact if contact.surface in ("palm", "finger", "tip") else None
    if contact.finger is None or (touching and contact.surface == "finger"):
        return GapLimit(pair.gap, pair.text, gained)
    gap, ranges = pair.gap, pair.ranges
    if (contact.feature, contact.surface) == ("v", "tip"):
        ranges = tuple(limit.value for limit in build_limits(contact, scene))
    for inside in ranges:
        gap = ca.fmax(gap, -inside)
    if contact.feature == "e" and not touching:
        others = _list_other_gaps(scene)[contact.surface, contact.finger]
        gap = ca.fmax(gap, others[contact.index] - pair.gap)
    return GapLimit(gap, pair.text, gained)


@stored(lambda scene: scene.shape)
def _list_other_gaps(scene: Scene) -> dict[tuple[str, int], list[Expression]]:
    """For each edge the largest gap of all others, by the end of which link; by running maxima."""
    pairs, edges, others = build_features(scene).pairs, range(scene.polygon.n_vertices), {}
    for end, finger in product(("tip", "joint"), (0, 1)):
        values = [pairs[Contact("e", edge, end, finger)].gap for edge in edges]
        before = list(accumulate(values[:-1], ca.fmax))
        after = list(accumulate(values[:0:-1], ca.fmax))[::-1]
        inner = [ca.fmax(*pair) for pair in zip(before[:-1], after[1:], strict=True)]
        others[end, finger] = [after[0], *inner, before[-1]]
    return others


def build_apart(scene: Scene, finger: int) -> Expression:
    """Return the signed distance between a link and the object [m]."""
    features, part = build_features(scene), scene.fingers[finger]
    link = features.links[finger]
    ends = ca.horzcat(link.base, link.tip)
    return separate(features.vertices, ends, part.length) - part.radius


def measure_gaps(scene: Scene, z: Array) -> Array:
    """Gaps of the bodies at n configurations, shape (n, 4) [m], negative where they overlap.

    Object and palm, object and links 1 and 2, link and link (infinite where they pass each other):
    the largest separation in any direction, independent of the pairs.
    """
    return _build_gaps(scene)(z)[0][..., 0]


@stored(lambda scene: (scene.shape, scene.fingers_collide))
def _build_gaps(scene: Scene) -> Batch:
    features = build_features(scene)
    gaps = [ca.mmin(features.vertices[1, :]), *(build_apart(scene, k) for k in range(2))]
    gaps.append(build_finger_gap(scene) if scene.fingers_collide else ca.inf)
    return Batch(ca.Function("gaps", [features.z], [ca.densify(ca.vertcat(*gaps))]))
