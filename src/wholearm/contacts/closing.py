"""Closed configurations at many poses (x, phi) at once: object on the palm, fingers on the object.

Contacts are indices into `contact_table`. A label is three of them: with the palm, with finger 1
and with finger 2. For fixed labels the configuration is a function of (x, phi) in closed form: the
height follows from the vertex on the palm, each joint angle from the contact of the finger. Rates
along a straight path (x', phi') with x'' = phi'' = 0 follow from A z' = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, Flags, Numbers, find_runs
from ..common.errors import InputError
from ..scene.model import Finger, Scene
from .contact_limits import FINGERS_TOUCH, evaluate_finger_gap, measure_gaps
from .elemental import Contact, candidate_contacts
from .formation import CurvePoint, Formation, Kinematics

TOO_SHORT, JOINT_COVERED, FINGERS_CROSS = 1, 2, 3
"""Obstacles to closing a finger: it does not reach the object; its joint is in the object or right
above it, so that the link overlaps the object before it closes; the closed fingers overlap each
other."""
SIDE, EDGE, ARC = 0, 1, 2
"""Kinds of contacts of a link: its side and a vertex, its tip and an edge, its tip and a vertex."""
CHUNK = 4096  # poses that are closed at a time, so that arrays stay in the processor's cache


class ClosedFinger(NamedTuple):
    """Closed configurations at n poses."""

    # (n, 5) [m, m, rad, rad, rad]: configurations; NaN joint angles if a finger cannot close
    z: Array
    # (n, 2): first contact of each closing finger, an index into `contact_table`; -1 if it cannot
    # close
    contacts: Numbers
    # (n, 2): 0, or the obstacle: `TOO_SHORT`, `JOINT_COVERED` or, for both fingers,
    # `FINGERS_CROSS`
    obstacle: Numbers


@lru_cache(maxsize=8)
def contact_table(scene: Scene) -> tuple[Contact, ...]:
    """Every contact of the scene: with the palm, then with finger 1, then with finger 2."""
    return tuple(c for finger in (None, 0, 1) for c in candidate_contacts(scene, finger))


def first_contact(scene: Scene, finger: int) -> int:
    """Index into `contact_table` of a finger's first contact."""
    # Sides and edges of finger 1, and the arc of its tip if that is rounded.
    kinds = 0 if finger == 0 else 3 if scene.fingers[0].radius > 0 else 2
    return (1 + kinds) * scene.polygon.n_vertices


def place_corners(
    scene: Scene, x: Array, y: Array, phi: Array, vertices: Numbers
) -> tuple[Array, Array]:
    """World x and y, (m, n) [m], of some vertices, shape (m, 1) or (m, n), at n poses."""
    c, s = np.cos(phi), np.sin(phi)
    local_x, local_y = scene.polygon.vertices[vertices].transpose(2, 0, 1)
    return x + c * local_x - s * local_y, y + s * local_x + c * local_y


def lower(scene: Scene, phi: Array) -> tuple[Array, Numbers]:
    """Height [m] of the centroid at which the object touches the palm, and the touching vertex."""
    body = scene.polygon.vertices
    # The last bit of a matrix product would depend on the number of poses.
    heights = np.sin(phi)[:, None] * body[:, 0] + np.cos(phi)[:, None] * body[:, 1]
    return -heights.min(axis=1), heights.argmin(axis=1)


