"""Legs of a route through the (x, phi) plane: which border one follows, what touches along it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.closing import Numbers, close_fingers, contact_table, describe_obstacle
from ..contacts.elemental import Contact
from ..contacts.formation import find_touching
from ..geometry.curve import describe_pose
from ..scene.model import Scene
from .borders import Piece, label_cells, name_contacts
from .nearby import Leg, choose_leg, tolerance
from .pieces import cut

SAME_PLACE = 1e-3
"""Length of a part over `NEAR` below which it is left out: its ends are one crossing."""
BESIDE = 1e-6
"""Gap between parts, over `NEAR`, above which what lies between cannot be reached."""
SHORTEST = 0.3
"""Share of a short leg that stands for `NEAR` along it."""
AT_START = 1e-4
"""Length over `NEAR` below which the first part of a leg counts as rounding."""
INSIDE = 0.2
"""Distance of the end of a leg from the end of what can be reached, over `NEAR`."""
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
