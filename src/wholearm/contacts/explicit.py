"""Closed-form configurations with one contact each of palm and fingers, as functions of (x, phi).

The height follows from the vertex on the palm, each joint angle from what the finger touches; so do
their rates along a straight path (x', phi') with parameter u and x'' = phi'' = 0. Poses with
different contacts are evaluated together.

A label is three indices into `closing.contact_table`: with the palm, with finger 1 and finger 2.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..scene.model import Scene
from .closing import Numbers, first_contact
from .formation import Kinematics

SIDE, EDGE, ARC = 0, 1, 2
"""What of a link and an object touch: its side a vertex, its tip an edge, its tip a vertex."""


class ExplicitMotion(NamedTuple):
    """Straight paths at n places."""

    # z, z_u, z_uu (n, 5): configurations, and their first and second derivatives along the paths
    z: Array
    z_u: Array
    z_uu: Array
    kinematics: Kinematics  # rows of the three contacts, with A' z_u


class _Touch(NamedTuple):
    """Poses at which a finger touches in one manner; vectors are in the world, from its joint."""

    rows: Numbers  # which of the poses
    kind: int
    # arm, corner, outward (n, 2): the vertex from the centroid and from the joint; for an edge, the
    # one where it begins, and its outward normal
    arm: Array
    corner: Array
    outward: Array


def place(scene: Scene, labels: Numbers, poses: Array) -> Array:
    """Configurations (n, 5) at poses (x, phi), labels (n, 3); NaN where a tip cannot reach."""
    z = np.full((len(poses), 5), np.nan)
    z[:, [0, 2]] = poses
    z[:, 1] = -_turn(scene.polygon.vertices[labels[:, 0]], poses[:, 1])[:, 1]
    for finger, link in enumerate(scene.fingers):
        sign = 1.0 if finger == 0 else -1.0
        for own in _list_touches(scene, finger, labels[:, 1 + finger], z):
            with np.errstate(invalid="ignore", divide="ignore"):
                if own.kind == EDGE:
                    offset = link.radius + (own.outward * own.corner).sum(axis=1)
                    angle = _heading(own.outward) + sign * np.arccos(offset / link.length)
                else:
                    away = np.hypot(*own.corner.T)
                    reach = (away**2 + link.length**2 - link.radius**2) / (2 * away * link.length)
                    inner = np.arcsin(link.radius / away) if own.kind == SIDE else np.arccos(reach)
                    angle = _heading(own.corner) - sign * inner
            # Counted from where the finger hangs outside, from which it closes.
            outside = -np.pi / 2 if finger == 0 else 3 * np.pi / 2
            swept = np.mod(sign * (angle - outside), 2 * np.pi)
            z[own.rows, 3 + finger] = outside + sign * swept
    return z


def move(scene: Scene, labels: Numbers, poses: Array, rates: Array) -> ExplicitMotion:
    """Rates along straight paths at poses (x, phi), rates (x', phi'), (n, 2), and labels (n, 3)."""
    z = place(scene, labels, poses)
    z_u, z_uu = np.zeros_like(z), np.zeros_like(z)
    A, A_t, bend = np.zeros((len(z), 3, 5)), np.zeros((len(z), 3, 5)), np.zeros((len(z), 3))
    arm, turn = _turn(scene.polygon.vertices[labels[:, 0]], z[:, 2]), rates[:, 1]
    A[:, 0, 1], A[:, 0, 2] = 1.0, arm[:, 0]
    A_t[:, 0, 0], A_t[:, 0, 2] = 1.0, -arm[:, 1]
    bend[:, 0] = -(turn**2) * arm[:, 1]
    z_u[:, [0, 2]] = rates
    z_u[:, 1], z_uu[:, 1] = -arm[:, 0] * turn, -bend[:, 0]
    for finger, link in enumerate(scene.fingers):
        sign, joint = (1.0 if finger == 0 else -1.0), 3 + finger
        for own in _list_touches(scene, finger, labels[:, 1 + finger], z):
            at, angle = own.rows, z[own.rows, joint]
            axis = np.column_stack([np.cos(angle), np.sin(angle)])
            tip, point = link.length * axis, own.corner
            if own.kind == SIDE:
                normal = sign * _quarter(axis)
            elif own.kind == EDGE:
                normal = -own.outward
                point = tip + link.radius * normal
            else:
                normal = (point - tip) / link.radius
            lever = own.arm + point - own.corner
            for rows, along in ((A, normal), (A_t, -_quarter(normal))):
                rows[at, 1 + finger, :2] = along
                rows[at, 1 + finger, 2] = _cross(lever, along)
                rows[at, 1 + finger, joint] = -_cross(point, along)
            held = A[at, 1 + finger]
            with np.errstate(invalid="ignore", divide="ignore"):
                rate = -(held[:, :3] * z_u[at, :3]).sum(axis=1) / held[:, joint]
                z_u[at, joint] = rate
                bent = _bend(own, link.radius, tip, normal, z_u[at], rate)
                z_uu[at, joint] = -(bent + held[:, 1] * z_uu[at, 1]) / held[:, joint]
            bend[at, 1 + finger] = bent
    return ExplicitMotion(z, z_u, z_uu, Kinematics(0 * bend, A, A_t, bend, A, bend))


def measure_gap(scene: Scene, contacts: Numbers, z: Array) -> Array:
    """C-functions [m] of a contact of `closing.contact_table` each, at n configurations."""
    gaps = np.empty(len(z))
    on_palm = contacts < first_contact(scene, 0)
    vertices = scene.polygon.vertices[contacts[on_palm]]
    gaps[on_palm] = z[on_palm, 1] + _turn(vertices, z[on_palm, 2])[:, 1]
    for finger, link in enumerate(scene.fingers):
        sign, last = (1.0, first_contact(scene, 1)) if finger == 0 else (-1.0, np.inf)
        mine = np.flatnonzero((contacts >= first_contact(scene, finger)) & (contacts < last))
        for own in _list_touches(scene, finger, contacts[mine], z[mine]):
            at = mine[own.rows]
            angle = z[at, 3 + finger]
            axis = np.column_stack([np.cos(angle), np.sin(angle)])
            apart = own.corner - link.length * axis
            if own.kind == SIDE:
                gap = sign * _cross(axis, own.corner)
            elif own.kind == EDGE:
                gap = -(own.outward * apart).sum(axis=1)
            else:
                gap = np.hypot(*apart.T)
            gaps[at] = gap - link.radius
    return gaps


def _bend(
    own: _Touch, radius: float, tip: Array, normal: Array, rates: Array, rate: Array
) -> Array:
    """The gap's second derivative at constant rates of object, (n, 5), and joint, shape (n,)."""
    turn = rates[:, 2:3]
    rate = rate[:, None]
    moved, fallen = rates[:, :2] + turn * _quarter(own.arm), -(turn**2) * own.arm
    if own.kind == SIDE:
        parts = -(rate**2) * normal * own.corner + normal * fallen
        parts = parts + 2 * rate * _quarter(normal) * moved
        return np.asarray(parts.sum(axis=1))
    # The tip's centre as seen from the vertex.
    apart, closing = tip - own.corner, rate * _quarter(tip) - moved
    bent = -(rate**2) * tip - fallen
    if own.kind == EDGE:
        out = own.outward
        parts = -(turn**2) * out * apart + 2 * turn * _quarter(out) * closing + out * bent
        return np.asarray(parts.sum(axis=1))
    inwards, bends = (normal * closing).sum(axis=1), (normal * bent).sum(axis=1)
    return np.asarray(((closing**2).sum(axis=1) - inwards**2) / radius - bends)


