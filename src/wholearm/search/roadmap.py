"""Lazily built roadmap of a scene: places at rest, links along borders and through cells.

It depends only on the scene, epsilon and the uniqueness margin: searches from any start to any goal
share it. Links through cells follow rays, straight lines in (x, phi), to the contact they gain;
their least times come from a vectorized speed sweep. Each cell has one contact of palm and each
finger, so there is no internal force, forces and torques follow from speed and acceleration, and
all paths share one `LimitSet`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import (
    Flags,
    Numbers,
    contact_table,
    find_reach,
    first_contact,
    measure_gap,
    move,
)
from ..contacts.closing import place as place_at
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.explore import close_contacts, is_inside
from ..mapping.borders import NOWHERE, label_cells
from ..mechanics.dynamics import ONE, Directions, force_rows, inverse, metric_weights
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits
from ..planning.lower_bound.path_terms import GIVE
from ..planning.lower_bound.speed_sweep import make_cosine_grid, speed_sweep
from ..planning.path_domain.impact_sequence import BEND, compute_curve_impact
from ..planning.result import Plan
from ..problem.definition import End, Phase, Problem, Until
from ..problem.goal import Goal
from ..scene.model import Scene
from .border_limits import Unstopped
from .edges import (
    Blocked,
    BorderEdge,
    EdgeStep,
    Link,
    Terms,
    cut_curve,
    follow_borders,
    link_along,
    point_out,
    time_parts,
)
from .feasibility import Measured
from .places import (
    Key,
    RoadmapPlace,
    close_place,
    is_flush,
    list_formations_at,
    list_pins,
    list_poses,
    make_place,
    measure_along,
    unit_steps,
)

if TYPE_CHECKING:
    from .edge_plans import PlannedLink


NODES = 12  # intervals of a path

STEPS, MIDDLES, PART = make_cosine_grid(NODES)
"""Intervals over the path's length, and the places in them where limits are kept."""


def list_middles(starts: Array, ends: Array) -> Array:
    """Poses at `MIDDLES` of paths between poses (n, 2), shape (n, NODES, 2)."""
    return np.asarray(starts[:, None] + MIDDLES[:, None] * (ends - starts)[:, None])


def can_start(scene: Scene, epsilon: float, labels: Numbers, poses: Array, runs: Array) -> Flags:
    """Whether motions along straight paths can start from rest, shape (n,); see `time_paths`."""
    return _evaluate(scene, epsilon, labels, poses, runs).can_rest()


def time_paths(scene: Scene, epsilon: float, labels: Numbers, starts: Array, ends: Array) -> Array:
    """Least times of straight paths inside cells from rest to rest, or infinite, shape (n,).

    Parameters
    ----------
    epsilon : [N]
    labels : (n, 3)                 contacts of each with palm, finger 1 and finger 2, by
                                    `closing.contact_table`
    starts, ends : (n, 2) [m, rad]  poses (x, phi)
    """
    if not len(ends):
        return np.zeros(0)
    poses = list_middles(starts, ends).reshape(-1, 2)
    labels, runs = np.repeat(labels, NODES, axis=0), np.repeat(ends - starts, NODES, axis=0)
    rows, cap = _evaluate(scene, epsilon, labels, poses, runs)
    limits = PathLimits(rows.reshape(-1, NODES, *rows.shape[1:]), cap.reshape(-1, NODES))
    return speed_sweep(limits, STEPS, PART, sweeps=2).find_durations(STEPS)


def _evaluate(
    scene: Scene, epsilon: float, labels: Numbers, poses: Array, runs: Array
) -> PathLimits:
    """Limits of acceleration and speed at n places of straight paths."""
    at, (formation, limits) = move(scene, labels, poses, runs), _make_limits(scene, epsilon)
    directions, kinematics = Directions.of(at.kinematics, at.z_u), at.kinematics
    try:
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    except np.linalg.LinAlgError:
        wrenches = force_rows(formation, kinematics, directions)[:, :, :3]
        unheld = np.equal(np.linalg.det(wrenches), 0.0).reshape(-1, 1, 1)
        kinematics = kinematics._replace(A=np.where(unheld, np.nan, kinematics.A))
        forces = inverse(formation, at.z, at.z_u, at.z_uu, directions, kinematics)
    rows, cap = PathLimits.of(limits, forces, at.z_u[:, 3:], GIVE).eliminate()
    # No motion where three contacts cannot balance the object.
    held = np.asarray(np.isfinite(rows).all(axis=(1, 2)))
    rows = np.where(held[:, None, None], rows, -np.eye(rows.shape[-1])[ONE])
    return PathLimits(rows, np.where(held, cap, 0.0))


