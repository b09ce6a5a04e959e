"""Closing palm and fingers on the object at many poses (x, phi) at once.

With the object lowered until it touches the palm and each finger closed until it touches the
object, a configuration is a function of (x, phi) alone.

Contacts are counted as in `contact_table`: those with the palm, with finger 1 and with finger 2.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.errors import InputError
from ..scene.model import Finger, Scene
from .elemental import Contact, candidate_contacts
from .formation import Formation
from .links import FINGERS_TOUCH, evaluate_finger_gap

Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]

TOO_SHORT, JOINT_COVERED, FINGERS_CROSS = 1, 2, 3
"""Reasons why a finger cannot close: it reaches no part of the object; its joint is in the object
or right above it, so that the link overlaps the object before it closes; the other finger is closed
in its way."""


class Closed(NamedTuple):
    """Hand and object closed at n poses.

    Attributes
    ----------
    z : ndarray, shape (n, 5), [m, m, rad, rad, rad]
        Configurations; NaN joint angles where a finger cannot close.
    touched : ndarray of int, shape (n, 2)
        What each finger touches first, as an index into `contact_table`; -1 where it cannot close.
    obstacle : ndarray of int, shape (n, 2)
        0, or why a finger cannot close: `TOO_SHORT`, `JOINT_COVERED` or, for both fingers,
        `FINGERS_CROSS`.
    """

    z: Array
    touched: Numbers
    obstacle: Numbers


@lru_cache(maxsize=8)
def contact_table(scene: Scene) -> tuple[Contact, ...]:
    """Every contact of the scene: with the palm, then with finger 1, then with finger 2."""
    return tuple(c for finger in (None, 0, 1) for c in candidate_contacts(scene, finger))


@lru_cache(maxsize=8)
def full_formation(scene: Scene) -> Formation:
    """All contacts of `contact_table`, to evaluate the rows of many formations in one go."""
    return Formation(scene, contact_table(scene))


def first_contact(scene: Scene, finger: int) -> int:
    """Index into `contact_table` of a finger's first contact."""
    count = scene.polygon.n_vertices
    return count if finger == 0 else count + len(candidate_contacts(scene, 0))


def place_corners(scene: Scene, x: Array, y: Array, phi: Array) -> Array:
    """World positions of the vertices at n poses, shape (n, n_v, 2) [m]."""
    c, s = np.cos(phi)[:, None], np.sin(phi)[:, None]
    body = scene.polygon.vertices
    return np.stack(
        [
            x[:, None] + c * body[:, 0] - s * body[:, 1],
            y[:, None] + s * body[:, 0] + c * body[:, 1],
        ],
        axis=2,
    )


def lower(scene: Scene, phi: Array) -> tuple[Array, Numbers]:
    """Height [m] of the centroid at which the object touches the palm, and the vertex that does."""
    body = scene.polygon.vertices
    heights = np.sin(phi)[:, None] * body[:, 0] + np.cos(phi)[:, None] * body[:, 1]
    vertex = heights.argmin(axis=1)
    return -heights.min(axis=1), vertex


def close_fingers(scene: Scene, x: Array, phi: Array) -> Closed:
    """Lower the object and close both fingers at n poses, `x` [m] and `phi` [rad] of shape (n,)."""
    y, _ = lower(scene, phi)
    corners = place_corners(scene, x, y, phi)
    z = np.column_stack([x, y, phi, np.empty((len(x), 2))])
    touched = np.empty((len(x), 2), dtype=np.int64)
    obstacle = np.zeros((len(x), 2), dtype=np.int64)
    for finger, link in enumerate(scene.fingers):
        angle, feature, obstacle[:, finger] = _close_finger(link, finger, corners)
        closed = obstacle[:, finger] == 0
        z[:, 3 + finger] = np.where(closed, angle, np.nan)
        touched[:, finger] = np.where(closed, first_contact(scene, finger) + feature, -1)
    if scene.fingers_collide:
        obstacle[evaluate_finger_gap(scene, z) < 0] = FINGERS_CROSS
    return Closed(z, touched, obstacle)


def describe_obstacle(closed: Closed) -> str:
    """Why the first of some poses cannot be closed, in words; empty where it can."""
    text = ""
    for number, obstacle in enumerate(closed.obstacle[0].tolist(), start=1):
        if obstacle:
            text = {
                TOO_SHORT: f"finger {number} is too short",
                JOINT_COVERED: f"the joint of finger {number} is in the object or above it",
                FINGERS_CROSS: FINGERS_TOUCH,
            }[obstacle]
    return text


def place_flush(scene: Scene, edge: int, x: float) -> Array:
    """Pose q with `edge` on the palm and the centroid at `x`, shape (3,) [m, m, rad]."""
    phi = np.array([scene.polygon.flush_angle(edge)])
    return np.array([x, lower(scene, phi)[0][0], phi[0]])


