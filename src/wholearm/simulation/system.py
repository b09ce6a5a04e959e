"""Rigid bodies with pairs of features that may touch: gaps, sliding and their Jacobians.

The motion is M z'' = f + S tau - B z' - friction + A^T c_n + A_t^T c_t with a constant diagonal M.
A pair of features has a gap C(z), whose gradient is its row of A, and a slip coordinate s(z), whose
gradient is its row of A_t: how far the features have slid over each other while they touch.

What is compiled is a `Structure`, which knows of no numbers; a `System` has those of one scene.
That of a scene (`build_system`) has all pairs of features of object and hand (`elemental`), and of
links, such as ``tip1-back2``: tip 1 and the far side of link 2.

The links slide on each other without friction, as no coefficient is given for them. Tolerances of
the simulator are relative to scales of the scene (`Scene.scales`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch
from ..contacts.contact_limits import FINGERS_TOUCH
from ..contacts.elemental import ContactPair, Link, place_bodies
from ..scene.model import Scales, Scene

ROUNDING_FORCE = 1e-9  # shortfall of a force, torque or friction margin that is rounding
REACHED = 3e-5  # distance to the end of a phase that counts as there, at rest: the next overlaps
SLOW = 2e-4  # speed that counts as rest at the end of a phase
STANDING = 1e-9  # speed that counts as none in friction: either sign by integration error
SETTLING = 2e-5  # longest time by which rounding moves an event; modes are judged as late
REST_WINDOW = 2e-3  # time of rest before a torque break: too short for contacts to part
FIRST_STEP = 2e-2  # length of the first step tried from rest
SHORTEST_STEP = 1e-13  # underflow of a step, over the scene's time and the elapsed time
STILL = 1e-10  # acceleration that counts as rounding


class ContactRows(NamedTuple):
    """Pairs at one state: A z' = 0 and A_t z' = 0 keep them closed and stuck."""

    A: Array  # A, A_t (m, n):
    A_t: Array
    bend: Array  # bend, bend_t (m,): A' z' and A_t' z'
    bend_t: Array
    slip: Array  # (m,) [m]: slip coordinates


@dataclass(frozen=True, eq=False)
class Structure:
    """Coordinates and features of bodies of any size and weight."""

    z: Expression  # (n,)
    geometry: Expression  # (g,): numbers that gaps and slip coordinates depend on besides
    pairs: tuple[ContactPair, ...]
    driven: tuple[int, ...]  # coordinates that the two torques act on; empty where there are none
    turns: tuple[bool, ...]  # which coordinates are angles

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.turns)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all pairs."""
        return tuple(pair.name for pair in self.pairs)

    def build_rows(self, chosen: Sequence[int], v: Expression) -> tuple[Expression, ...]:
        """Gaps, slips, A, A_t, A' v and A_t' v of some pairs, as expressions of z and v."""
        parts: list[Expression] = []
        for values in ([self.pairs[k].gap for k in chosen], [self.pairs[k].slip for k in chosen]):
            column = ca.vertcat(ca.SX(0, 1), *values)
            rows = ca.jacobian(column, self.z)
            parts.append((column, rows, ca.jtimes(rows @ v, self.z, v)))
        (gap, A, bend), (slip, A_t, bend_t) = parts
        return gap, slip, A, A_t, bend, bend_t

    @cached_property
    def gaps(self) -> Batch:
        """Function (z, geometry) -> gaps and ranges of all pairs, shape (N, 2)."""
        gaps = ca.vertcat(ca.SX(0, 1), *(pair.gap for pair in self.pairs))
        least = [ca.mmin(ca.vertcat(1e9, *pair.ranges)) for pair in self.pairs]
        both = ca.cse(ca.densify(ca.horzcat(gaps, ca.vertcat(ca.SX(0, 1), *least))))
        return Batch(ca.Function("gaps", [self.z, self.geometry], [both]))


@lru_cache(maxsize=256)
def _build_rows(structure: Structure, chosen: tuple[int, ...]) -> Batch:
    """A, A_t, A' v, A_t' v and slips of some pairs as columns, of z, v and the geometry."""
    v = ca.SX.sym("v", structure.n)
    _, slip, *rows = structure.build_rows(chosen, v)
    both = ca.densify(ca.horzcat(*rows, slip))
    return Batch(ca.Function("rows", [structure.z, v, structure.geometry], [both.T]))