@lru_cache(maxsize=8)
def _make_limits(scene: Scene, epsilon: float) -> tuple[Formation, LimitSet]:
    """Three sliding contacts and their limits, which are the same for all such formations."""
    some = (0, first_contact(scene, 0), first_contact(scene, 1))
    formation = Formation(scene, tuple(contact_table(scene)[k] for k in some))
    return formation, make_limits(formation, epsilon)


LONGEST = 6  # Most borders that are passed in one go
AROUND = 64
"""Grid places per turn of phi; steps of x in radii of gyration are the same."""
HEADINGS = 36  # directions of rays from a place
SPACING, REACH = 2 * np.pi / AROUND, 3.0
"""Step along a ray and its length, in radii of gyration and radians."""
FIRST = 0.02  # least length of a path; there a ray is inside its cell [same unit]
OUTSIDE = 4  # grid places of a ray outside its cell at which new contacts are candidates
CLOSER = 0.05  # step of gap evaluations around the estimated place of a contact
AROUND_END = 6  # number of these before and after
BESIDE = 4e-4  # distance before and after a border at which labels are compared
NEAREST = 0.02  # least length of a path to a pose, in radii of gyration or radians
TIED = 1 - 1e-9
"""Ratio below which a time is less than another: of mirrored paths the first is taken."""
RELEASES = (0.15, 0.4, 0.6, 0.75, 0.88)  # places of releases, over the length of the border
NEAR = 1.0  # longest shift of a landing to a goal, in radii of gyration
Found = list[Link | Blocked]


class Ahead(NamedTuple):
    """A link along borders."""

    chain: Chain  # the borders
    link: Link | Blocked
    whole: bool  # whether it follows the last border to its end, where a motion may pass on