def _list_touches(scene: Scene, finger: int, contacts: Numbers, z: Array) -> Iterator[_Touch]:
    kinds, indices = np.divmod(contacts - first_contact(scene, finger), scene.polygon.n_vertices)
    body, base = scene.polygon.vertices, np.asarray(scene.fingers[finger].base)
    for kind in (SIDE, EDGE, ARC):
        rows = np.flatnonzero(kinds == kind)
        if len(rows):
            index, at = indices[rows], z[rows]
            arm = _turn(body[index], at[:, 2])
            outward = _turn(_list_normals(scene)[index], at[:, 2]) if kind == EDGE else arm
            yield _Touch(rows, kind, arm, arm + at[:, :2] - base, outward)


@lru_cache(maxsize=8)
def _list_normals(scene: Scene) -> Array:
    """Outward normals of the edges of the object, in its own frame, shape (n_v, 2)."""
    run = np.roll(scene.polygon.vertices, -1, axis=0) - scene.polygon.vertices
    return -_quarter(run / np.hypot(*run.T)[:, None])


def _turn(vectors: Array, phi: Array) -> Array:
    c, s = np.cos(phi), np.sin(phi)
    turned = np.empty_like(vectors)
    turned[:, 0] = c * vectors[:, 0] - s * vectors[:, 1]
    turned[:, 1] = s * vectors[:, 0] + c * vectors[:, 1]
    return turned


def _heading(vectors: Array) -> Array:
    return np.asarray(np.arctan2(vectors[:, 1], vectors[:, 0]))


def _quarter(vectors: Array) -> Array:
    """Vectors turned by +90 degrees."""
    turned = np.empty_like(vectors)
    turned[:, 0], turned[:, 1] = -vectors[:, 1], vectors[:, 0]
    return turned


def _cross(one: Array, two: Array) -> Array:
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
