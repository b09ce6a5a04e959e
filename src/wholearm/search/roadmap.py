"""Lazily built roadmap of a scene: places at rest, edges along borders and through cells.

It depends only on the scene, epsilon and the uniqueness margin: all searches in a scene share it.
Edges through cells follow rays, straight lines in (x, phi), to the contact they gain; their least
times are computed by a vectorized speed sweep. In a cell, palm and both fingers have one contact
each: there is no internal force, forces and torques follow from speed and acceleration, and all
paths share one `LimitSet`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from ..common.arrays import Array, Flags, Numbers
from ..contacts.closing import contact_table, evaluate_path, first_contact, place_at
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.path_guess import is_inside
from ..mapping.borders import NOWHERE, label_cells
from ..mechanics.dynamics import ONE, Directions, close_contacts, force_rows, inverse
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import make_cosine_grid, speed_sweep
from ..planning.lower_bound import RELAXATION
from ..planning.result import Plan
from ..problem.definition import End, Goal, Problem, Until
from ..scene.model import Scene
from .edge_plans import CoarsePlan, PartPlan, PlanFailure
from .edges import (
    BlockedEdge,
    BorderEdge,
    Chain,
    Edge,
    EdgeStep,
    NoStop,
    end_at_pose,
    follow_borders,
    time_parts,
)
from .places import RoadmapPlace, close_place, lies_on_edge, list_formations_at, make_place

T = TypeVar("T")

NODES = 12  # intervals of a path

STEPS, MIDDLES, OFFSETS = make_cosine_grid(NODES)
"""Intervals over the path's length, places in them where limits are enforced, their offsets."""


def time_paths(scene: Scene, epsilon: float, labels: Numbers, starts: Array, ends: Array) -> Array:
    """Least times of straight paths inside cells from rest to rest, or infinite, shape (n,).

    `labels`, (n, 3), index `closing.contact_table`; starts and ends, (n, 2), are poses (x, phi).
    """
    if not len(ends):
        return np.zeros(0)
    poses = (starts[:, None] + MIDDLES[:, None] * (ends - starts)[:, None]).reshape(-1, 2)
    labels, vectors = np.repeat(labels, NODES, axis=0), np.repeat(ends - starts, NODES, axis=0)
    rows, cap = evaluate_paths(scene, epsilon, labels, poses, vectors)
    limits = PathLimits(rows.reshape(-1, NODES, *rows.shape[1:]), cap.reshape(-1, NODES))
    return speed_sweep(limits, STEPS, OFFSETS, sweeps=2).find_durations(STEPS)


def evaluate_paths(
    scene: Scene, epsilon: float, labels: Numbers, poses: Array, vectors: Array
) -> PathLimits:
    """Limits of acceleration and speed at n places of straight paths."""
    formation, limits = _make_limits(scene, epsilon)
    point = evaluate_path(scene, labels, poses, vectors)
    kinematics, rates = point.kinematics, point.z_s
    directions = Directions.of(kinematics, rates)
    # A tolerance: dependent wrenches may be independent by rounding. Case: goal 12.
    wrenches = force_rows(formation, kinematics, directions)[:, :, :3]
    wrenches /= [1.0, 1.0, scene.scales.length]
    sizes = np.linalg.norm(wrenches, axis=2).prod(axis=1)
    with np.errstate(invalid="ignore"):
        regular = np.asarray(np.abs(np.linalg.det(wrenches)) > 1e-9 * sizes)
    kinematics = kinematics._replace(A=np.where(regular[:, None, None], kinematics.A, np.nan))
    forces = inverse(formation, point._replace(kinematics=kinematics), directions)
    rows, cap = PathLimits.of(limits, forces, rates[:, 3:], RELAXATION)
    # No motion if three contacts cannot balance the object, or a finger cannot reach it.
    regular &= np.isfinite(rows).all(axis=(1, 2))
    rows = np.where(regular[:, None, None], rows, -np.eye(rows.shape[-1])[ONE])
    return PathLimits(rows, np.where(regular, cap, 0.0)).eliminate()


