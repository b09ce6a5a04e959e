"""Elemental contacts: one C-function each, as CasADi expressions of z.

==============  ==============================  =======================================
name            touching                        C-function
==============  ==============================  =======================================
``v3-palm``     vertex 3 on the palm            height of the vertex
``v3-finger1``  vertex 3 on the side of link 1  n . (p - base) - radius
``e2-tip1``     fingertip 1 on edge 2           m . (tip - p_2) - radius
``v3-tip1``     vertex 3 on the arc of tip 1    abs(p - tip) - radius
==============  ==============================  =======================================

p is a vertex in the world, n the normal of the contact (into the object), m = -n the outward normal
of an edge; edge j runs from vertex j to vertex j + 1. Finger 1 touches with its left side, finger 2
with its right one. With the contact point p_c the rows of Eq. (4) are

    W_n^T = [n, (p_c - c) x n] = dC/dq,  J_n = n . d p_finger / d theta = -dC/dtheta,

and the same with t = (n_y, -n_x) for W_t and J_t.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.errors import InputError
from ..common.sharing import Store
from ..scene.model import Scene

_Z = ca.SX.sym("z", 5)  # of all scenes: limits that they share outlive the one that built them
_PATTERN = re.compile(r"(v|e)(0|[1-9][0-9]*)-(palm|finger([12])|tip([12]))")


@dataclass(frozen=True)
class Contact:
    """An elemental contact between a feature of the object and a part of the hand."""

    feature: str  # {"v", "e"}: a vertex or an edge of the object
    index: int  # which vertex or edge
    surface: str  # {"palm", "finger", "tip"}: the palm, the side of a link or the tip of a link
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
        return f"{'the tip of ' if self.surface == 'tip' else ''}finger {self.finger + 1}"

    def __str__(self) -> str:
        return self.name


class LinkFeatures(NamedTuple):
    """One link against the whole object, as expressions of z."""

    # base, tip, normal (2,): joint [m], centre of the tip [m], and the normal of the link's
    # touching side
    base: Expression
    tip: Expression
    normal: Expression
    # vertex_gap, vertex_run (1, n_v) [m]: C-function of each vertex with the side, and how far
    # along the link the vertex is
    vertex_gap: Expression
    vertex_run: Expression
    other_gap: list[Expression]  # [m]: the largest `edge_gap` of all other edges, for each edge
    # edge_gap, edge_run (1, n_v) [m]: C-function of the tip with each edge, and how far along the
    # edge the tip is
    edge_gap: Expression
    edge_run: Expression
    # arc_gap, arc_run (1, n_v) [m]: C-function of each vertex with the tip's arc, and how far
    # beyond the tip's centre it is
    arc_gap: Expression
    arc_run: Expression


class Features(NamedTuple):
    """A scene as expressions of its own symbol z: what every contact picks its rows from."""

    z: Expression  # (5,)
    vertices: Expression  # (2, n_v) [m]: world positions of the vertices
    edge_normals: Expression  # (2, n_v): normals of the edges into the object
    edge_lengths: Array  # (n_v,) [m]
    links: tuple[LinkFeatures, ...]  # finger 1, finger 2


class Geometry(NamedTuple):
    """A contact as expressions of z."""

    gap: Expression  # [m]: the C-function
    # point, normal (2,) [m], [-]: where the contact is, and its normal into the object
    point: Expression
    normal: Expression


class GapLimit(NamedTuple):
    """A quantity that is positive while a contact formation is valid."""

    value: Expression  # [m]
    text: str  # what has happened when it is zero
    gained: Contact | None = None  # the contact that is gained there, if any
    # others that may be gained there: a pointed tip at a vertex may go on along either edge, or
    # along the link
    also: tuple[Contact, ...] = ()

    def gains(self, contact: Contact | None) -> bool:
        """Whether a contact is gained there."""
        return contact is not None and (contact == self.gained or contact in self.also)


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
    feature, index, _, finger, tip = match.groups()
    contact = Contact(
        feature,
        int(index),
        "finger" if finger else "tip" if tip else "palm",
        int(finger or tip) - 1 if finger or tip else None,
    )
    if contact.index >= count or (feature == "e" and not tip):
        raise InputError("", "", f"{name!r} does not exist; {allowed}")
    if feature == "v" and tip and scene.fingers[int(tip) - 1].radius == 0:
        raise InputError(
            "", "", f"{name!r} needs a rounded tip, but fingers.{tip}.radius is 0; give it a radius"
        )
    return contact


def candidate_contacts(scene: Scene, finger: int | None) -> list[Contact]:
    """Every contact that the object can have with the palm (None) or with one finger."""
    features = range(scene.polygon.n_vertices)
    if finger is None:
        return [Contact("v", i, "palm") for i in features]
    contacts = [Contact("v", i, "finger", finger) for i in features]
    contacts += [Contact("e", i, "tip", finger) for i in features]
    if scene.fingers[finger].radius > 0:
        contacts += [Contact("v", i, "tip", finger) for i in features]
    return contacts


def build_features(scene: Scene) -> Features:
    """Return the scene's features as expressions of z, the same for scenes of one shape."""
    return _FEATURES(scene)


