"""Places (vertices) of the roadmap: configurations at rest, and the formations that hold there."""

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
from ..geometry.tracing import END_TOL, EndDistance, find_crossing
from ..mechanics.dynamics import close_contacts
from ..problem.definition import Goal, Until
from ..scene.model import Scene

GRID = 1e-4  # grid on which places with equal contacts are identified [radii of gyration and rad]
SLACK = 1e-4  # distance from a goal at which the hand may close instead, in radii of gyration
LANDING_GRID = 0.25  # grid of landings after a cell, which the planner optimizes [same units]
Key = tuple[tuple[str, ...], int, int]


@dataclass(frozen=True, eq=False)
class RoadmapPlace:
    """A configuration at rest."""

    scene: Scene
    z: Array  # (5,)
    contacts: tuple[Contact, ...]  # all touching contacts
    is_landing: bool = False  # whether it is the approximate end of a path through a cell

    @property
    def key(self) -> Key:
        """Contacts and rounded pose."""
        step = LANDING_GRID if self.is_landing else GRID
        x = round(float(self.z[0]) / self.scene.scales.length / step)
        return tuple(c.name for c in self.contacts), x, round(float(self.z[2]) / step)

    def __str__(self) -> str:
        return describe_pose(self.z)


def make_place(scene: Scene, z: Array) -> RoadmapPlace:
    """The place of a configuration, with all touching contacts."""
    return RoadmapPlace(scene, z, find_touching(scene, z))


def close_place(place: RoadmapPlace) -> RoadmapPlace | None:
    """The place with all of its contacts closed; None if they cannot be closed."""
    # In the order of the formations at the place, to share their CasADi functions.
    contacts = sorted(place.contacts, key=lambda c: -1 if c.finger is None else c.finger)
    z = close_contacts(Formation(place.scene, tuple(contacts)), place.z, np.zeros(0))
    return None if z is None else replace(place, z=z)


def list_formations_at(place: RoadmapPlace, count: int) -> Iterator[Formation]:
    """Formations of three or four contacts that hold at a place, with palm and both fingers.

    Two of four contacts are the ends of a flush edge.
    """
    parts = [[c for c in place.contacts if c.finger == part] for part in (None, 0, 1)]
    vertices = place.scene.polygon.n_vertices
    for sizes in ((1, 1, 1),) if count == 3 else ((2, 1, 1), (1, 2, 1), (1, 1, 2)):
        choices = [combinations(part, size) for part, size in zip(parts, sizes, strict=True)]
        for groups in product(*choices):
            pair = next((group for group in groups if len(group) == 2), None)
            if pair is None or _is_flush(pair, vertices):
                yield Formation(place.scene, tuple(c for group in groups for c in group))


def _is_flush(pair: tuple[Contact, ...], vertices: int) -> bool:
    """Whether two contacts with one part of the hand are the ends of a flush edge."""
    side_contacts = [c for c in pair if c.surface != "tip"]
    if len(side_contacts) == 2:
        return abs(pair[0].index - pair[1].index) in (1, vertices - 1)
    if len(side_contacts) == 1:
        # The edge on the tip leads from the vertex on the side to beyond the link.
        (side,), (tip,) = side_contacts, [c for c in pair if c.surface == "tip"]
        edge = (side.index - (side.finger or 0)) % vertices
        return tip.feature == "e" and tip.index == edge
    return False


def lies_on_edge(scene: Scene, contacts: Sequence[Contact], z: Array, goal: Goal) -> bool:
    """Whether the edge of a goal lies on the palm, at the goal's angle, with these contacts."""
    if goal.flush is None or (goal.phi is not None and abs(z[2] - goal.phi) >= END_TOL):
        return False
    ends = {goal.flush, (goal.flush + 1) % scene.polygon.n_vertices}
    return ends <= {c.index for c in contacts if c.finger is None}


def is_at(place: RoadmapPlace, goal: Goal) -> bool:
    """Whether a place is a goal."""
    scene = place.scene
    if goal.x is not None and abs(place.z[0] - goal.x) > END_TOL * scene.scales.length:
        return False
    if goal.flush is not None:
        return lies_on_edge(scene, place.contacts, place.z, goal)
    assert goal.phi is not None
    return bool(abs(place.z[2] - goal.phi) < END_TOL)


def locate_goal(curve: Curve, goal: Goal) -> tuple[float, Until] | None:
    """First arc length inside a curve at which a goal is reached [m], and the terminal condition.

    A flush goal without x is reached only at the ends of curves.
    """
    formation, scene = curve.formation, curve.formation.scene
    until = Until(coordinate="phi", value=goal.phi)
    if goal.flush is not None:
        if goal.x is None or not lies_on_edge(scene, formation.contacts, curve.start, goal):
            return None
        until = Until(coordinate="x", value=goal.x)
    distance = EndDistance(scene, until, curve.start)
    if distance.measure(curve.start[None])[0] < END_TOL:
        return None
    crossings = (find_crossing(p, lambda z: distance.measure(z)[:, None]) for p in curve.panels)
    s = next((crossing[0] for crossing in crossings if crossing), math.inf)
    if s > curve.length:
        return None
    x = float(curve.interpolate(np.array([s]))[0][0, 0])
    if goal.x is not None and abs(x - goal.x) > END_TOL * scene.scales.length:
        return None
    return s, until


def require_reach(scene: Scene, goal: Goal, near: float) -> None:
    """Raise an InputError if the fingers cannot close on the object at a goal.

    It names the ranges of x in which they can. The angle is the one nearest to `near` [rad].
    """
    if goal.x is None:
        return
    phi = goal.find_angle(scene, near)
    x = goal.x + SLACK * scene.scales.length * np.array([0.0, -1.0, 1.0])
    closed = close_fingers(scene, x, np.full(3, phi))
    if (closed.obstacle > 0).any(axis=1).all():
        obstacle, ranges = describe_obstacle(closed), describe_reach(scene, phi)
        raise InputError("", "x", f"{goal.x:g} given; {obstacle} there; {ranges}")
