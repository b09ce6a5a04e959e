"""Borders near a leg of a route: which one the leg follows, and which one it misses by little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Closed, Numbers, lower
from ..scene.model import Scene
from .borders import Piece, Track, Window, flush_track, label_closed
from .borders import palm_track as track_palm
from .pieces import cut

NEAR = (0.015, float(np.radians(0.5)))
"""Distances within which poses are on a border or crossing: x in radii of gyration, phi in rad."""
MISSED = 4.0
"""Distance from a border, over `NEAR`, within which a leg beside it is said to be a near miss."""
PLACES = 401
"""Places along a leg at which contacts are looked up."""


@dataclass(frozen=True, eq=False)
class Leg:
    """A curve in the (x, phi) plane from `start` to `stop`, two of its parameters.

    `near` is `NEAR` as a difference of the parameter.
    """

    track: Track
    start: float
    stop: float
    near: float

    def at(self, place: float) -> Array:
        """The pose (x, phi) at a parameter, shape (2,) [m, rad]."""
        return np.array(self.track.pose(np.array([place]))).ravel()


class Miss(NamedTuple):
    """A border that a straight leg passes closely beside.

    `off` is the larger distance of its ends from the border, over `NEAR`.
    """

    track: Track
    off: float
    text: str


def tolerance(scene: Scene) -> Array:
    """`NEAR` in the scene's units, shape (2,) [m, rad]."""
    return np.array([NEAR[0] * scene.scales.length, NEAR[1]])


def choose_leg(scene: Scene, start: Array, stop: Array) -> Leg:
    """The border that both ends are near, or a straight line."""
    near = tolerance(scene)
    if (np.abs(stop - start)[0] > near[0]) and not _wide(scene, start, stop):
        for track, off in _list_palm(scene, start, stop):
            if off < 1:
                return Leg(track, float(start[0]), float(stop[0]), near[0])
    found = []
    for track, reach in _list_fingers(scene, start, stop):
        (a, off_a), (b, off_b) = (_locate(track, pose, near) for pose in (start, stop))
        if max(off_a, off_b) < 1 and abs(a - b) > near[1]:
            ends = np.clip([min(a, b) - near[1], max(a, b) + near[1]], *reach)
            own = replace(track, places=np.linspace(ends[0], ends[1], PLACES))
            if _covers(cut(scene, [own]), a, b, near[1]):
                found.append((max(off_a, off_b), own, a, b))
    if found:
        _, track, a, b = min(found, key=lambda entry: entry[0])
        return Leg(track, a, b, near[1])

    def pose(s: Array) -> tuple[Array, Array]:
        points = start + s[:, None] * (stop - start)
        return points[:, 0], points[:, 1]

    def label(_: Array, phi: Array, closed: Closed) -> Numbers:
        return label_closed(closed, lower(scene, phi)[1])

    share = float(1 / (np.abs(stop - start) / near).max())
    places = np.linspace(-share, 1.0 + share, PLACES)
    track = Track(pose, label, places, np.inf)
    return Leg(track, 0.0, 1.0, share)


def _wide(scene: Scene, start: Array, stop: Array) -> bool:
    return bool(abs(stop[1] - start[1]) > 2 * tolerance(scene)[1])


def _list_palm(scene: Scene, start: Array, stop: Array) -> Iterator[tuple[Track, float]]:
    """Level lines within `MISSED` of both ends, and how far these are off, over `NEAR`."""
    near = tolerance(scene)
    x, phi = np.sort([start[0], stop[0]]), np.array([start[1], stop[1]])
    places = np.linspace(x[0] - near[0], x[1] + near[0], PLACES)
    reach = MISSED * near[1]
    window = Window(
        (float(x[0]), float(x[1])), (float(phi.min() - reach), float(phi.max() + reach))
    )
    for angle, edge in window.flush_angles(scene):
        off = float(np.abs(phi - angle).max() / near[1])
        yield track_palm(scene, edge, angle, places), off


