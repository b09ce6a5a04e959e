"""Places of the roadmap: configurations at rest, and the formations that hold there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.closing import close_fingers, describe_obstacle, describe_reach
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, find_touching
from ..geometry.curve import Curve, describe_pose
from ..geometry.tracing import HELD, EndDistance, find_crossing
from ..mechanics.dynamics import close_contacts
from ..problem.definition import Goal, Until
from ..scene.model import Scene

FINE = 1e-4  # Grid on which places with the same contacts are one, in radii of gyration and radians
NEAR = 1e-4  # how far beside a goal the hand may close instead, in radii of gyration
COARSE = 0.25  # the same for landings after a cell, which the planner optimizes
Key = tuple[tuple[str, ...], int, int]


@dataclass(frozen=True, eq=False)
class RoadmapPlace:
    """A configuration at rest."""

    scene: Scene
    z: Array  # (5,)
    contacts: tuple[Contact, ...]  # all that touch
    landed: bool = False  # whether a path through a cell ends about here: not a crossing

    @property
    def key(self) -> Key:
        """Contacts and rounded pose."""
        step = COARSE if self.landed else FINE
        x = round(float(self.z[0]) / self.scene.scales.length / step)
        return tuple(c.name for c in self.contacts), x, round(float(self.z[2]) / step)

    def __str__(self) -> str:
        return describe_pose(self.z)


def make_place(scene: Scene, z: Array) -> RoadmapPlace:
    """The place of a configuration, with all contacts that touch there."""
    return RoadmapPlace(scene, z, find_touching(scene, z))


def close_place(place: RoadmapPlace) -> RoadmapPlace | None:
    """A place with all of its contacts closed exactly; None where they do not close."""
    # In the order of the formations at the place, to share their compiled functions.
    contacts = sorted(place.contacts, key=lambda c: -1 if c.finger is None else c.finger)
    z = close_contacts(Formation(place.scene, tuple(contacts)), place.z, np.zeros(0))
    return None if z is None else replace(place, z=z)


def list_formations_at(place: RoadmapPlace, count: int) -> Iterator[Formation]:
    """Formations of three or four contacts that hold at a place, with palm and both fingers.

    Of four, two are the ends of an edge that lies flush.
    """
    parts = [[c for c in place.contacts if c.finger == part] for part in (None, 0, 1)]
    vertices = place.scene.polygon.n_vertices
    for sizes in ((1, 1, 1),) if count == 3 else ((2, 1, 1), (1, 2, 1), (1, 1, 2)):
        chosen = [combinations(part, size) for part, size in zip(parts, sizes, strict=True)]
        for groups in product(*chosen):
            pair = next((group for group in groups if len(group) == 2), None)
            if pair is None or _is_flush(pair, vertices):
                yield Formation(place.scene, tuple(c for group in groups for c in group))


def _is_flush(pair: tuple[Contact, ...], vertices: int) -> bool:
    """Whether two contacts with one part of the hand are the ends of a flush edge."""
    sides = [c for c in pair if c.surface != "tip"]
    if len(sides) == 2:
        return abs(pair[0].index - pair[1].index) in (1, vertices - 1)
    if len(sides) == 1:
        # The edge on the tip leads from the vertex on the side to beyond the link.
        (side,), (tip,) = sides, [c for c in pair if c.surface == "tip"]
        ahead = (side.index - (side.finger or 0)) % vertices
        return tip.feature == "e" and tip.index == ahead
    return False


def lies_as(scene: Scene, contacts: Sequence[Contact], z: Array, goal: Goal) -> bool:
    """Whether the edge of a goal lies on the palm with these contacts, and at the goal's angle."""
    if goal.flush is None or (goal.phi is not None and abs(z[2] - goal.phi) >= HELD):
        return False
    ends = {goal.flush, (goal.flush + 1) % scene.polygon.n_vertices}
    return ends <= {c.index for c in contacts if c.finger is None}


def is_at(place: RoadmapPlace, goal: Goal) -> bool:
    """Whether a place is a goal."""
    scene = place.scene
    if goal.x is not None and abs(place.z[0] - goal.x) > HELD * scene.scales.length:
        return False
    if goal.flush is not None:
        return lies_as(scene, place.contacts, place.z, goal)
    assert goal.phi is not None
    return bool(abs(place.z[2] - goal.phi) < HELD)


def measure_along(curve: Curve, goal: Goal) -> tuple[float, Until] | None:
    """First place inside a curve at which a goal is met [m], and the end of a phase there.

    A flush goal without x is met only at the ends of curves.
    """
    formation, scene = curve.formation, curve.formation.scene
    until = Until(coordinate="phi", value=goal.phi)
    if goal.flush is not None:
        if goal.x is None or not lies_as(scene, formation.contacts, curve.start, goal):
            return None
        until = Until(coordinate="x", value=goal.x)
    distance = EndDistance(scene, until, curve.start)
    if distance.measure(curve.start[None])[0] < HELD:
        return None
    crossings = (find_crossing(p, lambda z: distance.measure(z)[:, None]) for p in curve.panels)
    s = next((crossing[0] for crossing in crossings if crossing), math.inf)
    if s > curve.length:
        return None
    x = float(curve.interpolate(np.array([s]))[0][0, 0])
    if goal.x is not None and abs(x - goal.x) > HELD * scene.scales.length:
        return None
    return s, until


def require_reach(scene: Scene, goal: Goal, near: float) -> None:
    """Raise an InputError if the fingers do not close on an object at a goal.

    It says where they would. The angle of the object before is `near` [rad].
    """
    if goal.x is None:
        return
    phi = goal.find_angle(scene, near)
    x = goal.x + NEAR * scene.scales.length * np.array([0.0, -1.0, 1.0])
    closed = close_fingers(scene, x, np.full(3, phi))
    if (closed.obstacle > 0).any(axis=1).all():
        why, where = describe_obstacle(closed), describe_reach(scene, phi)
        raise InputError("", "x", f"{goal.x:g} given; {why} there; {where}")
