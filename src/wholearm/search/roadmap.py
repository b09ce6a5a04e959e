"""Lazily built roadmap of a scene: places at rest, edges along borders and through cells.

It depends only on the scene, epsilon and the uniqueness margin: searches from any start to any goal
share it. Edges through cells follow rays, straight lines in (x, phi), to the contact they gain;
their least times come from a vectorized speed sweep. Each cell has one contact of palm and each
finger, so there is no internal force, forces and torques follow from speed and acceleration, and
all paths share one `LimitSet`.
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
from ..planning.lower_bound import GIVE
from ..planning.result import Plan
from ..problem.definition import End, Goal, Problem, Until
from ..scene.model import Scene
from .edge_plans import CoarsePlan, Lost, PartPlan
from .edges import (
    Blocked,
    BorderEdge,
    Chain,
    Edge,
    EdgeStep,
    Unstopped,
    follow_borders,
    point_out,
    time_parts,
)
from .places import RoadmapPlace, close_place, lies_as, list_formations_at, make_place

T = TypeVar("T")

NODES = 12  # intervals of a path

STEPS, MIDDLES, PART = make_cosine_grid(NODES)
"""Intervals over the path's length, and the places in them where limits are kept."""


def time_paths(scene: Scene, epsilon: float, labels: Numbers, starts: Array, ends: Array) -> Array:
    """Least times of straight paths inside cells from rest to rest, or infinite, shape (n,).

    `labels`, (n, 3), are of `closing.contact_table`; starts and ends, (n, 2), are poses (x, phi).
    """
    if not len(ends):
        return np.zeros(0)
    poses = (starts[:, None] + MIDDLES[:, None] * (ends - starts)[:, None]).reshape(-1, 2)
    labels, runs = np.repeat(labels, NODES, axis=0), np.repeat(ends - starts, NODES, axis=0)
    rows, cap = evaluate_paths(scene, epsilon, labels, poses, runs)
    limits = PathLimits(rows.reshape(-1, NODES, *rows.shape[1:]), cap.reshape(-1, NODES))
    return speed_sweep(limits, STEPS, PART, sweeps=2).find_durations(STEPS)


def evaluate_paths(
    scene: Scene, epsilon: float, labels: Numbers, poses: Array, runs: Array
) -> PathLimits:
    """Limits of acceleration and speed at n places of straight paths."""
    formation, limits = _make_limits(scene, epsilon)
    point = evaluate_path(scene, labels, poses, runs)
    kinematics, rates = point.kinematics, point.z_s
    directions = Directions.of(kinematics, rates)
    # Rounding makes dependent wrenches independent by a hair (goal 12): a margin tells them.
    wrenches = force_rows(formation, kinematics, directions)[:, :, :3]
    wrenches /= [1.0, 1.0, scene.scales.length]
    sizes = np.linalg.norm(wrenches, axis=2).prod(axis=1)
    with np.errstate(invalid="ignore"):
        held = np.asarray(np.abs(np.linalg.det(wrenches)) > 1e-9 * sizes)
    kinematics = kinematics._replace(A=np.where(held[:, None, None], kinematics.A, np.nan))
    forces = inverse(formation, point._replace(kinematics=kinematics), directions)
    rows, cap = PathLimits.of(limits, forces, rates[:, 3:], GIVE)
    # No motion where three contacts cannot balance the object, or a finger cannot reach it.
    held &= np.isfinite(rows).all(axis=(1, 2))
    rows = np.where(held[:, None, None], rows, -np.eye(rows.shape[-1])[ONE])
    return PathLimits(rows, np.where(held, cap, 0.0)).eliminate()


@lru_cache(maxsize=8)
def _make_limits(scene: Scene, epsilon: float) -> tuple[Formation, LimitSet]:
    """Three sliding contacts and their limits, which are the same for all such formations."""
    some = (0, first_contact(scene, 0), first_contact(scene, 1))
    formation = Formation(scene, tuple(contact_table(scene)[k] for k in some))
    return formation, make_limits(formation, epsilon)


LONGEST = 6  # Most borders that are passed in one go
HEADINGS = 36  # directions of rays from a place
SPACING, REACH = 0.1, 2.9
"""Step along a ray and its length, in radii of gyration and radians."""
NEARBY = 8  # steps that are looked at first: most rays leave their cells there
PARTS, ROUNDS = 8, 4  # parts of a step, and how often it is divided where a label changes
FIRST = 0.02  # least length of a path; there a ray is inside its cell [same unit]
JUMP = 5e-3  # change of a joint angle at the end of a ray that is none [rad]
NEAREST = 0.02  # least length of a path to a pose, in radii of gyration or radians
TIED = 1 - 1e-9
"""Ratio below which a time is less than another: of mirrored paths the first is taken."""
RELEASES = np.array([0.15, 0.4, 0.6, 0.75, 0.88])  # places of releases, over the border's length
NEAR = 1.0  # longest shift of a landing to a goal, in radii of gyration


