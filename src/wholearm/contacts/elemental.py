"""Elemental contacts: a C-function and a slip coordinate each, as CasADi expressions of z.

==============  ==============================  =======================================
name            touching                        C-function
==============  ==============================  =======================================
``v3-palm``     vertex 3 on the palm            height of the vertex
``v3-finger1``  vertex 3 on the side of link 1  n . (p - base) - radius
``e2-tip1``     fingertip 1 on edge 2           m . (tip - p_2) - radius
``v3-tip1``     vertex 3 on the arc of tip 1    abs(p - tip) - radius
``v3-back1``    vertex 3, far side of link 1    -n . (p - base) - radius
``v3-joint1``   vertex 3, circle about joint 1  abs(p - base) - radius
``e2-joint1``   edge 2, circle about joint 1    m . (base - p_2) - radius
==============  ==============================  =======================================

p is a vertex in the world, n the normal of the contact (into the object), m = -n the outward normal
of an edge; edge j runs from vertex j to vertex j + 1. Finger 1 touches with its left side, finger 2
with its right one; far sides and joints only stop a motion. Slip coordinates, whose rates are the
sliding velocities v_t of closed contacts:

* vertex on the palm: x of the vertex;
* vertex on a link: place along it, towards the tip for finger 1, the joint for finger 2;
* tip on an edge: minus the place along the edge and the arc rolled;
* vertex on a tip: minus the arc from the link's axis.

The rows of Eq. (4), A = [W_n^T, -J_n] and A_t = [W_t^T, -J_t], are the gradients of both.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca

from ..common.arrays import Expression
from ..common.errors import InputError
from ..common.sharing import stored
from ..scene.model import Scene

_Z = ca.SX.sym("z", 5)  # of all scenes: limits that they share outlive the one that built them
_PATTERN = re.compile(r"(v|e)(0|[1-9][0-9]*)-(?:(palm)|(finger|tip)([12]))")


@dataclass(frozen=True)
class Contact:
    """An elemental contact between a feature of the object and a part of the hand."""

    feature: str  # {"v", "e"}: a vertex or an edge of the object
    index: int  # which vertex or edge
    # {"palm", "finger", "tip"}: the palm, the side of a link or the tip of a link; as obstacles
    # only {"back", "joint"}: the far side of a link or the circle about its joint
    surface: str
    finger: int | None = None  # 0 for finger 1, 1 for finger 2, None for the palm

    @property
    def name(self) -> str:
        """Name as written in problem files."""
        return f"{self.corner}-{self.surface}{'' if self.finger is None else self.finger + 1}"

    @property
    def corner(self) -> str:
        """Name of the object's feature alone, such as ``v3``."""
        return f"{self.feature}{self.index}"

    @property
    def part(self) -> str:
        """The part of the hand, in words."""
        if self.finger is None:
            return "the palm"
        prefixes = {"tip": "the tip of ", "back": "the far side of ", "joint": "the joint of "}
        return f"{prefixes.get(self.surface, '')}finger {self.finger + 1}"

    def __str__(self) -> str:
        return self.name


class ContactPair(NamedTuple):
    """Two features that may touch, as expressions of z."""

    name: str
    gap: Expression  # [m]: the C-function, positive when apart
    slip: Expression  # [m]: its rate is the sliding velocity v_t while they touch
    # [m]: all positive where the two features face each other; elsewhere the gap has no meaning
    ranges: tuple[Expression, ...] = ()
    text: str = ""  # the event when the gap closes, in words


class Link(NamedTuple):
    """A link as expressions of z."""

    base: Expression  # base, tip (2,) [m]: the joint, and the centre of the tip
    tip: Expression
    axis: Expression  # axis, normal (2,): directions of the tip and of the touching side
    normal: Expression
    length: Expression  # length, radius [m]
    radius: Expression


class Features(NamedTuple):
    """Object and hand as expressions of z, with all pairs of features."""

    z: Expression  # (5,)
    vertices: Expression  # (2, n_v) [m]: world positions of the vertices
    links: tuple[Link, ...]  # finger 1, finger 2
    pairs: dict[Contact, ContactPair]  # of all features of the object with all of the hand


class GapLimit(NamedTuple):
    """A quantity that is positive while a contact formation is valid."""

    value: Expression  # [m]
    text: str  # the event when it is zero
    gained: Contact | None = None  # the contact that is gained there, if any
    # other contacts that may be gained there: a pointed tip at a vertex may continue along either
    # edge, or along the link
    alternatives: tuple[Contact, ...] = ()

    def gains(self, contact: Contact | None) -> bool:
        """Whether a contact is gained there."""
        return contact is not None and (contact == self.gained or contact in self.alternatives)