@dataclass(frozen=True, eq=False)
class System:
    """A structure with its numbers."""

    structure: Structure
    geometry: Array  # (g,)
    mass: Array  # (n,): diagonal of M
    applied: Array  # (n,): gravity as a force on z
    # viscous, dry (n,): friction of the coordinates themselves: B, and the largest dry one
    viscous: Array
    dry: Array
    friction: Array  # (N,): Coulomb's coefficient of each pair
    scales: Scales  # units that tolerances count in

    @cached_property
    def n(self) -> int:
        """Number of coordinates."""
        return self.structure.n

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all pairs."""
        return self.structure.names

    @cached_property
    def units(self) -> Array:
        """Units of z, then of z', shape (2 n,)."""
        place = np.where(self.structure.turns, 1.0, self.scales.length)
        return np.concatenate([place, place / self.scales.time])

    def is_slower(self, v: Array, bound: float) -> bool:
        """Whether no component of z', shape (n,), exceeds `bound` times its unit."""
        return bool((np.abs(v) < bound * self.units[self.n :]).all())

    @cached_property
    def friction_units(self) -> Array:
        """Units of the friction of coordinates, shape (n,) [N, N m]."""
        return np.where(self.structure.turns, self.scales.torque, self.scales.force)

    def evaluate(self, z: Array, v: Array, chosen: Sequence[int]) -> ContactRows:
        """Rows of some pairs at one state."""
        n, rows = self.n, np.zeros((0, 2 * self.n + 3))
        if len(chosen):
            rows = _build_rows(self.structure, tuple(chosen)).at(z, v, self.geometry)[0]
        return ContactRows(rows[:, :n], rows[:, n : 2 * n], *rows[:, 2 * n :].T)

    def look(self, z: Array) -> tuple[Array, Array]:
        """As `measure`, at one place: shape (N,) each [m]."""
        gaps, ranges = self.structure.gaps.at(z, self.geometry)[0]
        return gaps, ranges

    def measure(self, z: Array) -> tuple[Array, Array]:
        """Gaps of all pairs and distances inside their ranges, (m, N) each [m], at z (m, n)."""
        geometry = np.broadcast_to(self.geometry, (len(z), len(self.geometry)))
        both = self.structure.gaps(z, geometry)[0]
        return both[:, :, 0], both[:, :, 1]

    def stored(self, z: Array, v: Array) -> Array:
        """Kinetic energy less the work of the applied force, shape (...) [J]."""
        return np.asarray(0.5 * (v**2) @ self.mass - z @ self.applied)

    def push(self, v: Array, tau: Array, sigma: Array) -> Array:
        """Forces on z but those of contacts, with dry friction in the directions `sigma`, (n,)."""
        force = self.applied - self.viscous * v - self.dry * sigma
        driven = list(self.structure.driven)
        force[driven] += tau[: len(driven)]
        return force


@lru_cache(maxsize=64)
def build_system(scene: Scene) -> System:
    """The hand and the object as a system with five coordinates."""
    rounded = tuple(finger.radius > 0 for finger in scene.fingers)
    structure = _build(scene.polygon.n_vertices, rounded, scene.fingers_collide)
    links = [[*np.asarray(f.base), f.length, f.radius] for f in scene.fingers]
    parts = {"m": scene.friction.palm, "1": scene.friction.finger1, "2": scene.friction.finger2}
    friction = [0.0 if name[0] in "tj" else parts[name[-1]] for name in structure.names]
    return System(
        structure,
        np.concatenate([scene.polygon.vertices.ravel(), *links]),
        scene.mass_diagonal,
        scene.applied_force,
        scene.viscous,
        scene.dry,
        np.array(friction),
        scene.scales,
    )


@lru_cache(maxsize=16)
def _build(count: int, rounded: tuple[bool, ...], collide: bool) -> Structure:
    """The structure of all scenes with as many vertices, and links with or without a radius."""
    geometry = ca.SX.sym("geometry", 2 * count + 8)
    parts = (ca.vertsplit(part) for part in ca.vertsplit(geometry[2 * count :], 4))
    links = [
        (ca.vertcat(x, y), length, radius if thick else ca.SX(0))
        for (x, y, length, radius), thick in zip(parts, rounded, strict=True)
    ]
    bodies, pairs = place_bodies(ca.reshape(geometry[: 2 * count], 2, count), links), []
    for contact, pair in bodies.pairs.items():
        if contact.surface in ("finger", "back"):
            # By convexity the whole object is on the side that it touches between its ends.
            link, way = bodies.links[contact.finger or 0], 1 if contact.surface == "finger" else -1
            middle = way * link.normal.T @ (bodies.z[:2] - link.base)
            pair = pair._replace(ranges=(*pair.ranges, middle))
        elif contact.feature == "v" and contact.finger is not None and not rounded[contact.finger]:
            continue
        pairs.append(pair)
    if collide:
        pairs += _list_link_pairs(bodies.links, any(rounded))
    turns = (False, False, True, True, True)
    return Structure(bodies.z, geometry, tuple(pairs), (3, 4), turns)


def _list_link_pairs(links: Sequence[Link], rounded: bool) -> list[ContactPair]:
    """Tips and joints of either link against the other link."""
    pairs, none = list[ContactPair](), ca.SX(0)
    thick = links[0].radius + links[1].radius
    for finger, other in ((0, 1), (1, 0)):
        mine, theirs = links[finger], links[other]
        for name, point, rest in (("tip", mine.tip, mine.base), ("joint", mine.base, mine.tip)):
            behind = theirs.normal.T @ (rest - theirs.base)
            run = theirs.axis.T @ (point - theirs.base)
            level = theirs.normal.T @ (point - theirs.base)
            for side, way in (("finger", 1.0), ("back", -1.0)):
                title = f"{name}{finger + 1}-{side}{other + 1}"
                ranges = (run, theirs.length - run, way * behind)
                pairs.append(ContactPair(title, way * level - thick, none, ranges, FINGERS_TOUCH))
    if not rounded:
        return pairs
    ends = [("tip", link.tip, link.axis) for link in links]
    joints = [("joint", link.base, -link.axis) for link in links]
    for first, second in ((ends[0], ends[1]), (ends[0], joints[1]), (joints[0], ends[1])):
        run = second[1] - first[1]
        gap = ca.sqrt(ca.sumsqr(run)) - thick
        beyond = (first[2].T @ run, -(second[2].T @ run))
        name = f"{first[0]}1-{second[0]}2"
        pairs.append(ContactPair(name, gap, none, beyond, FINGERS_TOUCH))
    return pairs
