"""Walking a leg the way a problem file is loaded: each phase from the end of the one before."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.closing import (
    ClosedFinger,
    Numbers,
    close_fingers,
    contact_table,
    describe_obstacle,
    lower,
)
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, find_touching
from ..geometry.curve import describe_pose
from ..geometry.explore import STILL, is_inside
from ..geometry.path_guess import find_end
from ..mechanics.metric import metric_weights
from ..problem.definition import Phase, Problem, Until
from ..scene.model import Scene
from .borders import (
    Piece,
    Track,
    Window,
    cut,
    flush_track,
    label_cells,
    label_closed,
    name_contacts,
)
from .borders import palm_track as track_palm

NEAR = (0.015, float(np.radians(0.5)))
"""Distances within which poses are on a border or crossing: x in radii of gyration, phi in rad."""
MISSED = 4.0
"""Distance from a border, over `NEAR`, within which a leg beside it is said to be a near miss."""
PLACES = 401  # Places along a leg at which contacts are looked up
SAME_PLACE = 1e-3
"""Length of a part over `NEAR` below which it is left out: its ends are one crossing."""
BESIDE = 1e-6  # Gap between parts, over `NEAR`, above which what lies between cannot be reached
SHORTEST = 0.3  # Share of a short leg that stands for `NEAR` along it
AT_START = 1e-4  # Length over `NEAR` below which the first part of a leg counts as rounding
INSIDE = 0.2  # Distance of the end of a leg from the end of what can be reached, over `NEAR`
PROBES = 9  # Places of an excursion into a neighbouring cell at which its depth is measured
Span = tuple[Numbers, float, float]  # A label and the parameters between which a leg has it
DIGITS = 1e-5  # Coordinates that end a phase are rounded to this, in radii of gyration and radians
SAME = 9  # Decimals of an angle in degrees beyond which there is rounding only
REPLANS = 12  # Most times that the rest of a leg is looked at anew from where its phases so far end
BEFORE = 0.98  # Share of a part at which phases that guide it end: short of the change of contacts
Step = tuple[tuple[Contact, ...], Until]  # One phase: its contacts and what ends it


class Part(NamedTuple):
    """A part of a leg with one contact formation."""

    contacts: tuple[Contact, ...]
    start: Array  # start, stop (2,) [m, rad]: x and phi at its ends
    stop: Array
    # what may end it: contacts that touch from its end on; empty where it ends in between
    gained: tuple[Contact, ...]
    coordinate: int  # {0, 1}: x or phi, whichever tells its end best
    # (2,) [m, rad]: where it ends if nothing is gained: at `stop`, or a little before what cannot
    # be passed
    inside: Array


Walked = tuple[Part, Step, Array]
"""A part, a phase for it, and the configuration in which that ends."""


def advance(problem: Problem, index: int, z: Array, step: Step) -> Array:
    """Configuration in which a phase that starts at `z` ends when its problem file is loaded.

    Raises
    ------
    InputError  if the phase cannot be carried out geometrically
    """
    contacts, until = step
    return find_end(Phase(index, _form(problem.scene, contacts), until), z)


def walk_leg(problem: Problem, index: int, z: Array, start: Array, stop: Array) -> list[Walked]:
    """Phases along a leg, with what each ends in.

    A phase with two freedoms ends where the end is nearest, not where the leg has it, but for the
    last one, whose place is given. Where the phases of the leg do not go on from there, the rest
    of the leg starts from there.

    Parameters
    ----------
    index                        number of the first phase, from 0
    z : (5,)                     configuration at the start
    start, stop : (2,) [m, rad]  x and phi at the ends of the leg

    Raises
    ------
    InputError  if the leg cannot be followed
    """
    walked: list[Walked] = []
    parts, replans = split_leg(problem.scene, start, stop), 0
    while parts:
        parts = _skip_sliver(problem.scene, z, parts)
        try:
            walked += _walk_part(problem, index + len(walked), z, parts[:2])
        except InputError as error:
            moved = (np.abs(z[[0, 2]] - parts[0].start) > 1e-3 * tolerance(problem.scene)).any()
            if not moved or replans == REPLANS:
                raise InputError("", "route", error.problem) from None
            parts, replans = split_leg(problem.scene, z[[0, 2]], stop), replans + 1
            continue
        z, parts = walked[-1][2], parts[1:]
    return walked


def _skip_sliver(scene: Scene, z: Array, parts: list[Part]) -> list[Part]:
    """Leave out a first part within `NEAR` where what follows touches already."""
    while len(parts) > 1:
        first, following = parts[:2]
        short = (np.abs(first.stop - first.start) < tolerance(scene)).all()
        if not short or not _can_start(scene, z, following.contacts):
            break
        parts = parts[1:]
    return parts


def _list_missing(scene: Scene, z: Array, contacts: tuple[Contact, ...]) -> list[Contact]:
    """Those of some contacts that do not touch at `z`."""
    gaps = _form(scene, contacts).evaluate(z[None], z[None]).C[0]
    return [c for c, gap in zip(contacts, gaps, strict=True) if abs(gap) > scene.touching]


def _walk_part(problem: Problem, index: int, z: Array, parts: list[Part]) -> list[Walked]:
    """The first way through a part that can be carried out, and goes on if there is such a way."""
    first: InputError | None = None
    spare: list[Walked] = []
    for steps in _list_ways(problem.scene, z, parts[0], len(parts) == 1):
        here = z
        walked: list[Walked] = []
        try:
            for step in steps:
                there = advance(problem, index + len(walked), here, step)
                _require_motion(problem.scene, here, there, step)
                here = there
                walked.append((parts[0], step, here))
        except InputError as error:
            first = first or error
            continue
        if len(parts[0].contacts) == 4 and not _is_at(problem.scene, here, parts[0]):
            text = f"{steps[-1][1]} is first reached at {describe_pose(here)}"
            first = first or InputError("", "", text)
            continue
        if len(parts) == 1 or _can_start(problem.scene, here, parts[1].contacts):
            return walked
        spare = spare or walked
    if spare:
        return spare
    assert first is not None
    raise first


def _is_at(scene: Scene, z: Array, part: Part) -> bool:
    """Whether a part of a border ends at `z`: its contact may be gained both ways along it."""
    away = np.minimum(np.abs(z[[0, 2]] - part.stop), np.abs(z[[0, 2]] - part.inside))
    return bool((away < tolerance(scene)).all())


def _can_start(scene: Scene, z: Array, contacts: tuple[Contact, ...]) -> bool:
    """Whether a formation holds at `z`."""
    return not _list_missing(scene, z, contacts) and is_inside(_form(scene, contacts), z)


def _require_motion(scene: Scene, z: Array, end: Array, step: Step) -> None:
    """Check that a phase does not end where it starts."""
    metric = metric_weights(scene)
    if metric @ (end - z) ** 2 < (STILL * scene.scales.length) ** 2:
        raise InputError("", "", f"{step[1]} holds already at {describe_pose(z)}")


def _list_ways(scene: Scene, z: Array, part: Part, last: bool) -> Iterator[list[Step]]:
    """Phases that may carry a part from `z`, the plain ones first."""
    if last and len(part.contacts) == 3:
        yield from _list_pinned(scene, part)
    missing = _list_missing(scene, z, part.contacts)
    if len(missing) == 1 and len(part.contacts) == 4:
        # A border that `z` is beside, not on, has to be reached first.
        held = tuple(c for c in part.contacts if c not in missing)
        onto = (held, Until(contact=missing[0]))
        for way in _list_plain(scene, part):
            yield [onto, *way]
        return
    yield from _list_plain(scene, part)
    rows = (part.coordinate,) if len(part.contacts) == 4 else (0, 1)
    yield from _list_guided(scene, part, rows)


def _list_pinned(scene: Scene, part: Part) -> Iterator[list[Step]]:
    """One phase each through a cell, which ends where the part does."""
    pose = [end_at(scene, row, part.stop) for row in (0, 1)]
    for contact in part.gained:
        for own in pose:
            assert own.value is not None
            pins = ((own.coordinate, own.value),)
            yield [(part.contacts, Until(contact=contact, pins=pins))]
    if not part.gained:
        own, other = pose[part.coordinate], pose[1 - part.coordinate]
        assert other.value is not None
        yield [(part.contacts, replace(own, pins=((other.coordinate, other.value),)))]


def _list_plain(scene: Scene, part: Part) -> Iterator[list[Step]]:
    """One phase each."""
    for contact in part.gained:
        yield [(part.contacts, Until(contact=contact))]
    if not part.gained or (part.inside != part.stop).any():
        yield [(part.contacts, end_at(scene, part.coordinate, part.inside))]


def _list_guided(scene: Scene, part: Part, rows: tuple[int, ...]) -> Iterator[list[Step]]:
    """Phases that lead to near the end first, by x and phi: another end may be nearer."""
    share = BEFORE if part.gained else 1.0
    aim = part.start + share * (part.stop - part.start)
    guides = [(part.contacts, end_at(scene, row, aim)) for row in rows]
    ends = [[(part.contacts, Until(contact=contact))] for contact in part.gained] or [[]]
    for count in range(1, len(rows) + 1):
        for chosen in permutations(guides, count):
            for end in ends:
                yield [*chosen, *end]


def end_at(scene: Scene, row: int, pose: Array) -> Until:
    """The end of a phase at x or phi of a pose, rounded as it is printed."""
    if row == 0:
        digits = math.ceil(-math.log10(DIGITS * scene.scales.length))
        return Until(coordinate="x", value=round(float(pose[0]), digits))
    degrees = round(math.degrees(pose[1]), math.ceil(-math.log10(math.degrees(DIGITS))))
    return Until(coordinate="phi", value=math.radians(degrees))


def format_until(until: Until) -> str:
    """The value of a phase's `until` in a problem file, which reads back as it was."""
    if until.contact is not None and not until.pins:
        return f'"{until.contact}"'
    parts = [] if until.contact is None else [f'contact = "{until.contact}"']
    for row, value in until.poses:
        number = round(math.degrees(value), SAME) if row else value
        parts.append(f"{'phi_deg' if row else 'x'} = {number + 0.0!r}")
    return f"{{ {', '.join(parts)} }}"