@lru_cache(maxsize=8)
def _make_limits(scene: Scene, epsilon: float) -> tuple[Formation, LimitSet]:
    """A formation of three sliding contacts and its limits, which are the same for all of them."""
    indices = (0, first_contact(scene, 0), first_contact(scene, 1))
    formation = Formation(scene, tuple(contact_table(scene)[k] for k in indices))
    return formation, make_limits(formation, epsilon)


MAX_BORDERS = 6  # largest number of borders passed without a stop
N_HEADINGS = 36  # directions of rays from a place
SPACING, REACH = 0.1, 2.9
"""Step along a ray and its length, in radii of gyration and radians."""
FIRST_STEPS = 8  # steps that are evaluated first: most rays leave their cells within them
PARTS, DIVISIONS = 8, 4  # parts of a step, and divisions of a step in which a label changes
MIN_LENGTH = 0.02  # least length of a path; there a ray is inside its cell [same unit]
MAX_JUMP = 5e-3  # largest jump of a joint angle at the end of a ray [rad]
MIN_DISTANCE = 0.02  # least length of a path to a pose, in radii of gyration or radians
TIE = 1 - 1e-9
"""Ratio below which a time is less than another: of mirrored paths the first one is used."""
RELEASES = np.array([0.15, 0.4, 0.6, 0.75, 0.88])  # places of releases, over the border's length
MAX_SHIFT = 1.0  # longest shift of a landing to a goal, in radii of gyration