class Roadmap:
    """Places, borders and cells of a problem's scene, as far as searches have reached.

    Attributes
    ----------
    plans     plans of routes, or why there are none; see `candidates`
    measured  plans of single links through cells, or why there are none
    others    slower plans of these
    refined   links whose place on the border has been optimized
    joined    plans of links from rest to rest; see `edge_plans`
    """

    def __init__(self, problem: Problem, uniqueness_margin: float) -> None:
        self.scene, self.epsilon = problem.scene, problem.epsilon
        self.terms = Terms(problem.epsilon, uniqueness_margin)
        self.refined: set[Link] = set()
        self._borders: dict[tuple[Key, tuple[Contact, ...]], list[BorderEdge]] = {}
        self._curves: dict[frozenset[Contact], list[Curve]] = {}
        self._links: dict[Key, list[tuple[BorderEdge, Link | Blocked | None]]] = {}
        self._cells: dict[Key, Found] = {}
        self.plans: dict[object, Plan | str] = {}
        self.others: dict[Link, list[Measured]] = {}
        self.joined: dict[tuple[object, ...], PlannedLink | str] = {}
        self.measured: dict[Link, Measured | str] = {}
        self._releases: dict[tuple[Key, int], Found] = {}
        self._longer: dict[tuple[BorderEdge, ...], list[tuple[Chain, Link | Blocked | None]]] = {}

    def trace(self, place: RoadmapPlace, chain: Chain | None = None) -> list[BorderEdge]:
        """Borders from a place; with a chain, only those that it may enter."""
        closed, found = close_place(place) if place.landed else place, list[BorderEdge]()
        for formation in list_formations_at(closed, 4) if closed else ():
            if closed and (chain is None or chain.can_enter(formation)):
                key = place.key, formation.contacts
                if key not in self._borders:
                    curves = self._curves.setdefault(frozenset(formation.contacts), [])
                    self._borders[key] = follow_borders(closed, formation, self.terms, curves)
                found += self._borders[key]
        return found

    def follow(self, place: RoadmapPlace) -> list[tuple[BorderEdge, Link | Blocked | None]]:
        """Borders from a place, with the link along the whole of each."""
        key = place.key
        if key not in self._links:
            self._links[key] = [(b, Chain.of(b).link_whole()) for b in self.trace(place)]
        return self._links[key]

    def extend(self, chain: Chain) -> list[tuple[Chain, Link | Blocked | None]]:
        """Chains with one more border entered in motion, with the link along each."""
        key, last = chain.borders, chain.borders[-1]
        if last.gained is None or len(key) == LONGEST:
            return []
        if key not in self._longer:
            chains = [chain.extend(border) for border in self.trace(last.stop, chain)]
            self._longer[key] = [(longer, longer.link_whole()) for longer in chains if longer]
        return self._longer[key]

    def pass_on(self, place: RoadmapPlace) -> Iterator[tuple[Chain, Link | Blocked | None]]:
        """Chains of borders from a place, each with the link along all of it."""
        waiting = [(Chain.of(border), link) for border, link in self.follow(place)]
        while waiting:
            chain, link = waiting.pop()
            if not _is_barred(link):
                longer = self.extend(chain)
                yield from longer
                waiting += longer

    def list_along(
        self, place: RoadmapPlace, goal: Goal
    ) -> Iterator[tuple[BorderEdge, Link | Blocked]]:
        """Links along borders from a place to their ends or to a goal, with the first border.

        Of chains, only feasible links.
        """
        for border, link in self.follow(place):
            for found in (link, self._end_chain(Chain.of(border), goal)):
                if found is not None:
                    yield border, found
        for chain, link in self.pass_on(place):
            for found in (link, self._end_chain(chain, goal)):
                if isinstance(found, Link):
                    yield chain.borders[0], found

    def set_out(self, place: RoadmapPlace, goal: Goal) -> Iterator[Ahead]:
        """Links along borders from a place; along several only where a motion cannot stop."""
        for border, link in self.follow(place):
            yield from self._list_ends(Chain.of(border), link, goal)

    def go_on(self, chain: Chain, goal: Goal) -> Iterator[Ahead]:
        """Feasible links that pass the end of a chain in motion; further ones as in `set_out`."""
        for longer, link in self.extend(chain):
            ends = self._list_ends(longer, link, goal)
            yield from (ahead for ahead in ends if isinstance(ahead.link, Link))

    def _list_ends(self, chain: Chain, link: Link | Blocked | None, goal: Goal) -> Iterator[Ahead]:
        if link is not None:
            yield Ahead(chain, link, True)
        if (ending := self._end_chain(chain, goal)) is not None:
            yield Ahead(chain, ending, False)
        if isinstance(link, Blocked) and not _is_barred(link):
            yield from self.go_on(chain, goal)

    def cross_cells(self, place: RoadmapPlace) -> Found:
        """Links from rest at a place through the cells around it."""
        if place.key not in self._cells:
            crossings = cross((place,), self.epsilon)
            found: Found = [self._link_cell(place, (), crossing, 0.0) for crossing in crossings]
            self._cells[place.key] = found
        return self._cells[place.key]

    def release(self, border: BorderEdge, number: int) -> Found:
        """Links that leave a border for a cell, from the fastest of some places along it."""
        key = border.start.key, number
        if key in self._releases:
            return self._releases[key]
        shares = np.array(RELEASES)
        times = time_parts(border, shares)
        shares, times = shares[np.isfinite(times)], times[np.isfinite(times)]
        best: dict[tuple[Contact | None, ...], Link] = {}
        if len(shares):
            z = border.curve.evaluate(shares * border.curve.length).z
            held = border.formation.contacts
            middle = make_place(self.scene, z[0])
            for crossing in cross([replace(middle, z=row) for row in z], self.epsilon):
                k, contacts = crossing.source, (*crossing.contacts, crossing.gained)
                first = EdgeStep(held, point_out(held, z[k]))
                link = self._link_cell(border.start, (first,), crossing, times[k])
                if contacts not in best or link.duration < TIED * best[contacts].duration:
                    best[contacts] = replace(link, left=border.curve, share=float(shares[k]))
        self._releases[key] = list(best.values())
        return self._releases[key]

    def _link_cell(
        self, start: RoadmapPlace, before: tuple[EdgeStep, ...], path: CellCrossing, spent: float
    ) -> Link:
        steps = (*before, EdgeStep(path.contacts, Until(contact=path.gained)))
        assert path.gained is not None
        stop = RoadmapPlace(self.scene, path.z, (*path.contacts, path.gained), landed=True)
        return Link(start, stop, steps, spent + path.duration, True)

    def _end_chain(self, chain: Chain, goal: Goal) -> Link | Blocked | None:
        """The link along a chain to a goal on its last border; None if there is none."""
        last = chain.borders[-1]
        found = measure_along(last.curve, goal)
        if found is None:
            return None
        s, until = found
        cut = replace(last, curve=cut_curve(last.curve, s))
        step = EdgeStep(last.formation.contacts, until)
        return chain.link(step, cut)

    def land_at(self, links: Found, goal: Goal) -> list[Link]:
        """Copies of links that land on the edge of a goal with x, moved to land at this x.

        Durations are kept; the planner decides on feasibility. A border before is left in motion:
        from rest at one place few others can be reached.
        """
        landings = [link for link in links if isinstance(link, Link) and link.in_cell]
        if goal.flush is None or goal.x is None:
            return []
        found, near = list[Link](), NEAR * self.scene.scales.length
        for link in landings:
            *before, last = link.steps
            if not is_flush(link.stop, goal.flush) or abs(link.stop.z[0] - goal.x) > near:
                continue
            formation = Formation(self.scene, link.stop.contacts)
            z = close_contacts(formation, link.stop.z, np.zeros(0), ((0, goal.x),))
            if z is not None and is_inside(formation, z):
                step = last._replace(until=replace(last.until, pins=list_pins(goal)))
                stop = replace(link.stop, z=z)
                first = [EdgeStep(b.contacts, Until(), End.SMOOTH) for b in before]
                found.append(replace(link, stop=stop, steps=(*first, step), left=None))
        return found

    def end_in_cell(self, place: RoadmapPlace, goal: Goal) -> Iterator[Link]:
        """Straight links from a place to a goal inside a cell around it."""
        poses = list_poses(self.scene, place.z, goal)
        if not len(poses):
            return
        for formation in list_formations_at(place, 3):
            path = go_to(place, formation, poses, self.epsilon)
            if path is not None:
                assert goal.phi is not None
                until = Until(None, "phi", goal.phi, list_pins(goal))
                steps = (EdgeStep(formation.contacts, until),)
                stop = RoadmapPlace(self.scene, path.z, formation.contacts, landed=True)
                yield Link(place, stop, steps, path.duration, True)