def close_finger(scene: Scene, q: Array, finger: int) -> float:
    """Joint angle at which a finger, closing from outside, first touches the object at `q` [rad].

    Raises
    ------
    InputError
        If the finger reaches no part of the object, or its joint is in the object or too near.
    """
    link = scene.fingers[finger]
    corners = place_corners(scene, *np.asarray(q)[:3, None])
    angle, _, (obstacle,) = _close_finger(link, finger, corners)
    if obstacle == JOINT_COVERED:
        where = "is inside the object or nearer to it than the link's radius, or right above it"
        raise InputError(
            "", f"fingers.{finger + 1}.base", f"{np.asarray(link.base).tolist()} {where}"
        )
    if obstacle:
        raise InputError("", "start", f"finger {finger + 1} is too short to reach the object")
    return float(angle[0])


def _close_finger(link: Finger, finger: int, corners: Array) -> tuple[Array, Numbers, Numbers]:
    """Angle and first feature (side, edge, arc in the order of candidates) of a closing finger.

    And 0, or why it cannot close; `corners` as of `place_corners`.
    """
    corners = corners - np.asarray(link.base)
    sign = 1.0 if finger == 0 else -1.0
    outside = -np.pi / 2 if finger == 0 else np.pi + np.pi / 2
    length, radius = link.length, link.radius
    distance = np.hypot(corners[..., 0], corners[..., 1])
    bearing = np.arctan2(corners[..., 1], corners[..., 0])
    along = np.roll(corners, -1, axis=1) - corners
    size = np.hypot(along[..., 0], along[..., 1])
    along /= size[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    offset = (radius + (outward * corners).sum(axis=-1)) / length
    heading = np.arctan2(outward[..., 1], outward[..., 0])
    # At the very end of a pointed link rounding must not let the vertex slip between candidates.
    slack = 1e-11 * length if radius == 0 else 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        run = np.sqrt(distance**2 - radius**2)
        side = np.where(
            run <= length + slack, bearing - sign * np.arcsin(radius / distance), np.nan
        )
        reach = (distance**2 + length**2 - radius**2) / (2 * distance * length)
        beyond = (run > length) & (reach <= 1) & (radius > 0)
        arc = np.where(beyond, bearing - sign * np.arccos(reach), np.nan)
        both = heading[..., None] + np.arccos(offset)[..., None] * np.array([-1.0, 1.0])
    tip = length * np.stack([np.cos(both), np.sin(both)], axis=-1)
    place = ((tip - corners[:, :, None]) * along[:, :, None]).sum(axis=-1)
    both = np.where((place >= 0) & (place <= size[..., None]), both, np.nan)

    def sweep(angle: Array) -> Array:
        turns = sign * (angle - outside) / (2 * np.pi)
        return np.where(np.isnan(angle), np.inf, 2 * np.pi * (turns - np.floor(turns)))

    swept = np.hstack([sweep(side), sweep(both).min(axis=-1), sweep(arc)])
    feature = swept.argmin(axis=1)
    least = swept[np.arange(len(swept)), feature]
    reached = np.isfinite(least)
    angle = outside + sign * np.where(reached, least, 0.0)
    covered = (_distance(corners) <= link.radius) | _hangs_into(link, corners)
    obstacle = np.where(covered, JOINT_COVERED, np.where(reached, 0, TOO_SHORT))
    return angle, np.where(reached, feature, -1), obstacle


def _hangs_into(link: Finger, corners: Array) -> Flags:
    """Whether a link that points down, from where it closes, overlaps the object, shape (n,)."""
    x, y = corners[..., 0], corners[..., 1]
    after = np.roll(corners, -1, axis=1)
    beside = (np.abs(x) < link.radius) & (y < 0) & (y > -link.length)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = y - x * (after[..., 1] - y) / (after[..., 0] - x)
    crossed = (x * after[..., 0] < 0) & (height < 0) & (height > -link.length)
    tip = _distance(corners + np.array([0.0, link.length])) < link.radius
    return np.asarray(beside.any(axis=1) | crossed.any(axis=1) | tip)


def _distance(corners: Array) -> Array:
    """Distance of convex anticlockwise polygons from the origin, zero inside, shape (n,) [m]."""
    runs = np.roll(corners, -1, axis=1) - corners
    cross = corners[..., 0] * runs[..., 1] - corners[..., 1] * runs[..., 0]
    part = np.clip(-(corners * runs).sum(axis=-1) / (runs**2).sum(axis=-1), 0.0, 1.0)
    nearest = corners + part[..., None] * runs
    distance = np.hypot(nearest[..., 0], nearest[..., 1]).min(axis=1)
    return np.asarray(np.where((cross >= 0).all(axis=1), 0.0, distance))