@lru_cache(maxsize=64)
def _form(scene: Scene, contacts: tuple[Contact, ...]) -> Formation:
    return Formation(scene, contacts)


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
    start, stop : (2,) [m, rad]  x and phi

    Raises
    ------
    InputError  if part of the leg cannot be reached, or it runs through a crossing of borders
    """
    leg = choose_leg(scene, start, stop)
    low, high = min(leg.start, leg.stop), max(leg.start, leg.stop)
    near = min(leg.near, SHORTEST * (high - low))
    way = 1.0 if leg.stop >= leg.start else -1.0
    # A leg starts where the one before it ended, to rounding.
    margins = (AT_START * near, near)[:: int(way)]
    kept = [
        piece
        for piece in cut(scene, [leg.track])
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
    z = close_fingers(scene, pose[:1], pose[1:]).z[0]
    return find_touching(scene, z) if np.isfinite(z).all() else ()


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
            text = describe_obstacle(close_fingers(scene, pose[:1], pose[1:]))
            text = text or "there the border has ended"
            raise InputError("", "route", f"cannot be followed at {describe_place(pose)}: {text}")


def _crossing(place: Array, contacts: tuple[Contact, ...]) -> InputError:
    names = ", ".join(contact.name for contact in contacts)
    text = f"runs through a crossing of borders at {describe_place(place)}, of {names}"
    return InputError("", "route", f"{text}; go around it, or stop there")


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

    def label(_: Array, phi: Array, closed: ClosedFinger) -> Numbers:
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