def _is_barred(link: Link | Blocked | None) -> bool:
    """Whether a link is blocked for motions that do not stop at its end, too."""
    return isinstance(link, Blocked) and not isinstance(link.reason, Unstopped)


class CellCrossing(NamedTuple):
    """A straight path through a cell."""

    source: int  # number of the place it starts from
    contacts: tuple[Contact, ...]  # what touches along it
    gained: Contact | None  # at its end; None at a given pose
    z: Array  # (5,): its end
    duration: float  # [s]


def cross(places: Sequence[RoadmapPlace], epsilon: float) -> list[CellCrossing]:
    """The fastest straight path through each cell to each contact, from places of one scene."""
    scene = places[0].scene
    rays = shoot(places, epsilon)
    times = time_paths(scene, epsilon, rays.labels, rays.starts, rays.ends)
    best: dict[tuple[int, ...], int] = {}
    for k in np.flatnonzero(np.isfinite(times)).tolist():
        key = int(rays.sources[k]), *rays.labels[k].tolist(), int(rays.gained[k])
        if key not in best or times[k] < TIED * times[best[key]]:
            best[key] = k
    chosen = [best[key] for key in sorted(best)]
    z, table = place_at(scene, rays.labels[chosen], rays.ends[chosen]), contact_table(scene)
    return [
        CellCrossing(
            int(rays.sources[k]),
            tuple(table[c] for c in rays.labels[k]),
            table[rays.gained[k]],
            end,
            float(times[k]),
        )
        for k, end in zip(chosen, z, strict=True)
    ]


