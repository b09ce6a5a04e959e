"""Legs of a route through the (x, phi) plane: which border one follows, what touches along it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..contact import Contact
from ..curve import describe_pose
from ..errors import InputError
from ..formation import find_touching
from ..model import Array, Scene
from .borders import Piece, Track, Window, flush_track, label_cells, name_contacts
from .borders import palm_track as track_palm
from .closing import Numbers, close, contact_table, describe_obstacle
from .pieces import cut

NEAR = (0.015, float(np.radians(0.5)))
"""Distances within which poses are on a border or crossing: x in radii of gyration, phi in rad."""
MISSED = 4.0
"""Distance from a border, over `NEAR`, within which a leg beside it is said to be a near miss."""
SAME_PLACE = 1e-3
"""Length of a part over `NEAR` below which it is left out: its ends are one crossing."""
BESIDE = 1e-6
"""Gap between parts, over `NEAR`, above which what lies between cannot be reached."""
SHORTEST = 0.3
"""Share of a short leg that stands for `NEAR` along it."""
AT_START = 1e-4
"""Length over `NEAR` below which the first part of a leg counts as rounding."""
INSIDE = 0.2
"""How far before the end of what can be reached a leg stops, over `NEAR`."""
PLACES = 401
"""Places along a leg at which contacts are looked up."""
PROBES = 9
"""Places of an excursion into a neighbouring cell at which its depth is measured."""


Span = tuple[Numbers, float, float]
"""A label and the parameters between which a leg has it."""


class Part(NamedTuple):
    """A part of a leg with one contact formation.

    Attributes
    ----------
    contacts : tuple of Contact
    start, stop : ndarray, shape (2,), [m, rad]
        x and phi at its ends.
    gained : tuple of Contact
        What may end it: contacts that touch from its end on; empty where it ends in between.
    coordinate : {0, 1}
        x or phi, whichever tells its end best.
    inside : ndarray, shape (2,), [m, rad]
        Where it ends if nothing is gained: at `stop`, or a little before what cannot be passed.
    """

    contacts: tuple[Contact, ...]
    start: Array
    stop: Array
    gained: tuple[Contact, ...]
    coordinate: int
    inside: Array


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


def describe_place(pose: Array) -> str:
    """A pose (x, phi) in words."""
    return describe_pose(np.array([pose[0], 0.0, pose[1]]))


def split_leg(scene: Scene, start: Array, stop: Array) -> list[Part]:
    """Split a leg into parts with one formation each.

    A leg with both ends within `NEAR` of one border follows the border; any other is straight.
    An end that near a change of contacts is moved to it, and a straight leg that leaves a cell by
    no more than that, and comes back, stays in it.

    Parameters
    ----------
    start, stop : ndarray, shape (2,), [m, rad]
        x and phi.

    Raises
    ------
    InputError
        If part of the leg cannot be reached, or it runs through a crossing of borders.
    """
    leg = _choose_leg(scene, start, stop)
    low, high = min(leg.start, leg.stop), max(leg.start, leg.stop)
    near = min(leg.near, SHORTEST * (high - low))
    way = 1.0 if leg.stop >= leg.start else -1.0
    # A leg starts where the one before it ended, to rounding.
    margins = (AT_START * near, near)[:: int(way)]
    kept = [
        piece
        for piece in cut(leg.track)
        if piece.places[-1] > low + margins[0] and piece.places[0] < high - margins[1]
    ]
    _require_reached(scene, leg, kept, [low + near, high - near])
    spans = [(p.label, float(p.places[0]), float(p.places[-1])) for p in kept]
    spans = [span for span in spans if span[2] - span[1] > SAME_PLACE * leg.near] or spans
    if way < 0:
        spans = [(label, last, first) for label, first, last in spans[::-1]]
    # The track goes on a little beyond the leg; a change of contacts that near ends the leg.
    label, first, last = spans[0]
    if abs(first - leg.start) > 0.99 * near:
        spans[0] = (label, leg.start, last)
    label, first, last = spans[-1]
    at_change = way * (last - leg.stop) < 0.99 * near
    if not at_change:
        spans[-1] = (label, first, leg.stop)
    if leg.track.flush is None:
        spans = _drop_excursions(scene, leg, spans)
    return _build_parts(scene, leg, spans, at_change)


def _build_parts(scene: Scene, leg: Leg, spans: list[Span], at_change: bool) -> list[Part]:
    table, near = contact_table(scene), tolerance(scene)
    parts = []
    for index, (label, first, last) in enumerate(spans):
        mine = name_contacts(table, label)
        begin, end = leg.at(first), leg.at(last)
        gained: tuple[Contact, ...] = ()
        inside = end
        if index + 1 < len(spans):
            following = name_contacts(table, spans[index + 1][0])
            gained = tuple(c for c in following if c not in mine)
            if len(gained) != 1:
                raise _crossing(end, tuple(dict.fromkeys((*mine, *following))))
        elif at_change:
            gained = tuple(c for c in _find_touching(scene, end) if c not in mine)
            inside = leg.at(last + np.clip(first - last, -INSIDE * leg.near, INSIDE * leg.near))
        coordinate = int((np.abs(end - begin) / near).argmax())
        if leg.track.flush is not None:
            coordinate = 0 if leg.track.flush[0] is None else 1
        parts.append(Part(mine, begin, end, gained, coordinate, inside))
    return parts


def _find_touching(scene: Scene, pose: Array) -> tuple[Contact, ...]:
    z = close(scene, pose[:1], pose[1:]).z[0]
    return find_touching(scene, z) if np.isfinite(z).all() else ()


def _choose_leg(scene: Scene, start: Array, stop: Array) -> Leg:
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
            if _covers(cut(own), a, b, near[1]):
                found.append((max(off_a, off_b), own, a, b))
    if found:
        _, track, a, b = min(found, key=lambda entry: entry[0])
        return Leg(track, a, b, near[1])

    def pose(s: Array) -> tuple[Array, Array]:
        points = start + s[:, None] * (stop - start)
        return points[:, 0], points[:, 1]

    share = float(1 / (np.abs(stop - start) / near).max())
    places = np.linspace(-share, 1.0 + share, PLACES)
    track = Track(pose, lambda x, phi: label_cells(scene, x, phi), places, np.inf)
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
            if off < MISSED and cut(track):
                ends = [
                    abs(float(track.pose(np.zeros(1))[1][0]) - pose[1]) for pose in (start, stop)
                ]
                text = f"{np.degrees(max(ends)):.3g} deg in phi"
                misses.append(Miss(track, off, text))
    for track, _ in _list_fingers(scene, start, stop):
        located = [_locate(track, pose, near) for pose in (start, stop)]
        off = max(distance for _, distance in located)
        if off < MISSED and abs(located[0][0] - located[1][0]) > near[1] and cut(track):
            gaps = [
                np.abs(np.array(track.pose(np.array([place]))).ravel() - pose)
                for (place, _), pose in zip(located, (start, stop), strict=True)
            ]
            dx, dphi = np.max(gaps, axis=0)
            text = f"{1e3 * dx:.3g} mm in x and {np.degrees(dphi):.3g} deg in phi"
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


def _drop_excursions(scene: Scene, leg: Leg, spans: list[Span]) -> list[Span]:
    """Keep a contact that a straight leg loses, by less than `NEAR`, and gains again."""
    labels = np.array([label for label, _, _ in spans])
    for column in (0, 2, 4):
        own = labels[:, column]
        for k in range(1, len(spans)):
            again = np.flatnonzero(own[k:] == own[k - 1])
            if not len(again) or again[0] == 0:
                continue
            first, last = spans[k][1], spans[k + int(again[0]) - 1][2]
            if _is_shallow(scene, leg, column, int(own[k - 1]), first, last):
                own[k : k + int(again[0])] = own[k - 1]
    kept: list[Span] = []
    for label, (_, first, last) in zip(labels, spans, strict=True):
        if kept and (kept[-1][0] == label).all():
            _, first, _ = kept.pop()
        kept.append((label, first, last))
    return kept


def _is_shallow(
    scene: Scene, leg: Leg, column: int, contact: int, first: float, last: float
) -> bool:
    """Whether each place of a straight leg is within `NEAR` of where a contact touches."""
    x, phi = leg.track.pose(np.linspace(first, last, PROBES))
    box = np.array([[a, b] for a in (-1, 0, 1) for b in (-1, 0, 1)]) * tolerance(scene)
    around = (np.column_stack([x, phi])[:, None] + box).reshape(-1, 2)
    labels = label_cells(scene, *around.T).reshape(PROBES, len(box), -1)
    return bool((labels[..., column] == contact).any(axis=1).all())


def _require_reached(scene: Scene, leg: Leg, kept: list[Piece], ends: list[float]) -> None:
    inner = [float(s) for piece in kept for s in piece.places[[0, -1]]]
    ends = [ends[0], *inner, ends[1]]
    for before, after in zip(ends[::2], ends[1::2], strict=True):
        if after - before > BESIDE * leg.near:
            pose = leg.at((before + after) / 2)
            text = describe_obstacle(close(scene, pose[:1], pose[1:]))
            text = text or "there the border has ended"
            raise InputError("", "route", f"cannot be followed at {describe_place(pose)}: {text}")


def _crossing(place: Array, contacts: tuple[Contact, ...]) -> InputError:
    names = ", ".join(contact.name for contact in contacts)
    text = f"runs through a crossing of borders at {describe_place(place)}, of {names}"
    return InputError("", "route", f"{text}; go around it, or stop there")
