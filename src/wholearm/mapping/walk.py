"""Walking a leg the way a problem file is loaded: each phase from the end of the one before."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import permutations

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import describe_pose
from ..geometry.explore import STILL, is_inside
from ..geometry.path_guess import find_end
from ..mechanics.metric import metric_weights
from ..problem.definition import Phase, Problem, Until
from ..scene.model import Scene
from .legs import Part, split_leg
from .nearby import tolerance

DIGITS = 1e-5
"""Coordinates that end a phase are rounded to this, in radii of gyration and radians."""
SAME = 9
"""Decimals of an angle in degrees beyond which there is rounding only."""
REPLANS = 12
"""Most times that the rest of a leg is looked at anew from where its phases so far end."""
BEFORE = 0.98
"""Share of a part at which phases that guide it end: short of the change of contacts."""

Step = tuple[tuple[Contact, ...], Until]
"""One phase: its contacts and what ends it."""
Walked = tuple[Part, Step, Array]
"""A part, a phase for it, and the configuration in which that ends."""


def advance(problem: Problem, index: int, z: Array, step: Step) -> Array:
    """Configuration in which a phase that starts at `z` ends when its problem file is loaded.

    Raises
    ------
    InputError
        If the phase cannot be carried out geometrically.
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
    index : int
        Number of the first phase, from 0.
    z : ndarray, shape (5,)
        Configuration at the start.
    start, stop : ndarray, shape (2,), [m, rad]
        x and phi at the ends of the leg.

    Raises
    ------
    InputError
        If the leg cannot be followed.
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
