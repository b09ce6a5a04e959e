"""Gaps, slip coordinates and ranges of all pairs of features of object, palm and links.

==============  ====================================================  ========================
name            touching                                              gap
==============  ====================================================  ========================
``v3-palm``     vertex 3 and the palm                                 height of the vertex
``v3-finger1``  vertex 3 and the touching side of link 1              n . (p - base) - radius
``v3-back1``    vertex 3 and the far side of link 1                   -n . (p - base) - radius
``v3-tip1``     vertex 3 and the arc of tip 1                         abs(p - tip) - radius
``v3-joint1``   vertex 3 and the circle about joint 1                 abs(p - base) - radius
``e2-tip1``     edge 2 and tip 1                                      m . (tip - p_2) - radius
``e2-joint1``   edge 2 and the circle about joint 1                   m . (base - p_2) - radius
``tip1-back2``  tip 1 and a side of link 2, or its tip or joint; the  likewise, with both radii
                same with other numbers
==============  ====================================================  ========================

The links slide on each other without friction, as no coefficient is given for them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, Store
from ..contacts.contact_limits import FINGERS_TOUCH, build_apart, build_finger_gap
from ..contacts.elemental import build_features, rotate_quarter
from ..scene.model import Scene
from .system import ContactPair, Structure, System


class _Link(NamedTuple):
    """A link as expressions; `normal` is that of its touching side."""

    base: Expression
    tip: Expression
    axis: Expression
    normal: Expression
    length: Expression
    radius: Expression
    theta: Expression


class _Bodies(NamedTuple):
    """The object and both links as expressions of z and of the numbers of a scene."""

    z: Expression
    geometry: Expression
    vertices: Expression  # vertices, along (2, n_v): along are directions of the edges
    along: Expression
    lengths: Expression
    links: tuple[_Link, _Link]


@lru_cache(maxsize=64)
def build_system(scene: Scene) -> System:
    """The hand and the object as a system with five coordinates."""
    rounded = tuple(finger.radius > 0 for finger in scene.fingers)
    structure = _build(scene.polygon.n_vertices, rounded, scene.fingers_collide)
    links = [[*np.asarray(f.base), f.length, f.radius] for f in scene.fingers]
    parts = {"m": scene.friction.palm, "1": scene.friction.finger1, "2": scene.friction.finger2}
    friction = [0.0 if name[0] in "tj" else parts[name[-1]] for name in structure.names]
    return System(
        structure,
        np.concatenate([scene.polygon.vertices.ravel(), *links]),
        scene.mass_diagonal,
        scene.applied_force,
        scene.viscous,
        scene.dry,
        np.array(friction),
        scene.scales,
    )


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


@lru_cache(maxsize=16)
def _build(count: int, rounded: tuple[bool, ...], collide: bool) -> Structure:
    """The structure of all scenes with as many vertices, and links with or without a radius."""
    bodies = _place(count, rounded)
    height, run = bodies.vertices[1, :], bodies.vertices[0, :]
    pairs = [
        ContactPair(f"v{i}-palm", height[i], run[i], text=f"v{i} touches the palm")
        for i in range(count)
    ]
    for finger in range(2):
        pairs += _list_sides(bodies, finger) + _list_ends(bodies, finger, rounded[finger])
    if collide:
        pairs += _list_link_pairs(bodies, any(rounded))
    turns = (False, False, True, True, True)
    return Structure(bodies.z, bodies.geometry, tuple(pairs), (3, 4), turns)


def _place(count: int, rounded: tuple[bool, ...]) -> _Bodies:
    z, geometry = ca.SX.sym("z", 5), ca.SX.sym("geometry", 2 * count + 8)
    corners = ca.reshape(geometry[: 2 * count], 2, count)
    run = ca.horzcat(corners[:, 1:], corners[:, :1]) - corners
    lengths = ca.sqrt(ca.sum1(run**2))
    c, s = ca.cos(z[2]), ca.sin(z[2])
    turn = ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))
    vertices = turn @ corners + ca.repmat(z[:2], 1, count)
    along = turn @ (run / ca.repmat(lengths, 2, 1))
    links = []
    for finger in range(2):
        x, y, length, radius = ca.vertsplit(geometry[2 * count + 4 * finger :][:4])
        base, theta = ca.vertcat(x, y), z[3 + finger]
        axis = ca.vertcat(ca.cos(theta), ca.sin(theta))
        normal = rotate_quarter(axis) if finger == 0 else -rotate_quarter(axis)
        thick = radius if rounded[finger] else ca.SX(0)
        links.append(_Link(base, base + length * axis, axis, normal, length, thick, theta))
    return _Bodies(z, geometry, vertices, along, lengths, (links[0], links[1]))


def _list_sides(bodies: _Bodies, finger: int) -> list[ContactPair]:
    """Vertices against both sides of a link."""
    link, k, side = bodies.links[finger], finger + 1, 1.0 if finger == 0 else -1.0
    # By convexity the whole object is on the side that it touches between its ends.
    middle = link.normal.T @ (bodies.z[:2] - link.base)
    pairs = []
    for i in range(bodies.vertices.shape[1]):
        away = bodies.vertices[:, i] - link.base
        run, level = link.axis.T @ away, link.normal.T @ away
        for name, way, text in (("finger", 1.0, ""), ("back", -1.0, "the far side of ")):
            ranges = (run, link.length - run, way * middle)
            text = f"v{i} touches {text}finger {k}"
            gap = way * level - link.radius
            pairs.append(ContactPair(f"v{i}-{name}{k}", gap, way * side * run, ranges, text))
    return pairs


def _list_ends(bodies: _Bodies, finger: int, rounded: bool) -> list[ContactPair]:
    """Vertices and edges against the tip of a link and the circle about its joint."""
    link, k, count = bodies.links[finger], finger + 1, bodies.vertices.shape[1]
    normals = ca.vertcat(-bodies.along[1, :], bodies.along[0, :])
    pairs = []
    for name, centre, out in (("tip", link.tip, link.axis), ("joint", link.base, -link.axis)):
        far = ca.repmat(centre, 1, count) - bodies.vertices
        runs, gaps = ca.sum1(bodies.along * far), -ca.sum1(normals * far) - link.radius
        for i in range(count):
            slip = -runs[i] - link.radius * (bodies.z[2] - link.theta)
            text = f"e{i} touches the {name} of finger {k}"
            edge: tuple[Expression, ...] = (runs[i], bodies.lengths[i] - runs[i])
            pairs.append(ContactPair(f"e{i}-{name}{k}", gaps[i], slip, edge, text))
            if not rounded:
                continue
            away, before = -far[:, i], (i - 1) % count
            ahead, across = out.T @ away, rotate_quarter(out).T @ away
            ranges = (ahead, runs[before] - bodies.lengths[before], -runs[i])
            slip = -link.radius * ca.atan2(across, ahead)
            gap = ca.sqrt(ca.sumsqr(away)) - link.radius
            text = f"v{i} touches the {name} of finger {k}"
            pairs.append(ContactPair(f"v{i}-{name}{k}", gap, slip, ranges, text))
    return pairs


def _list_link_pairs(bodies: _Bodies, rounded: bool) -> list[ContactPair]:
    """Tips and joints of either link against the other link."""
    links, pairs, none = bodies.links, list[ContactPair](), ca.SX(0)
    thick = links[0].radius + links[1].radius
    for own, other in ((0, 1), (1, 0)):
        mine, theirs = links[own], links[other]
        for name, point, rest in (("tip", mine.tip, mine.base), ("joint", mine.base, mine.tip)):
            behind = theirs.normal.T @ (rest - theirs.base)
            run = theirs.axis.T @ (point - theirs.base)
            level = theirs.normal.T @ (point - theirs.base)
            for side, way in (("finger", 1.0), ("back", -1.0)):
                title = f"{name}{own + 1}-{side}{other + 1}"
                ranges = (run, theirs.length - run, way * behind)
                pairs.append(ContactPair(title, way * level - thick, none, ranges, FINGERS_TOUCH))
    if not rounded:
        return pairs
    ends = [("tip", link.tip, link.axis) for link in links]
    joints = [("joint", link.base, -link.axis) for link in links]
    for first, second in ((ends[0], ends[1]), (ends[0], joints[1]), (joints[0], ends[1])):
        run = second[1] - first[1]
        gap = ca.sqrt(ca.sumsqr(run)) - thick
        beyond = (first[2].T @ run, -(second[2].T @ run))
        name = f"{first[0]}1-{second[0]}2"
        pairs.append(ContactPair(name, gap, none, beyond, FINGERS_TOUCH))
    return pairs