class Roadmap:
    """Places and edges of a problem's scene, computed on demand and stored.

    Attributes
    ----------
    plans         plans of phases, or why there are none; see `edge_plans`
    coarse_plans  plans of single edges through cells, the best first; empty if there are none
    part_plans    plans of parts of routes
    refined       edges whose place on the border has been optimized
    """

    def __init__(self, problem: Problem, uniqueness_margin: float) -> None:
        self.scene, self.epsilon = problem.scene, problem.epsilon
        self.uniqueness_margin = uniqueness_margin
        self.refined: set[Edge] = set()
        self._formations: dict[frozenset[Contact], Formation] = {}
        self.plans: dict[object, Plan | str] = {}
        self.coarse_plans: dict[Edge, list[CoarsePlan]] = {}
        self.part_plans: dict[object, PartPlan | PlanFailure] = {}
        self._cache: dict[tuple[object, ...], Any] = {}

    def _memoize(self, compute: Callable[[], T], *key: object) -> T:
        """Result of `compute`, which is called once for each key."""
        if key not in self._cache:
            self._cache[key] = compute()
        return cast(T, self._cache[key])

    def trace(self, place: RoadmapPlace, chain: Chain | None = None) -> list[BorderEdge]:
        """Borders from a place; with a chain, only those that it may enter."""
        closed, borders = close_place(place) if place.is_landing else place, list[BorderEdge]()
        for formation in list_formations_at(closed, 4) if closed else ():
            if closed and (chain is None or chain.can_enter(formation)):
                # One formation for all orders of the contacts: its functions are built once.
                shared = self._formations.setdefault(frozenset(formation.contacts), formation)
                margin = self.uniqueness_margin
                follow = partial(follow_borders, closed, shared, self.epsilon, margin)
                borders += self._memoize(follow, place.key, formation.contacts)
        return borders

    def follow(self, place: RoadmapPlace) -> list[Chain]:
        """Borders from a place."""
        return self._memoize(lambda: [Chain((b,)) for b in self.trace(place)], place.key)

    def list_edges(self, place: RoadmapPlace, goal: Goal) -> Iterator[Edge | BlockedEdge]:
        """Edges along borders from a place; along several only if a motion cannot stop."""
        for chain in self.follow(place):
            yield from self._list_ends(chain, goal)

    def continue_chain(self, chain: Chain, goal: Goal) -> Iterator[Edge]:
        """Feasible edges that pass the end of a chain without a stop, as in `list_edges`."""
        last = chain.borders[-1]
        if last.gained is None or len(chain.borders) == MAX_BORDERS:
            return
        chains = self._memoize(
            lambda: [chain.extend(border) for border in self.trace(last.stop, chain)], chain.borders
        )
        for longer in filter(None, chains):
            yield from (e for e in self._list_ends(longer, goal) if isinstance(e, Edge))

    def _list_ends(self, chain: Chain, goal: Goal) -> Iterator[Edge | BlockedEdge]:
        if chain.edge is not None:
            yield chain.edge
        if (ending := self._memoize(partial(chain.end_at, goal), chain.borders, goal)) is not None:
            yield ending
        if isinstance(chain.edge, BlockedEdge) and isinstance(chain.edge.reason, NoStop):
            yield from self.continue_chain(chain, goal)

    def collect_edges(self, place: RoadmapPlace, goal: Goal) -> Iterator[Edge]:
        """All feasible edges along borders from a place to their ends or to a goal."""
        stack = list(self.list_edges(place, goal))
        while stack:
            edge = stack.pop()
            if isinstance(edge, Edge):
                yield edge
                if edge.chain and edge.continues:
                    stack += self.continue_chain(edge.chain, goal)

    def cross_cells(self, place: RoadmapPlace, goal: Goal) -> list[Edge]:
        """Edges from rest at a place through the cells around it, and to a goal inside them."""
        edges = self._memoize(partial(cross, (place,), self.epsilon), "cells", place.key)
        ends = self._memoize(partial(self.end_in_cell, place, goal), "cells", place.key, goal)
        return [*edges, *ends]

    def release(self, border: BorderEdge, group: Sequence[BorderEdge]) -> list[Edge]:
        """Edges that leave a border for a cell, from the fastest of some places along it.

        Edges of all borders of a `group` are computed together, which takes less time.
        """
        borders = [member for member in group if ("release", member) not in self._cache]
        sources = dict[RoadmapPlace, tuple[BorderEdge, float, float]]()
        for member in borders:
            times = time_parts(member, RELEASES)
            possible = np.isfinite(times)
            if possible.any():
                z = member.curve.evaluate(RELEASES[possible] * member.curve.length).z
                place = make_place(self.scene, z[0])
                for row, fraction, time in zip(z, RELEASES[possible], times[possible], strict=True):
                    sources[replace(place, z=row)] = member, float(fraction), float(time)
        best = dict[tuple[BorderEdge, tuple[Contact, ...]], Edge]()
        for edge in cross(list(sources), self.epsilon) if sources else ():
            owner, fraction, time = sources[edge.start]
            key, duration = (owner, edge.stop.contacts), time + edge.estimate
            if key not in best or duration < TIE * best[key].estimate:
                contacts = owner.formation.contacts
                steps = EdgeStep(contacts, end_at_pose(contacts, edge.start.z)), *edge.steps
                full_edge = replace(edge, start=owner.start, steps=steps, estimate=duration)
                best[key] = replace(full_edge, curve=owner.curve, fraction=fraction)
        for member in borders:
            edges = [edge for (owner, _), edge in best.items() if owner is member]
            self._cache["release", member] = edges
        return cast(list[Edge], self._cache["release", border])

    def land_at(self, edges: Sequence[Edge], goal: Goal) -> list[Edge]:
        """Copies of edges that land with the flush edge of a goal, moved to the x of the goal.

        Durations are not changed; the planner decides on feasibility. A border before is left
        without a stop: few landings can be reached from rest at one place.
        """
        landings = (self._memoize(partial(self._land, edge, goal), edge, goal) for edge in edges)
        return [landing for landing in landings if landing]

    def _land(self, edge: Edge, goal: Goal) -> Edge | None:
        """The copy of an edge that lands at a goal; None if it lands otherwise, or too far away."""
        *previous, last = edge.steps
        if goal.x is None:
            return None
        is_near = abs(edge.stop.z[0] - goal.x) <= MAX_SHIFT * self.scene.scales.length
        if not (is_near and lies_on_edge(self.scene, edge.stop.contacts, edge.stop.z, goal)):
            return None
        formation = Formation(self.scene, edge.stop.contacts)
        z = close_contacts(formation, edge.stop.z, np.zeros(0), ((0, goal.x),))
        if z is None or not is_inside(formation, z):
            return None
        step = last._replace(until=replace(last.until, pins=(("x", goal.x),)))
        first_steps = [EdgeStep(b.contacts, Until(), End.SMOOTH) for b in previous]
        return replace(edge, stop=replace(edge.stop, z=z), steps=(*first_steps, step), curve=None)

    def end_in_cell(self, place: RoadmapPlace, goal: Goal) -> list[Edge]:
        """The fastest straight edge through each cell around a place to a goal inside of it.

        If x is free it is sampled.
        """
        if goal.phi is None or goal.flush is not None:
            return []
        scene, table, edges = self.scene, contact_table(self.scene), list[Edge]()
        x = place.z[0] + np.linspace(-1.5, 1.5, 13) * scene.scales.length
        x = x if goal.x is None else np.array([goal.x])
        poses = np.column_stack([x, np.full(len(x), goal.phi)])
        pins = () if goal.x is None else (("x", goal.x),)
        until = Until(None, "phi", goal.phi, pins)
        begin = np.broadcast_to(place.z[[0, 2]], poses.shape)
        middles = begin[:, None] + MIDDLES[:, None] * (poses - begin)[:, None]
        samples = np.concatenate([middles, poses[:, None]], axis=1)
        cell_labels = label_cells(scene, samples)
        distant = np.abs((poses - begin) / [scene.scales.length, 1.0]).max(axis=1) > MIN_DISTANCE
        for formation in list_formations_at(place, 3):
            label = np.array([table.index(contact) for contact in formation.contacts])
            inside = distant & (cell_labels == label).all(axis=(1, 2))
            labels = np.tile(label, (int(inside.sum()), 1))
            times = time_paths(scene, self.epsilon, labels, begin[inside], poses[inside])
            if np.isfinite(times).any():
                k = int(times.argmin())
                (z,) = place_at(scene, labels[:1], poses[inside][k : k + 1])
                stop = RoadmapPlace(scene, z, formation.contacts, is_landing=True)
                step = EdgeStep(formation.contacts, until)
                edges.append(Edge(place, stop, (step,), float(times[k])))
        return edges


