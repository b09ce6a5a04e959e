"""Gap limits of a contact formation: ranges of its contacts, other features, link against link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, Store, exclusive
from ..scene.model import Scene
from .elemental import (
    Contact,
    GapLimit,
    build_features,
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
    contacts = []
    for contact in candidate_contacts(scene, finger):
        if contact in held:
            continue
        on_tip = contact.surface == "tip"
        if on_side and on_tip and not (contact.feature == "e" and contact.index in ahead):
            continue
        if tips and not on_side and (on_tip or contact.index not in behind):
            continue
        contacts.append(contact)
    if finger is not None and not held:
        kinds = [("v", "back"), ("e", "joint"), ("v", "joint")]
        kinds = kinds if scene.fingers[finger].radius > 0 else kinds[:2]
        contacts += [Contact(kind, i, part, finger) for kind, part in kinds for i in range(count)]
    elif all((c.surface, c.feature) == ("tip", "e") for c in held):
        for contact in held:
            end = (contact.index + 1 - (finger or 0)) % count
            contacts += [Contact("v", end, "back", finger), replace(contact, surface="joint")]
    limits = [
        build_once(build_clearance, c, scene, bool(held if c.surface == "joint" else on_side))
        for c in contacts
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
        others = build_once(_list_other_gaps, replace(contact, index=0), scene)
        gap = ca.fmax(gap, others[contact.index] - pair.gap)
    return GapLimit(gap, pair.text, gained)


def _list_other_gaps(contact: Contact, scene: Scene) -> list[Expression]:
    """For each edge the largest gap of all others with an end of a link, by running maxima."""
    values = ca.vertsplit(build_features(scene).stack_gaps("e", contact.surface, contact.finger))
    before = list(accumulate(values[:-1], ca.fmax))
    after = list(accumulate(values[:0:-1], ca.fmax))[::-1]
    inner = [ca.fmax(*pair) for pair in zip(before[:-1], after[1:], strict=True)]
    return [after[0], *inner, before[-1]]


def build_apart(scene: Scene, finger: int) -> Expression:
    """Return the signed distance between a link and the object [m], by separating axes.

    Candidates are the normals of link and edges, and the lines from ends of the link to vertices.
    """
    features, part = build_features(scene), scene.fingers[finger]
    link = features.links[finger]
    on_side, at_tip, at_joint = (
        features.stack_gaps(kind, surface, finger)
        for kind, surface in (("v", "finger"), ("e", "tip"), ("e", "joint"))
    )
    parts = [
        ca.mmin(on_side),
        -ca.mmax(on_side) - 2 * part.radius,
        ca.mmax(ca.fmin(at_joint, at_tip)),
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


def measure_gaps(scene: Scene, z: Array) -> Array:
    """Gaps of the bodies at n configurations, shape (n, 4) [m], negative where they overlap.

    Object and palm, object and links 1 and 2, link and link (infinite where they pass each other):
    the largest separation in any direction, independent of the pairs.
    """
    return _GAPS(scene)(z)[0][..., 0]


def _build_gaps(scene: Scene) -> Batch:
    features = build_features(scene)
    gaps = [ca.mmin(features.vertices[1, :]), *(build_apart(scene, k) for k in range(2))]
    gaps.append(build_finger_gap(scene) if scene.fingers_collide else ca.inf)
    return Batch(ca.Function("gaps", [features.z], [ca.densify(ca.vertcat(*gaps))]))


_GAPS = Store(_build_gaps, lambda scene: (scene.shape, scene.fingers_collide))