def close_fingers(scene: Scene, x: Array, phi: Array) -> ClosedFinger:
    """Lower the object and close both fingers at n poses, `x` [m] and `phi` [rad] of shape (n,)."""
    if len(x) > CHUNK:
        cuts = (slice(k, k + CHUNK) for k in range(0, len(x), CHUNK))
        parts = [close_fingers(scene, x[cut], phi[cut]) for cut in cuts]
        return ClosedFinger(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    y, _ = lower(scene, phi)
    z = np.column_stack([x, y, phi, np.empty((len(x), 2))])
    contacts = np.empty((len(x), 2), dtype=np.int64)
    obstacle = np.zeros((len(x), 2), dtype=np.int64)
    for finger in range(2):
        angle, feature, obstacle[:, finger] = _close_finger(scene, finger, x, y, phi)
        reached = obstacle[:, finger] == 0
        z[:, 3 + finger] = np.where(reached, angle, np.nan)
        contacts[:, finger] = np.where(reached, first_contact(scene, finger) + feature, -1)
    if scene.fingers_collide:
        obstacle[evaluate_finger_gap(scene, z) < 0] = FINGERS_CROSS
    return ClosedFinger(z, contacts, obstacle)


def describe_obstacle(closed: ClosedFinger) -> str:
    """Obstacle at the first of some poses, in words; empty if the hand can be closed."""
    texts = {
        TOO_SHORT: "finger {} is too short",
        JOINT_COVERED: "the joint of finger {} is in the object or above it",
        FINGERS_CROSS: FINGERS_TOUCH,
    }
    pairs = enumerate(closed.obstacle[0].tolist(), start=1)
    return ([texts[obstacle].format(number) for number, obstacle in pairs if obstacle] or [""])[-1]


def place_flush(scene: Scene, edge: int, x: float) -> Array:
    """Pose q with `edge` on the palm and the centroid at `x`, shape (3,) [m, m, rad]."""
    phi = np.array([scene.polygon.flush_angle(edge)])
    return np.array([x, lower(scene, phi)[0][0], phi[0]])


def close_finger(scene: Scene, q: Array, finger: int) -> float:
    """Joint angle of the first contact of a closing finger with the object at `q` [rad].

    InputError if the finger does not reach the object, or its joint is in the object or near it.
    """
    link = scene.fingers[finger]
    angle, _, (obstacle,) = _close_finger(scene, finger, *np.asarray(q)[:3, None])
    if obstacle == JOINT_COVERED:
        fault = "is inside the object or nearer to it than the link's radius, or right above it"
        raise InputError(
            "", f"fingers.{finger + 1}.base", f"{np.asarray(link.base).tolist()} {fault}"
        )
    if obstacle:
        raise InputError("", "start", f"finger {finger + 1} is too short to reach the object")
    return float(angle[0])


def _close_finger(
    scene: Scene, finger: int, x: Array, y: Array, phi: Array
) -> tuple[Array, Numbers, Numbers]:
    """Angle, first feature (sides, edges, arcs as in the candidates) and obstacle, at n poses."""
    link = scene.fingers[finger]
    corners = place_corners(scene, x, y, phi, np.arange(scene.polygon.n_vertices)[:, None])
    dx, dy = (part - base for part, base in zip(corners, np.asarray(link.base), strict=True))
    angle, feature = _touch(link, finger, dx, dy)
    obstacle = np.where(feature < 0, TOO_SHORT, 0)
    # Unless the object is above the joint, it may overlap the link where that hangs down.
    rows = np.flatnonzero(dy.min(axis=0) <= link.radius)
    if len(rows):
        z_down = np.full((len(rows), 5), -np.pi / 2)
        z_down[:, :3] = np.column_stack([x, y, phi])[rows]
        covered = measure_gaps(scene, z_down)[:, 1 + finger] < 1e-12 * link.length
        obstacle[rows[covered]] = JOINT_COVERED
    return angle, feature, obstacle


def _touch(link: Finger, finger: int, x: Array, y: Array) -> tuple[Array, Numbers]:
    """Angle of first contact of a closing finger, (n,), and feature of m sides, edges, arcs, or -1.

    Vertices `x`, `y`, (m, n), are relative to the joint.
    """
    length, radius, (sign, start_angle) = link.length, link.radius, _find_start_angle(finger)
    t_x, t_y = (np.roll(part, -1, axis=0) - part for part in (x, y))
    lengths = np.hypot(t_x, t_y)
    t_x, t_y = t_x / lengths, t_y / lengths

    def sweep(angle: Array) -> Array:
        fractions = sign * (angle - start_angle) / (2 * np.pi)
        return np.where(np.isnan(angle), np.inf, 2 * np.pi * (fractions - np.floor(fractions)))

    def sweep_edge(branch: float) -> Array:
        """Closing angles of the tip onto edges, for one of the two branches."""
        angle = _find_angle(link, branch, EDGE, x, y, np.array([t_y, -t_x]))
        position = branch * offset - (x * t_x + y * t_y)
        return np.where((position >= 0) & (position <= lengths), sweep(angle), np.inf)

    # A vertex at the end of a pointed link must not be missed by rounding.
    slack = 1e-11 * length if radius == 0 else 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        tangents = np.sqrt(np.hypot(x, y) ** 2 - radius**2)
        side = sweep(_find_angle(link, sign, SIDE, x, y))
        # Offset of the tip's center along the line, from the foot of the joint.
        offset = np.sqrt(length**2 - (radius + (x * t_y - y * t_x)) ** 2)
        edge = np.minimum(sweep_edge(-1.0), sweep_edge(1.0))
        sweeps = [np.where(tangents <= length + slack, side, np.inf), edge]
        if radius > 0:
            arc = sweep(_find_angle(link, sign, ARC, x, y))
            sweeps.append(np.where(tangents > length, arc, np.inf))
    angles = np.array(sweeps)
    smallest = angles.min(axis=(0, 1))
    touching, finite = angles == smallest, np.isfinite(smallest)
    # Of the two vertices of a flush edge, the one where the edge begins.
    touching &= ~np.roll(touching, 1, axis=1)
    feature = np.concatenate(touching).argmax(axis=0)
    angle = start_angle + sign * np.where(finite, smallest, 0.0)
    return angle, np.where(finite, feature, -1)


def _find_start_angle(finger: int) -> tuple[float, float]:
    """Direction of closing (1: anticlockwise), and the joint angle at which it starts [rad]."""
    return 1.0 - 2 * finger, (2 * finger - 0.5) * np.pi


def _find_angle(
    link: Finger, sign: float, kind: int, x: Array, y: Array, outward: Array | None = None
) -> Array:
    """Joint angles at which a link touches vertices or, with its tip, edges [rad], or NaN.

    The link turns anticlockwise (`sign` 1) or clockwise (-1). Vertices `x`, `y` are relative to the
    joint; those of edges are their first ones, with `outward` normals.
    """
    if kind == EDGE and outward is not None:
        offset = link.radius + (outward[0] * x + outward[1] * y)
        heading = np.arctan2(outward[1], outward[0])
        return np.asarray(heading + sign * np.arccos(offset / link.length))
    r = np.hypot(x, y)
    if kind == SIDE:
        half_angle = np.arcsin(link.radius / r)
    else:
        half_angle = np.arccos((r**2 + link.length**2 - link.radius**2) / (2 * r * link.length))
    return np.asarray(np.arctan2(y, x) - sign * half_angle)


def evaluate_each(scene: Scene, labels: Numbers, z: Array, v: Array | None = None) -> Kinematics:
    """Kinematics of n formations of sliding contacts, each at one configuration.

    `labels` (n, n_c) are indices into `contact_table`; z, v (n, 5); v is `z` by default.
    """
    v, table = z if v is None else v, contact_table(scene)
    C, P_dot_v = np.empty((2, *labels.shape))
    A, A_t = np.empty((2, *labels.shape, 5))
    for index in np.unique(labels).tolist():
        rows, columns = np.nonzero(labels == index)
        contact = Formation(scene, (table[index],)).evaluate(z[rows], v[rows])
        C[rows, columns], P_dot_v[rows, columns] = contact.C[:, 0], contact.P_dot_v[:, 0]
        A[rows, columns], A_t[rows, columns] = contact.A[:, 0], contact.A_t[:, 0]
    return Kinematics(C, A, A_t, A, P_dot_v)


def group_labels(scene: Scene, labels: Numbers) -> Iterator[tuple[Formation, Flags]]:
    """Groups of formations with the same friction at each contact: one formation and the rows."""
    table = contact_table(scene)
    fingers = np.array([-1 if c.finger is None else c.finger for c in table])[labels]
    for kind in np.unique(fingers, axis=0):
        rows = (fingers == kind).all(axis=1)
        yield Formation(scene, tuple(table[k] for k in labels[int(rows.argmax())].tolist())), rows


def find_reach(scene: Scene) -> tuple[float, float]:
    """Bounds of x [m] within which both fingers may reach the object."""
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    reach = np.array([size + finger.length + finger.radius for finger in scene.fingers])
    bases = np.array([np.asarray(finger.base)[0] for finger in scene.fingers])
    return float((bases - reach).max()), float((bases + reach).min())


def describe_reach(scene: Scene, phi: float) -> str:
    """Text with the ranges of x [m] in which both fingers close without overlap."""
    low, high = find_reach(scene)
    x = np.linspace(low, max(low, high), 1000)
    feasible = (close_fingers(scene, x, np.full(len(x), phi)).obstacle == 0).all(axis=1)
    spans = []
    for interval in find_runs(feasible, min_length=2):
        first, last = float(x[interval.start]), float(x[interval.stop - 1])
        # Rounded inwards to few digits.
        digits = 2 - math.floor(math.log10(last - first))
        step = 10.0**-digits
        first, last = math.ceil(first / step) * step, math.floor(last / step) * step
        spans.append(f"from {round(first, digits):g} to {round(last, digits):g}")
    if not spans:
        return "at that angle the hand closes at no x"
    return f"at that angle the hand closes for x {' and '.join(spans)}"


def place_at(scene: Scene, labels: Numbers, poses: Array) -> Array:
    """Configurations (n, 5) at poses (x, phi) with labels (n, 3); NaN if a tip cannot reach."""
    z = np.full((len(poses), 5), np.nan)
    z[:, [0, 2]], z[:, 1], count = poses, 0.0, scene.polygon.n_vertices
    z[:, 1] = -place_corners(scene, z[:, 0], z[:, 1], z[:, 2], labels[None, :, 0])[1][0]
    for finger, link in enumerate(scene.fingers):
        sign, start = _find_start_angle(finger)
        kinds, indices = np.divmod(labels[:, 1 + finger] - first_contact(scene, finger), count)
        for kind in np.unique(kinds).tolist():
            rows = np.flatnonzero(kinds == kind)
            ends = np.stack([indices[rows], indices[rows] + 1]) % count
            x, y = place_corners(scene, z[rows, 0], z[rows, 1], z[rows, 2], ends)
            outward = np.stack([y[1] - y[0], x[0] - x[1]]) / np.hypot(x[1] - x[0], y[1] - y[0])
            base = np.asarray(link.base)
            with np.errstate(invalid="ignore", divide="ignore"):
                angle = _find_angle(link, sign, kind, x[0] - base[0], y[0] - base[1], outward)
            # In the turn that begins at the angle from which the finger closes.
            z[rows, 3 + finger] = start + sign * np.mod(sign * (angle - start), 2 * np.pi)
    return z


def evaluate_path(scene: Scene, labels: Numbers, poses: Array, rates: Array) -> CurvePoint:
    """Straight paths at poses (x, phi) with rates (x', phi'), (n, 2), and labels (n, 3)."""
    z = place_at(scene, labels, poses)
    A = evaluate_each(scene, labels, z).A
    z_u, z_uu, levers = np.zeros_like(z), np.zeros_like(z), A[:, [1, 2], [3, 4]]
    z_u[:, [0, 2]], z_u[:, 1] = rates, -A[:, 0, 2] * rates[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        z_u[:, 3:] = -np.einsum("nij,nj->ni", A[:, 1:, :3], z_u[:, :3]) / levers
        kinematics = evaluate_each(scene, labels, z, z_u)
        z_uu[:, 1] = -kinematics.P_dot_v[:, 0]
        z_uu[:, 3:] = -(kinematics.P_dot_v[:, 1:] + A[:, 1:, 1] * z_uu[:, 1:2]) / levers
    return CurvePoint(z, z_u, z_uu, kinematics)