class Roadmap:
    """Places, borders and cells of a problem's scene, as far as searches have reached.

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
        self.part_plans: dict[object, PartPlan | Lost] = {}
        self._known: dict[tuple[object, ...], Any] = {}

    def _once(self, make: Callable[[], T], *key: object) -> T:
        """What `make` returns, which is called the first time alone that it is asked for a key."""
        if key not in self._known:
            self._known[key] = make()
        return cast(T, self._known[key])

    def trace(self, place: RoadmapPlace, chain: Chain | None = None) -> list[BorderEdge]:
        """Borders from a place; with a chain, only those that it may enter."""
        closed, borders = close_place(place) if place.landed else place, list[BorderEdge]()
        for formation in list_formations_at(closed, 4) if closed else ():
            if closed and (chain is None or chain.can_enter(formation)):
                # The same contacts, in whatever order, are one formation, compiled once.
                shared = self._formations.setdefault(frozenset(formation.contacts), formation)
                given = closed, shared, self.epsilon, self.uniqueness_margin
                make = partial(follow_borders, *given)
                borders += self._once(make, place.key, formation.contacts)
        return borders

    def follow(self, place: RoadmapPlace) -> list[Chain]:
        """Borders from a place."""
        return self._once(lambda: [Chain((b,)) for b in self.trace(place)], place.key)

    def set_out(self, place: RoadmapPlace, goal: Goal) -> Iterator[Edge | Blocked]:
        """Edges along borders from a place, along several only where a motion cannot stop."""
        for chain in self.follow(place):
            yield from self._list_ends(chain, goal)

    def go_on(self, chain: Chain, goal: Goal) -> Iterator[Edge]:
        """Feasible edges that pass the end of a chain in motion; further ones as in `set_out`."""
        last = chain.borders[-1]
        if last.gained is None or len(chain.borders) == LONGEST:
            return
        chains = self._once(
            lambda: [chain.extend(border) for border in self.trace(last.stop, chain)], chain.borders
        )
        for longer in filter(None, chains):
            yield from (e for e in self._list_ends(longer, goal) if isinstance(e, Edge))

    def _list_ends(self, chain: Chain, goal: Goal) -> Iterator[Edge | Blocked]:
        if chain.edge is not None:
            yield chain.edge
        if (ending := self._once(partial(chain.end_at, goal), chain.borders, goal)) is not None:
            yield ending
        if isinstance(chain.edge, Blocked) and isinstance(chain.edge.reason, Unstopped):
            yield from self.go_on(chain, goal)

    def list_along(self, place: RoadmapPlace, goal: Goal) -> Iterator[Edge]:
        """All feasible edges along borders from a place to their ends or to a goal."""
        waiting = list(self.set_out(place, goal))
        while waiting:
            edge = waiting.pop()
            if isinstance(edge, Edge):
                yield edge
                if edge.chain and edge.onwards:
                    waiting += self.go_on(edge.chain, goal)

    def cross_cells(self, place: RoadmapPlace, goal: Goal) -> list[Edge]:
        """Edges from rest at a place through the cells around it, and to a goal inside of them."""
        edges = self._once(partial(cross, (place,), self.epsilon), "cells", place.key)
        ends = self._once(partial(self.end_in_cell, place, goal), "cells", place.key, goal)
        return [*edges, *ends]

    def release(self, border: BorderEdge, among: Sequence[BorderEdge]) -> list[Edge]:
        """Edges that leave a border for a cell, from the fastest of some places along it.

        Those of all borders `among` are computed together, which takes less time.
        """
        borders = [each for each in among if ("release", each) not in self._known]
        sources = dict[RoadmapPlace, tuple[BorderEdge, float, float]]()
        for each in borders:
            times = time_parts(each, RELEASES)
            free = np.isfinite(times)
            if free.any():
                z = each.curve.evaluate(RELEASES[free] * each.curve.length).z
                middle = make_place(self.scene, z[0])
                for row, share, time in zip(z, RELEASES[free], times[free], strict=True):
                    sources[replace(middle, z=row)] = each, float(share), float(time)
        best = dict[tuple[BorderEdge, tuple[Contact, ...]], Edge]()
        for edge in cross(list(sources), self.epsilon) if sources else ():
            left, share, time = sources[edge.start]
            key, duration = (left, edge.stop.contacts), time + edge.estimate
            if key not in best or duration < TIED * best[key].estimate:
                held = left.formation.contacts
                steps = EdgeStep(held, point_out(held, edge.start.z)), *edge.steps
                whole = replace(edge, start=left.start, steps=steps, estimate=duration)
                best[key] = replace(whole, left=left.curve, share=share)
        for each in borders:
            edges = [edge for (left, _), edge in best.items() if left is each]
            self._known["release", each] = edges
        return cast(list[Edge], self._known["release", border])

    def land_at(self, edges: Sequence[Edge], goal: Goal) -> list[Edge]:
        """Copies of edges that land on the edge of a goal with x, moved to land at this x.

        Durations are kept; the planner decides on feasibility. A border before is left in motion:
        from rest at one place few others can be reached.
        """
        landings = (self._once(partial(self._land, edge, goal), edge, goal) for edge in edges)
        return [landing for landing in landings if landing]

    def _land(self, edge: Edge, goal: Goal) -> Edge | None:
        """The copy of an edge that lands on a goal; None if it is another edge, or too far."""
        *before, last = edge.steps
        if goal.x is None:
            return None
        near = abs(edge.stop.z[0] - goal.x) <= NEAR * self.scene.scales.length
        if not (near and lies_as(self.scene, edge.stop.contacts, edge.stop.z, goal)):
            return None
        formation = Formation(self.scene, edge.stop.contacts)
        z = close_contacts(formation, edge.stop.z, np.zeros(0), ((0, goal.x),))
        if z is None or not is_inside(formation, z):
            return None
        step = last._replace(until=replace(last.until, pins=(("x", goal.x),)))
        first = [EdgeStep(b.contacts, Until(), End.SMOOTH) for b in before]
        return replace(edge, stop=replace(edge.stop, z=z), steps=(*first, step), left=None)

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
        passed = np.concatenate([middles, poses[:, None]], axis=1)
        seen = label_cells(scene, passed)
        far = np.abs((poses - begin) / [scene.scales.length, 1.0]).max(axis=1) > NEAREST
        for formation in list_formations_at(place, 3):
            label = np.array([table.index(contact) for contact in formation.contacts])
            inside = far & (seen == label).all(axis=(1, 2))
            labels = np.tile(label, (int(inside.sum()), 1))
            times = time_paths(scene, self.epsilon, labels, begin[inside], poses[inside])
            if np.isfinite(times).any():
                k = int(times.argmin())
                (z,) = place_at(scene, labels[:1], poses[inside][k : k + 1])
                stop = RoadmapPlace(scene, z, formation.contacts, landed=True)
                step = EdgeStep(formation.contacts, until)
                edges.append(Edge(place, stop, (step,), float(times[k])))
        return edges


def cross(places: Sequence[RoadmapPlace], epsilon: float) -> list[Edge]:
    """The fastest straight path through each cell to each contact, from places of one scene."""
    scene = places[0].scene
    table = contact_table(scene)
    # What touches at each place; the last column is that of `NOWHERE`.
    held = np.array([[*(contact in at.contacts for contact in table), False] for at in places])
    angles = 2 * np.pi * (np.arange(HEADINGS) + 0.5) / HEADINGS
    headings = np.column_stack([scene.scales.length * np.cos(angles), np.sin(angles)])
    sources = np.repeat(np.arange(len(places)), HEADINGS)
    starts = np.array([place.z[[0, 2]] for place in places])[sources]
    runs = np.tile(headings, (len(places), 1))
    labels = label_cells(scene, starts + FIRST * runs)
    kept = np.flatnonzero(held[sources[:, None], labels].all(axis=1))
    rays = Rays(sources, labels, labels, starts, starts + runs).pick(kept)
    if len(rays.sources):
        limits = evaluate_paths(scene, epsilon, rays.labels, rays.starts, rays.runs)
        rays = rays.pick(limits.can_rest())
    s, after = _find_exits(scene, rays)
    rays = rays._replace(gained=after, ends=rays.starts + s * rays.runs)
    rays = _gain(scene, rays.pick((after != rays.labels).any(axis=1)), held)
    times = time_paths(scene, epsilon, rays.labels, rays.starts, rays.ends)
    best: dict[tuple[int, ...], int] = {}
    for k in np.flatnonzero(np.isfinite(times)).tolist():
        key = int(rays.sources[k]), *rays.labels[k].tolist(), int(rays.gained[k])
        if key not in best or times[k] < TIED * times[best[key]]:
            best[key] = k
    chosen = [best[key] for key in sorted(best)]
    z, edges = place_at(scene, rays.labels[chosen], rays.ends[chosen]), list[Edge]()
    for k, end in zip(chosen, z, strict=True):
        contacts, gained = tuple(table[c] for c in rays.labels[k]), table[rays.gained[k]]
        step, start = EdgeStep(contacts, Until(contact=gained)), places[rays.sources[k]]
        stop = RoadmapPlace(scene, end, (*contacts, gained), landed=True)
        edges.append(Edge(start, stop, (step,), float(times[k])))
    return edges


class Rays(NamedTuple):
    """Straight paths through cells, up to where contacts are gained."""

    sources: Numbers  # (n,): numbers of the places they start from
    labels: Numbers  # (n, 3): what touches along them: indices into `closing.contact_table`
    gained: Numbers  # (n,)
    starts: Array  # starts, ends (n, 2) [m, rad]: poses (x, phi)
    ends: Array

    def pick(self, kept: Flags | Numbers) -> Rays:
        """Some of the rays."""
        numbers = self.sources[kept], self.labels[kept], self.gained[kept]
        return Rays(*numbers, self.starts[kept], self.ends[kept])

    @property
    def runs(self) -> Array:
        """From starts to ends, shape (n, 2)."""
        return self.ends - self.starts


def _find_exits(scene: Scene, rays: Rays) -> tuple[Array, Numbers]:
    """The last place of each ray in its cell, (n, 1), and the labels behind it, (n, 3).

    Multisection for the place where the label changes; rays that leave no cell keep theirs.
    """
    s, after = np.full((len(rays.sources), 1), FIRST), rays.labels.copy()

    def step_on(rows: Numbers, step: float, count: int) -> None:
        """Go on by steps, `count` at most, while the label is that of the ray."""
        ahead = s[rows] + step * np.arange(1, count + 1)
        poses = rays.starts[rows, None] + ahead[..., None] * rays.runs[rows, None]
        labels = label_cells(scene, poses)
        outside = (labels != rays.labels[rows, None]).any(axis=2)
        k = np.where(outside.any(axis=1), outside.argmax(axis=1), count)
        after[rows] = labels[np.arange(len(rows)), np.minimum(k, count - 1)]
        s[rows] += step * k[:, None]

    for count in (NEARBY, round(REACH / SPACING) - NEARBY):
        step_on(np.flatnonzero((after == rays.labels).all(axis=1)), SPACING, count)
    left = np.flatnonzero((after != rays.labels).any(axis=1))
    for k in range(ROUNDS):
        step_on(left, SPACING / PARTS ** (k + 1), PARTS)
    return s, after


def _gain(scene: Scene, rays: Rays, held: Flags) -> Rays:
    """Rays that gain a new contact at their ends, of those with labels in place of the gained.

    Contacts `held` where they start are not new.
    """
    part = (rays.gained != rays.labels).argmax(axis=1)[:, None]
    one = (rays.gained != rays.labels).sum(axis=1) == 1
    before, gained = (np.take_along_axis(x, part, 1)[:, 0] for x in (rays.labels, rays.gained))
    new = one & (gained != NOWHERE) & ~held[rays.sources, gained]
    new &= ~_list_renamed(scene)[gained, before]
    rays = rays.pick(new)._replace(gained=gained[new])
    # Where a finger passes the end of an edge, its first touch jumps.
    after = rays.labels.copy()
    np.put_along_axis(after, part[new], rays.gained[:, None], axis=1)
    jump = place_at(scene, after, rays.ends) - place_at(scene, rays.labels, rays.ends)
    return rays.pick(np.abs(jump[:, 3:]).max(axis=1, initial=0.0) < JUMP)


@lru_cache(maxsize=8)
def _list_renamed(scene: Scene) -> Flags:
    """Whether two contacts of `contact_table` can be one that changes its name, with none flush."""

    def is_renamed(one: Contact, two: Contact) -> bool:
        same = one.surface == two.surface or one.feature == two.feature
        on_tip = "tip" in (one.surface, two.surface)
        return one.finger == two.finger and one.finger is not None and on_tip and same

    table = contact_table(scene)
    return np.array([[is_renamed(one, two) for two in table] for one in table])