def parse_contact(name: object, scene: Scene) -> Contact:
    """Return the contact called `name`; an `InputError` lists what is allowed."""
    count = scene.polygon.n_vertices
    match = _PATTERN.fullmatch(name) if isinstance(name, str) else None
    allowed = (
        f"allowed are vN-palm, vN-fingerK, eN-tipK and vN-tipK with N from 0 to {count - 1} "
        "and K 1 or 2"
    )
    if match is None:
        raise InputError("", "", f"{name!r} is not a contact; {allowed}")
    feature, index, palm, part, number = match.groups()
    contact = Contact(feature, int(index), palm or part, int(number) - 1 if number else None)
    if contact.index >= count or (feature == "e" and part != "tip"):
        raise InputError("", "", f"{name!r} does not exist; {allowed}")
    if (feature, part) == ("v", "tip") and scene.fingers[int(number) - 1].radius == 0:
        text = f"{name!r} needs a rounded tip, but fingers.{number}.radius is 0; give it a radius"
        raise InputError("", "", text)
    return contact


def candidate_contacts(scene: Scene, finger: int | None) -> list[Contact]:
    """Every contact that the object can have with the palm (None) or with one finger."""
    kinds, count = [("v", "palm")], scene.polygon.n_vertices
    if finger is not None:
        rounded = scene.fingers[finger].radius > 0
        kinds = [("v", "finger"), ("e", "tip"), ("v", "tip")][: 2 + rounded]
    return [Contact(kind, k, surface, finger) for kind, surface in kinds for k in range(count)]


@stored(lambda scene: scene.shape)
def build_features(scene: Scene) -> Features:
    """The features of a scene as expressions of z, shared by scenes of the same shape."""
    links = [(ca.DM(link.base), link.length, link.radius) for link in scene.fingers]
    return place_bodies(ca.DM(scene.polygon.vertices.T), links)


def place_bodies(corners: Expression, links: Sequence[tuple[Expression, ...]]) -> Features:
    """Object and hand from corners, (2, n_v), and base, length and radius of each link [m]."""
    z, count = _Z, corners.shape[1]
    along = ca.horzcat(corners[:, 1:], corners[:, :1]) - corners
    lengths = ca.hypot(along[0, :], along[1, :])
    c, s = ca.cos(z[2]), ca.sin(z[2])
    rotation = ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))
    vertices = rotation @ corners + ca.repmat(z[:2], 1, count)
    x, y = corners[0, :], corners[1, :]
    units = along / ca.repmat(lengths, 2, 1)
    # Products with the vertices do not depend on the pose.
    starts, depths = units[0, :] * x + units[1, :] * y, units[0, :] * y - units[1, :] * x
    units = rotation @ units
    normals = ca.vertcat(-units[1, :], units[0, :])
    # Gap, slip and ranges of each kind of pair, as rows over all vertices or edges.
    bodies, kinds = list[Link](), list[tuple[int | None, dict[str, tuple[Expression, ...]]]]()
    kinds.append((None, {"v palm": (vertices[1, :], vertices[0, :])}))
    for finger, (base, length, radius) in enumerate(links):
        side, theta = 1.0 - 2 * finger, z[3 + finger]
        axis = ca.vertcat(ca.cos(theta), ca.sin(theta))
        link = Link(base, base + length * axis, axis, side * rotate_quarter(axis), length, radius)
        bodies.append(link)
        r = vertices - ca.repmat(base, 1, count)
        along, heights = axis.T @ r, link.normal.T @ r
        ranges_on_link = along, length - along
        sides = {
            "v finger": (heights - radius, side * along, *ranges_on_link),
            "v back": (-heights - radius, -side * along, *ranges_on_link),
        }
        kinds.append((finger, sides))
        for surface, centre, out in (("tip", link.tip, axis), ("joint", base, -axis)):
            place, r = centre - z[:2], vertices - ca.repmat(centre, 1, count)
            along, depth = place.T @ units - starts, place.T @ normals - depths
            remaining = lengths - along
            edges = -depth - radius, -along - radius * (z[2] - theta), along, remaining
            axial, angle = out.T @ r, ca.atan2(rotate_quarter(out).T @ r, out.T @ r)
            before_range = -ca.horzcat(remaining[-1], remaining[:-1])
            arcs = ca.sqrt(ca.sum1(r**2)) - radius, -radius * angle, axial, before_range, -along
            kinds.append((finger, {f"e {surface}": edges, f"v {surface}": arcs}))
    pairs = {}
    for owner, rows in kinds:
        columns = [zip(*map(ca.horzsplit, row), strict=True) for row in rows.values()]
        for k, entries in enumerate(zip(*columns, strict=True)):
            for kind, (gap, slip, *ranges) in zip(rows, entries, strict=True):
                feature, surface = kind.split()
                contact = Contact(feature, k, surface, owner)
                text = f"{contact.corner} touches {contact.part}"
                pairs[contact] = ContactPair(contact.name, gap, slip, tuple(ranges), text)
    return Features(z, vertices, tuple(bodies), pairs)


def rotate_quarter(vector: Expression) -> Expression:
    """Turn a plane vector by +90 degrees."""
    return ca.vertcat(-vector[1], vector[0])