def _list_fingers(
    scene: Scene, start: Array, stop: Array
) -> Iterator[tuple[Track, tuple[float, float]]]:
    """Curves on which an edge may lie flush on a finger about a leg, and how far they reach."""
    near = tolerance(scene)[1]
    low, high = sorted((float(start[1]), float(stop[1])))
    x = (float(min(start[0], stop[0])), float(max(start[0], stop[0])))
    around = Window(x, (low - np.pi, high + np.pi))
    for first, last, vertex in around.bands(scene):
        if not (first - near < low and high < last + near):
            continue
        ends = np.clip([low - near, high + near], first, last)
        places = np.linspace(ends[0], ends[1], PLACES)
        for finger in (0, 1):
            for edge in range(scene.polygon.n_vertices):
                yield flush_track(scene, finger, edge, vertex, places), (first, last)


def _locate(track: Track, pose: Array, near: Array) -> tuple[float, float]:
    """Parameter of the place on a track next to a pose, and its distance over `NEAR`."""

    def off(places: Array) -> Array:
        points = np.column_stack(track.pose(places))
        return np.asarray(np.nan_to_num((np.abs(points - pose) / near).max(axis=1), nan=np.inf))

    low, high = float(track.places[0]), float(track.places[-1])
    own = float(np.clip(pose[1], low, high))
    straight = float(off(np.array([own]))[0])
    if straight < 1:
        return own, straight
    for count in (101, 41, 41):
        places = np.linspace(low, high, count)
        away = off(places)
        k = int(away.argmin())
        if away[k] > 2 * MISSED:
            break
        low, high = float(places[max(k - 1, 0)]), float(places[min(k + 1, count - 1)])
    return float(places[k]), float(away[k])


def _covers(pieces: list[Piece], a: float, b: float, near: float) -> bool:
    """Whether the pieces of a border hold both places."""
    return all(
        any(p.places[0] - near < place < p.places[-1] + near for p in pieces) for place in (a, b)
    )


def find_miss(scene: Scene, start: Array, stop: Array) -> Miss | None:
    """The nearest border that both ends of a straight leg are beside, if there is one."""
    near = tolerance(scene)
    misses = []
    if abs(stop[0] - start[0]) > near[0]:
        for track, off in _list_palm(scene, start, stop):
            if off < MISSED and cut(scene, [track]):
                angle = float(track.pose(np.zeros(1))[1][0])
                turn = max((angle - pose[1] for pose in (start, stop)), key=abs)
                text = f"{np.degrees(turn):+.3g} deg in phi"
                misses.append(Miss(track, off, text))
    for track, _ in _list_fingers(scene, start, stop):
        located = [_locate(track, pose, near) for pose in (start, stop)]
        off = max(distance for _, distance in located)
        if off < MISSED and abs(located[0][0] - located[1][0]) > near[1] and cut(scene, [track]):
            gaps = [
                np.array(track.pose(np.array([place]))).ravel() - pose
                for (place, _), pose in zip(located, (start, stop), strict=True)
            ]
            dx, dphi = (max(pair, key=abs) for pair in np.transpose(gaps).tolist())
            text = f"{1e3 * dx:+.3g} mm in x and {np.degrees(dphi):+.3g} deg in phi"
            misses.append(Miss(track, off, text))
    nearest = min(misses, key=lambda miss: miss.off, default=None)
    return nearest if nearest is not None and nearest.off >= 1 else None


def describe_miss(scene: Scene, miss: Miss) -> str:
    """A near miss in words: which border, how far it is, and what would be near enough."""
    assert miss.track.flush is not None
    finger, edge = miss.track.flush
    part = "the palm" if finger is None else f"finger {finger + 1}"
    x, phi = tolerance(scene)
    return (
        f"the nearest border, e{edge} flush on {part}, is up to {miss.text} away; "
        f"a leg follows it with both ends within {1e3 * x:.3g} mm and {np.degrees(phi):.3g} deg"
    )