def go_to(
    start: RoadmapPlace, formation: Formation, poses: Array, epsilon: float
) -> CellCrossing | None:
    """The fastest straight path from a place to one of some poses (x, phi) inside a cell."""
    scene = start.scene
    label = np.array([contact_table(scene).index(contact) for contact in formation.contacts])
    begin = np.broadcast_to(start.z[[0, 2]], poses.shape)
    middles = list_middles(begin, poses)
    places = np.concatenate([middles, poses[:, None]], axis=1)
    labels = label_cells(scene, *places.reshape(-1, 2).T)[:, [0, 2, 4]]
    inside = (labels == label).all(axis=1).reshape(places.shape[:2]).all(axis=1)
    inside &= np.abs((poses - begin) / unit_steps(scene)).max(axis=1) > NEAREST
    if not inside.any():
        return None
    ends = poses[inside]
    labels = np.broadcast_to(label, (len(ends), 3))
    times = time_paths(scene, epsilon, labels, begin[inside], ends)
    k = int(times.argmin())
    if not np.isfinite(times[k]):
        return None
    (z,) = place_at(scene, labels[:1], ends[k : k + 1])
    return CellCrossing(0, formation.contacts, None, z, float(times[k]))


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


def shoot(places: Sequence[RoadmapPlace], epsilon: float) -> Rays:
    """Rays that gain a contact, from places of one scene, along which a motion can start."""
    scene = places[0].scene
    cells, held = _list_cells(places)
    angles = 2 * np.pi * (np.arange(HEADINGS) + 0.5) / HEADINGS
    headings = np.column_stack([np.cos(angles), np.sin(angles)]) * unit_steps(scene)
    sources = np.repeat(np.arange(len(places)), HEADINGS)
    starts = np.array([place.z[[0, 2]] for place in places])[sources]
    runs = np.tile(headings, (len(places), 1))
    labels = label_cells(scene, *(starts + FIRST * runs).T)[:, [0, 2, 4]]
    kept = (labels[:, None] == cells[sources]).all(axis=2).any(axis=1)
    rays = Rays(sources, labels, labels[:, 0], starts, starts + runs).pick(kept)
    ray, gained, about = _look_ahead(scene, rays, held)
    used, ray = np.unique(ray, return_inverse=True)
    rays = rays.pick(used)
    if not len(used):
        return rays
    kept = can_start(scene, epsilon, rays.labels, rays.starts, rays.runs)[ray]
    return _end(scene, rays.pick(ray[kept])._replace(gained=gained[kept]), about[kept])


def _list_cells(places: Sequence[RoadmapPlace]) -> tuple[Numbers, Numbers]:
    """Labels of the cells around places, shape (n, f, 3), and all contacts there, (n, c)."""
    index = {contact: k for k, contact in enumerate(contact_table(places[0].scene))}
    cells = [[cell.contacts for cell in list_formations_at(place, 3)] for place in places]
    labels = np.full((len(places), max(map(len, cells)), 3), NOWHERE - 1)
    held = np.full((len(places), max(len(place.contacts) for place in places)), NOWHERE - 1)
    for k, place in enumerate(places):
        for row, contacts in enumerate(cells[k]):
            labels[k, row] = [index[contact] for contact in contacts]
        held[k, : len(place.contacts)] = [index[contact] for contact in place.contacts]
    return labels, held


def _look_ahead(scene: Scene, rays: Rays, held: Numbers) -> tuple[Numbers, Numbers, Array]:
    """Contacts that rays may gain: numbers of rays, contacts, estimated places [-], shape (k,).

    All new contacts at the first few grid places outside the ray's cell are candidates, as the
    nearest grid place may be in another cell.
    """
    grid = map_labels(scene)
    away = SPACING * np.arange(1, round(REACH / SPACING))
    seen = grid.look_up(rays.starts[:, None] + away[:, None] * rays.runs[:, None])
    # All rays from one place into one cell share this.
    cell = np.column_stack([rays.sources, rays.labels])
    cell, group = np.unique(cell, axis=0, return_inverse=True)
    cell_label, touching = cell[:, None, 1:], held[cell[:, 0], None, None]
    other = (grid.labels != cell_label) & ~(grid.labels[:, :, None] == touching).any(axis=3)
    new = other & ~_list_renamed(scene)[grid.labels, cell_label] & (grid.labels != NOWHERE)
    outside = other.any(axis=2)[group[:, None], seen]
    outside &= outside.cumsum(axis=1) <= OUTSIDE
    ray, step = np.nonzero(outside)
    entry, part = np.nonzero(new[group[ray], seen[ray, step]])
    ray, step = ray[entry], step[entry]
    gained = grid.labels[seen[ray, step], part]
    _, once = np.unique(ray * len(contact_table(scene)) + gained, return_index=True)
    return ray[once], gained[once], np.asarray(away[step[once]])