def cross(places: Sequence[RoadmapPlace], epsilon: float) -> list[Edge]:
    """The fastest straight path through each cell to each contact, from places of one scene."""
    scene = places[0].scene
    table = contact_table(scene)
    # Touching contacts at each place; the last column is that of `NOWHERE`.
    touching = np.array([[*(contact in p.contacts for contact in table), False] for p in places])
    angles = 2 * np.pi * (np.arange(N_HEADINGS) + 0.5) / N_HEADINGS
    headings = np.column_stack([scene.scales.length * np.cos(angles), np.sin(angles)])
    sources = np.repeat(np.arange(len(places)), N_HEADINGS)
    starts = np.array([place.z[[0, 2]] for place in places])[sources]
    vectors = np.tile(headings, (len(places), 1))
    labels = label_cells(scene, starts + MIN_LENGTH * vectors)
    inside = np.flatnonzero(touching[sources[:, None], labels].all(axis=1))
    rays = Rays(sources, labels, labels, starts, starts + vectors).pick(inside)
    if len(rays.sources):
        limits = evaluate_paths(scene, epsilon, rays.labels, rays.starts, rays.vectors)
        rays = rays.pick(limits.can_rest())
    s, next_labels = _find_exits(scene, rays)
    rays = rays._replace(gained=next_labels, ends=rays.starts + s * rays.vectors)
    rays = _select_gains(scene, rays.pick((next_labels != rays.labels).any(axis=1)), touching)
    times = time_paths(scene, epsilon, rays.labels, rays.starts, rays.ends)
    best: dict[tuple[int, ...], int] = {}
    for k in np.flatnonzero(np.isfinite(times)).tolist():
        key = int(rays.sources[k]), *rays.labels[k].tolist(), int(rays.gained[k])
        if key not in best or times[k] < TIE * times[best[key]]:
            best[key] = k
    chosen = [best[key] for key in sorted(best)]
    z, edges = place_at(scene, rays.labels[chosen], rays.ends[chosen]), list[Edge]()
    for k, end in zip(chosen, z, strict=True):
        contacts, gained = tuple(table[c] for c in rays.labels[k]), table[rays.gained[k]]
        step, start = EdgeStep(contacts, Until(contact=gained)), places[rays.sources[k]]
        stop = RoadmapPlace(scene, end, (*contacts, gained), is_landing=True)
        edges.append(Edge(start, stop, (step,), float(times[k])))
    return edges