def _build_features(scene: Scene) -> Features:
    z = _Z
    body = scene.polygon.vertices
    run = np.roll(body, -1, axis=0) - body
    lengths = np.hypot(run[:, 0], run[:, 1])
    c, s = ca.cos(z[2]), ca.sin(z[2])
    rotation = ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))
    vertices = rotation @ ca.DM(body.T) + ca.repmat(z[:2], 1, len(body))
    along = rotation @ ca.DM((run / lengths[:, None]).T)
    normals = ca.vertcat(-along[1, :], along[0, :])
    links = (_build_link(scene, finger, z, vertices, along, normals) for finger in range(2))
    return Features(z, vertices, normals, lengths, tuple(links))


_FEATURES = Store(_build_features, lambda scene: scene.shape)


def _build_link(
    scene: Scene,
    finger: int,
    z: Expression,
    vertices: Expression,
    along: Expression,
    edge_normals: Expression,
) -> LinkFeatures:
    link = scene.fingers[finger]
    axis = ca.vertcat(ca.cos(z[3 + finger]), ca.sin(z[3 + finger]))
    normal = rotate_quarter(axis) if finger == 0 else -rotate_quarter(axis)
    base = ca.DM(link.base)
    tip = base + link.length * axis
    count = vertices.shape[1]
    from_base = vertices - ca.repmat(base, 1, count)
    to_tip = ca.repmat(tip, 1, count) - vertices
    edge_gap = -ca.sum1(edge_normals * to_tip) - link.radius
    return LinkFeatures(
        base=base,
        tip=tip,
        normal=normal,
        vertex_gap=normal.T @ from_base - link.radius,
        vertex_run=axis.T @ from_base,
        other_gap=_find_largest_others(ca.horzsplit(edge_gap)),
        edge_gap=edge_gap,
        edge_run=ca.sum1(along * to_tip),
        arc_gap=ca.sqrt(ca.sum1(to_tip**2)) - link.radius,
        arc_run=-axis.T @ to_tip,
    )


def _find_largest_others(values: list[Expression]) -> list[Expression]:
    """The largest of all other values, for each one, from running maxima of both sides."""
    before = list(accumulate(values[:-1], ca.fmax))
    after = list(accumulate(values[:0:-1], ca.fmax))[::-1]
    inner = [ca.fmax(*pair) for pair in zip(before[:-1], after[1:], strict=True)]
    return [after[0], *inner, before[-1]]


_BUILT: Store[dict[Any, Any]] = Store(lambda scene: {}, lambda scene: scene.shape)


def build_once(build: Callable[..., Any], contact: Contact, scene: Scene, *options: bool) -> Any:
    """What `build` makes of a contact: formations of scenes of one shape have it in common."""
    key, built = (build, contact, *options), _BUILT(scene)
    if key not in built:
        built[key] = build(contact, scene, *options)
    return built[key]


def build_gap(contact: Contact, scene: Scene) -> Expression:
    """Return the C-function of `contact` [m], an expression of the features' symbol z."""
    features = build_features(scene)
    if contact.finger is None:
        return features.vertices[1, contact.index]
    link = features.links[contact.finger]
    if contact.surface == "finger":
        return link.vertex_gap[contact.index]
    return (link.edge_gap if contact.feature == "e" else link.arc_gap)[contact.index]


def build_geometry(contact: Contact, scene: Scene) -> Geometry:
    """Return `contact` as expressions of the features' symbol z."""
    features = build_features(scene)
    gap = build_gap(contact, scene)
    point = features.vertices[:, contact.index]
    if contact.finger is None:
        normal = ca.DM([0.0, 1.0])
    else:
        link = features.links[contact.finger]
        radius = scene.fingers[contact.finger].radius
        if contact.surface == "finger":
            normal = link.normal
        elif contact.feature == "e":
            normal = features.edge_normals[:, contact.index]
            point = link.tip + radius * normal
        else:
            normal = (point - link.tip) / (gap + radius)
    return Geometry(gap, point, normal)


def build_rows(contacts: Sequence[Contact], scene: Scene) -> tuple[Expression, ...]:
    """Return gaps, shape (n_c,) [m], and the rows A and A_t of contacts, shape (n_c, 5).

    A = [W_n^T, -J_n] and A_t = [W_t^T, -J_t], all contacts at once.
    """
    parts = [build_geometry(contact, scene) for contact in contacts]
    gaps = ca.vertcat(ca.SX(0, 1), *(part.gap for part in parts))
    points = ca.horzcat(ca.SX(2, 0), *(part.point for part in parts)).T
    normals = ca.horzcat(ca.SX(2, 0), *(part.normal for part in parts)).T
    arms = points - ca.repmat(build_features(scene).z[:2].T, len(parts), 1)
    rows = []
    for along in (normals, ca.horzcat(normals[:, 1], -normals[:, 0])):
        turns = [arms[:, 0] * along[:, 1] - arms[:, 1] * along[:, 0]]
        for finger, link in enumerate(scene.fingers):
            on_finger = ca.sparsify(ca.DM([float(c.finger == finger) for c in contacts]))
            levers = points - ca.repmat(ca.DM(link.base).T, len(parts), 1)
            turns.append((levers[:, 1] * along[:, 0] - levers[:, 0] * along[:, 1]) * on_finger)
        rows.append(ca.horzcat(along, *turns))
    return gaps, *rows


def rotate_quarter(vector: Expression) -> Expression:
    """Turn a plane vector by +90 degrees."""
    return ca.vertcat(-vector[1], vector[0])