def _end(scene: Scene, rays: Rays, about: Array) -> Rays:
    """Rays shortened to right before the contact that they gain, near the estimated place."""
    places = np.maximum(about - CLOSER * AROUND_END, 0.0)[:, None]
    end = _find_root(scene, rays, places + CLOSER * np.arange(2 * AROUND_END + 1))
    kept = end > FIRST + BESIDE
    rays, end = rays.pick(kept), end[kept, None]
    before, after = (rays.starts + (end + aside) * rays.runs for aside in (-BESIDE / 2, BESIDE / 2))
    rays = rays._replace(ends=before)
    return rays.pick(_is_inside(scene, rays, end, after))


def _find_root(scene: Scene, rays: Rays, places: Array) -> Array:
    """Places where the gained contacts close, near places (n, m) [-]; NaN where they do not."""
    gaps, rows = _measure_gaps(scene, rays, places), np.arange(len(places))
    with np.errstate(invalid="ignore"):
        falls = (gaps[:, :-1] > 0) & (gaps[:, 1:] <= 0)
    first = falls.argmax(axis=1)
    near = np.clip(first - 1, 0, places.shape[1] - 4)[:, None] + np.arange(4)
    around = first[:, None] + np.arange(2)
    left, right = np.take_along_axis(places, around, 1).T
    s, values = (np.take_along_axis(part, near, 1) for part in (places, gaps))
    inner = _interpolate(s, values, left, right)
    inner_gap = _measure_gaps(scene, rays, inner[:, None])[:, 0]
    s = np.column_stack([left, inner, right])
    values = np.insert(np.take_along_axis(gaps, around, 1), 1, inner_gap, axis=1)
    left, right = np.where(inner_gap > 0, (inner, right), (left, inner))
    root = _interpolate(s, values, left, right)
    return np.where(falls[rows, first], root, np.nan)


def _measure_gaps(scene: Scene, rays: Rays, places: Array) -> Array:
    """Gaps [m] of gained contacts, with those of the cells closed, at places (n, m) [-]."""
    poses = rays.starts[:, None] + places[..., None] * rays.runs[:, None]
    each = np.repeat(np.arange(len(places)), places.shape[1])
    z = place_at(scene, rays.labels[each], poses.reshape(-1, 2))
    return measure_gap(scene, rays.gained[each], z).reshape(places.shape)