class Rays(NamedTuple):
    """Straight paths through cells, up to gained contacts."""

    sources: Numbers  # (n,): indices of their places
    labels: Numbers  # (n, 3): contacts along them: indices into `closing.contact_table`
    gained: Numbers  # (n,): contacts gained at their ends
    starts: Array  # starts, ends (n, 2) [m, rad]: poses (x, phi)
    ends: Array

    def pick(self, rows: Flags | Numbers) -> Rays:
        """Some of the rays."""
        numbers = self.sources[rows], self.labels[rows], self.gained[rows]
        return Rays(*numbers, self.starts[rows], self.ends[rows])

    @property
    def vectors(self) -> Array:
        """From starts to ends, shape (n, 2)."""
        return self.ends - self.starts


def _find_exits(scene: Scene, rays: Rays) -> tuple[Array, Numbers]:
    """The last place of each ray in its cell, (n, 1), and the labels behind it, (n, 3).

    Multisection for the change of the label; rays that do not leave their cells keep their label.
    """
    s, next_labels = np.full((len(rays.sources), 1), MIN_LENGTH), rays.labels.copy()

    def advance(rows: Numbers, step: float, count: int) -> None:
        """Advance by steps, `count` at most, while the label is that of the ray."""
        next_s = s[rows] + step * np.arange(1, count + 1)
        poses = rays.starts[rows, None] + next_s[..., None] * rays.vectors[rows, None]
        labels = label_cells(scene, poses)
        outside = (labels != rays.labels[rows, None]).any(axis=2)
        k = np.where(outside.any(axis=1), outside.argmax(axis=1), count)
        next_labels[rows] = labels[np.arange(len(rows)), np.minimum(k, count - 1)]
        s[rows] += step * k[:, None]

    for count in (FIRST_STEPS, round(REACH / SPACING) - FIRST_STEPS):
        advance(np.flatnonzero((next_labels == rays.labels).all(axis=1)), SPACING, count)
    leaving = np.flatnonzero((next_labels != rays.labels).any(axis=1))
    for k in range(DIVISIONS):
        advance(leaving, SPACING / PARTS ** (k + 1), PARTS)
    return s, next_labels


def _select_gains(scene: Scene, rays: Rays, touching: Flags) -> Rays:
    """Rays that gain a new contact; `rays.gained` are the labels (n, 3) behind their ends.

    Contacts `touching` at their starts are not new.
    """
    column = (rays.gained != rays.labels).argmax(axis=1)[:, None]
    single = (rays.gained != rays.labels).sum(axis=1) == 1
    before, gained = (np.take_along_axis(x, column, 1)[:, 0] for x in (rays.labels, rays.gained))
    new = single & (gained != NOWHERE) & ~touching[rays.sources, gained]
    new &= ~_list_renamed(scene)[gained, before]
    rays = rays.pick(new)._replace(gained=gained[new])
    # The first contact of a finger may jump at the end of an edge.
    next_labels = rays.labels.copy()
    np.put_along_axis(next_labels, column[new], rays.gained[:, None], axis=1)
    jump = place_at(scene, next_labels, rays.ends) - place_at(scene, rays.labels, rays.ends)
    return rays.pick(np.abs(jump[:, 3:]).max(axis=1, initial=0.0) < MAX_JUMP)


@lru_cache(maxsize=8)
def _list_renamed(scene: Scene) -> Flags:
    """Whether two contacts of `contact_table` can be one that changes its name; none is flush."""

    def is_renamed(first: Contact, second: Contact) -> bool:
        same = first.surface == second.surface or first.feature == second.feature
        on_tip = "tip" in (first.surface, second.surface)
        return first.finger == second.finger and first.finger is not None and on_tip and same

    table = contact_table(scene)
    return np.array([[is_renamed(first, second) for second in table] for first in table])