def _interpolate(s: Array, f: Array, left: Array, right: Array) -> Array:
    """Zeros of inverse interpolation polynomials of values (n, m); else the middle (bisection)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = f[:, None, :] / (f[:, None, :] - f[:, :, None])
        ratios[:, np.arange(s.shape[1]), np.arange(s.shape[1])] = 1.0
        root = (s * ratios.prod(axis=2)).sum(axis=1)
        return np.asarray(np.where((root >= left) & (root <= right), root, (left + right) / 2))


def _is_inside(scene: Scene, rays: Rays, end: Array, after: Array) -> Flags:
    """Whether rays stay in their cells up to their ends, and gain the contact right after.

    Next to both ends the grid is not consulted.
    """
    every, grid = np.arange(len(after)), map_labels(scene)
    poses = list_middles(rays.starts, rays.ends)
    away = end * np.minimum(MIDDLES, 1 - MIDDLES)
    unsure = grid.look_up(poses) != grid.find(rays.labels)[:, None]
    row, step = np.nonzero(unsure & (away > SPACING / 2))
    rows = np.concatenate([row, every, every])
    expected = rays.labels[rows]
    part = np.array([0 if c.finger is None else 1 + c.finger for c in contact_table(scene)])
    expected[len(rows) - len(after) + every, part[rays.gained]] = rays.gained
    poses = np.concatenate([poses[row, step], rays.ends, after])
    wrong = (label_cells(scene, *poses.T)[:, [0, 2, 4]] != expected).any(axis=1)
    return np.asarray(np.bincount(rows, wrong, len(after)) == 0)


@lru_cache(maxsize=8)
def _list_renamed(scene: Scene) -> Flags:
    """Whether two contacts of `contact_table` can be one that changes its name, with none flush."""

    def is_renamed(one: Contact, two: Contact) -> bool:
        same = one.surface == two.surface or one.feature == two.feature
        on_tip = "tip" in (one.surface, two.surface)
        return one.finger == two.finger and one.finger is not None and on_tip and same

    table = contact_table(scene)
    return np.array([[is_renamed(one, two) for two in table] for one in table])


class LabelMap(NamedTuple):
    """Labels on a grid of poses."""

    least: float  # [m]: least x
    steps: Array  # (2,) [m, rad]: grid steps of x and phi
    # (n, 3): distinct labels: contacts of palm and fingers, `borders.NOWHERE` where none closes
    labels: Numbers
    which: Numbers  # (n_x, AROUND): their numbers on the grid; phi starts from zero

    def look_up(self, poses: Array) -> Numbers:
        """Numbers of labels at the nearest grid places, shape (...), for poses (..., 2)."""
        row = np.rint((poses[..., 0] - self.least) / self.steps[0]).astype(np.int64)
        column = np.rint(poses[..., 1] / self.steps[1]).astype(np.int64)
        # The first and the last row are beyond the reach of a finger.
        return np.asarray(self.which[np.clip(row, 0, len(self.which) - 1), column % AROUND])

    def find(self, labels: Numbers) -> Numbers:
        """Numbers of given labels, shape (m,); -1 for those that are not on the grid."""
        same = (labels[:, None] == self.labels).all(axis=2)
        return np.where(same.any(axis=1), same.argmax(axis=1), -1)


@lru_cache(maxsize=16)
def map_labels(scene: Scene) -> LabelMap:
    """Labels of all poses at which both fingers reach the object."""
    steps: Array = 2 * np.pi / AROUND * unit_steps(scene)
    least, most = find_reach(scene) + steps[0] * np.array([-1.0, 1.0])
    x = least + steps[0] * np.arange(max(2, np.ceil((most - least) / steps[0]) + 1))
    phi = steps[1] * np.arange(AROUND)
    labels = label_cells(scene, np.repeat(x, len(phi)), np.tile(phi, len(x)))[:, [0, 2, 4]]
    every, which = np.unique(labels, axis=0, return_inverse=True)
    return LabelMap(float(least), steps, every, which.reshape(len(x), len(phi)))


@dataclass(frozen=True, eq=False)
class Chain:
    """Borders that are followed to their ends in motion, and one after them."""

    steps: tuple[EdgeStep, ...]  # phases along those that are followed whole
    borders: tuple[BorderEdge, ...]  # these, and the last one
    ratios: tuple[float, ...]  # speed ratios of all borders: the speed is continuous

    @classmethod
    def of(cls, border: BorderEdge) -> Chain:
        """A chain of one border."""
        return cls((), (border,), (1.0,))

    def can_enter(self, formation: Formation) -> bool:
        """Whether a formation keeps the gained contact and has no others that are new."""
        last = self.borders[-1]
        contacts, held = set(formation.contacts), set(last.formation.contacts)
        return last.gained in contacts and contacts <= {*held, last.gained}

    def extend(self, following: BorderEdge) -> Chain | None:
        """The chain with another border entered in motion; None if impossible."""
        last, gained = self.borders[-1], self.borders[-1].gained
        if not self.can_enter(following.formation):
            return None
        (v,) = last.curve.interpolate(np.array([last.curve.length]))[1]
        (heading,) = following.curve.interpolate(np.zeros(1))[1]
        continues = v * metric_weights(last.formation.scene) @ heading > 1 - 2 * BEND
        ends = (End.SMOOTH, End.IMPACT) if continues else (End.IMPACT,)
        for end in ends:
            phase = Phase(0, last.formation, Until(contact=gained), end)
            join = compute_curve_impact(phase, last.curve, following.curve)
            if join.possible and np.isfinite(join.ratio):
                return Chain(
                    (*self.steps, EdgeStep(last.formation.contacts, phase.until, end)),
                    (*self.borders, following),
                    (*self.ratios, self.ratios[-1] * join.ratio),
                )
        return None

    def link(self, step: EdgeStep, last: BorderEdge) -> Link | Blocked:
        """The link along the chain, at rest at the end of the last border or of a part of it."""
        borders, steps = (*self.borders[:-1], last), (*self.steps, step)
        return link_along(borders, self.ratios, steps, last.stop)

    def link_whole(self) -> Link | Blocked | None:
        """The link along all of it; None where the last border ends at an obstacle."""
        last = self.borders[-1]
        if last.gained is None:
            return None
        step = EdgeStep(last.formation.contacts, Until(contact=last.gained))
        return self.link(step, last)
