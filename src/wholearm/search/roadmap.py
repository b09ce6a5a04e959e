"""What is known of a scene's borders and cells: followed when they are first asked for, then kept.

The graph depends on the scene and on epsilon alone, so that searches from any start to any goal
share it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers, contact_table
from ..contacts.elemental import Contact
from ..contacts.explicit import measure_gap, place
from ..contacts.explicit import place as place_at
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.explore import close_contacts, is_inside
from ..mapping.borders import NOWHERE, label_cells
from ..planning.result import Plan
from ..problem.definition import End, Problem, Until
from ..problem.goal import Goal
from ..scene.model import Scene
from .border_limits import Unstopped
from .cell_paths import MIDDLES, can_set_out, list_middles, time_ways
from .chains import LONGEST, Chain
from .edges import (
    Blocked,
    BorderEdge,
    EdgeStep,
    Link,
    Terms,
    cut_curve,
    follow_borders,
    link_border,
    point_out,
    time_parts,
)
from .feasibility import Measured
from .goals import is_flush, list_pins, list_poses, measure_along
from .places import Key, RoadmapPlace, list_formations_at, make_place, settle, unit_steps

if TYPE_CHECKING:
    from .edge_plans import PlannedLink


AROUND = 64
"""Places of the grid around a turn; as far apart in x, in radii of gyration, as they are in phi."""
HEADINGS = 36  # Ways in which motions may set out from a place
SPACING, REACH = 2 * np.pi / AROUND, 3.0
"""Distance of places looked at along a ray, and its length, in radii of gyration and radians."""
FIRST = 0.02  # Where a ray has to be inside a cell, in the same unit; no way is shorter
OUTSIDE = 4  # At how many places of a ray outside of its cell contacts that come into view count
CLOSER = 0.05  # Distance of places at which a gap is evaluated, around where a contact is gained
AROUND_END = 6  # How many of these there are before and after
BESIDE = 4e-4  # How far before and after a border what touches is looked up
NEAREST = 0.02  # Length of the shortest way to a pose, in radii of gyration or radians
TIED = 1 - 1e-9
"""Part of another time below which a time is less: of mirrored ways the first is the fastest."""
RELEASES = (0.15, 0.4, 0.6, 0.75, 0.88)  # Shares of a border at which contacts may be let go
NEAR = 1.0  # How far landings are moved to where a goal is, at most, in radii of gyration
Found = list[Link | Blocked]


class Ahead(NamedTuple):
    """A link along borders."""

    chain: Chain  # the borders
    link: Link | Blocked
    whole: bool  # whether it follows the last one whole, so that a motion may go on from there


class Roadmap:
    """Places, borders and cells of a scene, as far as searches have looked at them.

    Parameters
    ----------
    problem            whose scene and epsilon it is for
    uniqueness_margin  see `PlanOptions`

    Attributes
    ----------
    plans     plans of routes through it, or why there are none; see `candidates`
    others    slower plans of these
    joined    plans of links from rest to rest; see `linking`
    refined   links whose place on the border has been optimized
    measured  links through cells that were planned for themselves, or why they have no plan
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
        """Borders that lead on from a place; only those that a chain may enter, if one is given."""
        settled, found = settle(place) if place.landed else place, list[BorderEdge]()
        for formation in list_formations_at(settled, 4) if settled else ():
            if settled and (chain is None or chain.can_enter(formation)):
                key = place.key, formation.contacts
                if key not in self._borders:
                    known = self._curves.setdefault(frozenset(formation.contacts), [])
                    self._borders[key] = follow_borders(settled, formation, self.terms, known)
                found += self._borders[key]
        return found

    def follow(self, place: RoadmapPlace) -> list[tuple[BorderEdge, Link | Blocked | None]]:
        """Borders that lead on from a place, with the link along the whole of each."""
        key = place.key
        if key not in self._links:
            self._links[key] = [(border, link_border(border)) for border in self.trace(place)]
        return self._links[key]

    def extend(self, chain: Chain) -> list[tuple[Chain, Link | Blocked | None]]:
        """Chains with one more border that is passed into in motion, with the link along each."""
        key, last = chain.borders, chain.borders[-1]
        if last.gained is None or len(key) == LONGEST:
            return []
        if key not in self._longer:
            longer = [chain.extend(border) for border in self.trace(last.stop, chain)]
            self._longer[key] = [(own, own.link_whole()) for own in longer if own]
        return self._longer[key]

    def pass_on(self, place: RoadmapPlace) -> Iterator[tuple[Chain, Link | Blocked | None]]:
        """Borders passed one after the other from a place, with the link along each whole chain."""
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
        """Links along borders from a place to where these end or a goal is, with the first border.

        Where borders are passed in motion, only those that a motion can take.
        """
        for border, link in self.follow(place):
            for own in (link, self._end_chain(Chain.of(border), goal)):
                if own is not None:
                    yield border, own
        for chain, link in self.pass_on(place):
            for own in (link, self._end_chain(chain, goal)):
                if isinstance(own, Link):
                    yield chain.borders[0], own

    def set_out(self, place: RoadmapPlace, goal: Goal) -> Iterator[Ahead]:
        """Links along borders from a place; along more than one only where no stop is possible."""
        for border, link in self.follow(place):
            yield from self._list_ends(Chain.of(border), link, goal)

    def go_on(self, chain: Chain, goal: Goal) -> Iterator[Ahead]:
        """Links that pass the end of a chain in motion; along two more borders as in `set_out`."""
        for longer, link in self.extend(chain):
            for own in self._list_ends(longer, link, goal):
                if isinstance(own.link, Link):
                    yield own

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
            ways = cross((place,), self.epsilon)
            found: Found = [self._link_cell(place, (), way, 0.0) for way in ways]
            self._cells[place.key] = found
        return self._cells[place.key]

    def release(self, border: BorderEdge, number: int) -> Found:
        """Links that leave a border for a cell, somewhere on the way along it."""
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
            for way in cross([replace(middle, z=row) for row in z], self.epsilon):
                first = EdgeStep(held, point_out(held, z[way.source]))
                link = self._link_cell(border.start, (first,), way, times[way.source])
                own = *way.contacts, way.gained
                if own not in best or link.duration < TIED * best[own].duration:
                    share = float(shares[way.source])
                    best[own] = replace(link, left=border.curve, share=share)
        self._releases[key] = list(best.values())
        return self._releases[key]

    def _link_cell(
        self, start: RoadmapPlace, before: tuple[EdgeStep, ...], way: CellCrossing, spent: float
    ) -> Link:
        steps = (*before, EdgeStep(way.contacts, Until(contact=way.gained)))
        assert way.gained is not None
        stop = RoadmapPlace(self.scene, way.z, (*way.contacts, way.gained), landed=True)
        return Link(start, stop, steps, spent + way.duration, True)

    def _end_chain(self, chain: Chain, goal: Goal) -> Link | Blocked | None:
        """The link along a chain to where its last border meets a goal; None if it does not."""
        last = chain.borders[-1]
        found = measure_along(last.curve, goal)
        if found is None:
            return None
        s, until = found
        cut = replace(last, curve=cut_curve(last.curve, s))
        step = EdgeStep(last.formation.contacts, until)
        return chain.link(step, cut)

    def land_at(self, links: Found, goal: Goal) -> list[Link]:
        """Links that land on the edge of a goal which gives x, as they land right there.

        About as long as where they land otherwise; whether they can is for the planner to say. A
        border before is left in motion: from rest at one place few others can be reached.
        """
        landings = [own for own in links if isinstance(own, Link) and own.in_cell]
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
                first = [EdgeStep(own.contacts, Until(), End.SMOOTH) for own in before]
                found.append(replace(link, stop=stop, steps=(*first, step), left=None))
        return found

    def end_in_cell(self, place: RoadmapPlace, goal: Goal) -> Iterator[Link]:
        """Links from a place straight to a goal inside a cell around it."""
        poses = list_poses(self.scene, place.z, goal)
        if not len(poses):
            return
        for formation in list_formations_at(place, 3):
            way = go_to(place, formation, poses, self.epsilon)
            if way is not None:
                assert goal.phi is not None
                until = Until(None, "phi", goal.phi, list_pins(goal))
                steps = (EdgeStep(formation.contacts, until),)
                stop = RoadmapPlace(self.scene, way.z, formation.contacts, landed=True)
                yield Link(place, stop, steps, way.duration, True)


def _is_barred(link: Link | Blocked | None) -> bool:
    """Whether no motion can go on beyond a link either."""
    return isinstance(link, Blocked) and not isinstance(link.reason, Unstopped)


class CellCrossing(NamedTuple):
    """A straight way through a cell."""

    source: int  # which of the places it starts from
    contacts: tuple[Contact, ...]  # what touches on the way
    gained: Contact | None  # what is gained at its end; None where it ends at a pose that was given
    z: Array  # (5,): its end
    duration: float  # [s]


def cross(places: Sequence[RoadmapPlace], epsilon: float) -> list[CellCrossing]:
    """The fastest straight way through each cell to each contact, from each of some places.

    Parameters
    ----------
    places         of one scene
    epsilon : [N]
    """
    scene = places[0].scene
    rays = shoot(places, epsilon)
    times = time_ways(scene, epsilon, rays.labels, rays.starts, rays.ends)
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
    """The fastest straight way from a place to one of some poses (x, phi) inside a cell."""
    scene = start.scene
    index = {contact: k for k, contact in enumerate(contact_table(scene))}
    own = np.array([index[contact] for contact in formation.contacts])
    begin = np.broadcast_to(start.z[[0, 2]], poses.shape)
    middles = list_middles(begin, poses)
    places = np.concatenate([middles, poses[:, None]], axis=1)
    labels = label_cells(scene, *places.reshape(-1, 2).T)[:, [0, 2, 4]]
    inside = (labels == own).all(axis=1).reshape(places.shape[:2]).all(axis=1)
    inside &= np.abs((poses - begin) / unit_steps(scene)).max(axis=1) > NEAREST
    if not inside.any():
        return None
    ends = poses[inside]
    labels = np.broadcast_to(own, (len(ends), 3))
    times = time_ways(scene, epsilon, labels, begin[inside], ends)
    k = int(times.argmin())
    if not np.isfinite(times[k]):
        return None
    (z,) = place_at(scene, labels[:1], ends[k : k + 1])
    return CellCrossing(0, formation.contacts, None, z, float(times[k]))


class Rays(NamedTuple):
    """Straight ways through cells, up to where contacts are gained."""

    sources: Numbers  # (n,): which places they start from
    labels: Numbers  # (n, 3): what touches along them: indices into `closing.contact_table`
    gained: Numbers  # (n,)
    starts: Array  # starts, ends (n, 2) [m, rad]: poses (x, phi)
    ends: Array

    def pick(self, kept: Flags | Numbers) -> Rays:
        """Some of the rays."""
        of_starts = self.sources[kept], self.labels[kept], self.gained[kept]
        return Rays(*of_starts, self.starts[kept], self.ends[kept])

    @property
    def ways(self) -> Array:
        """From starts to ends, shape (n, 2)."""
        return self.ends - self.starts


def shoot(places: Sequence[RoadmapPlace], epsilon: float) -> Rays:
    """Rays from places of one scene along which a motion can set out and that gain a contact."""
    scene = places[0].scene
    cells, held = _list_cells(places)
    angles = 2 * np.pi * (np.arange(HEADINGS) + 0.5) / HEADINGS
    ways = np.column_stack([np.cos(angles), np.sin(angles)]) * unit_steps(scene)
    sources = np.repeat(np.arange(len(places)), HEADINGS)
    starts = np.array([place.z[[0, 2]] for place in places])[sources]
    ways = np.tile(ways, (len(places), 1))
    labels = label_cells(scene, *(starts + FIRST * ways).T)[:, [0, 2, 4]]
    kept = (labels[:, None] == cells[sources]).all(axis=2).any(axis=1)
    rays = Rays(sources, labels, labels[:, 0], starts, starts + ways).pick(kept)
    ray, gained, about = _look_ahead(scene, rays, held)
    used, ray = np.unique(ray, return_inverse=True)
    rays = rays.pick(used)
    if not len(used):
        return rays
    kept = can_set_out(scene, epsilon, rays.labels, rays.starts, rays.ways)[ray]
    return _end(scene, rays.pick(ray[kept])._replace(gained=gained[kept]), about[kept])


def _list_cells(places: Sequence[RoadmapPlace]) -> tuple[Numbers, Numbers]:
    """Labels of the cells around places, (n, f, 3), and all that touches there, shape (n, c)."""
    index = {contact: k for k, contact in enumerate(contact_table(places[0].scene))}
    cells = [[cell.contacts for cell in list_formations_at(own, 3)] for own in places]
    labels = np.full((len(places), max(map(len, cells)), 3), NOWHERE - 1)
    held = np.full((len(places), max(len(own.contacts) for own in places)), NOWHERE - 1)
    for k, own in enumerate(places):
        for row, contacts in enumerate(cells[k]):
            labels[k, row] = [index[contact] for contact in contacts]
        held[k, : len(own.contacts)] = [index[contact] for contact in own.contacts]
    return labels, held


def _look_ahead(scene: Scene, rays: Rays, held: Numbers) -> tuple[Numbers, Numbers, Array]:
    """Contacts that rays may gain: which rays, the contacts, and about where [-], shape (k,).

    As the nearest place of the grid may be in another cell, contacts that come into view at the
    first few places outside of the ray's cell all count.
    """
    grid = map_labels(scene)
    away = SPACING * np.arange(1, round(REACH / SPACING))
    seen = grid.look_up(rays.starts[:, None] + away[:, None] * rays.ways[:, None])
    # What a label says is the same for all rays from a place into a cell.
    cell = np.column_stack([rays.sources, rays.labels])
    cell, group = np.unique(cell, axis=0, return_inverse=True)
    own, beside = cell[:, None, 1:], held[cell[:, 0], None, None]
    other = (grid.labels != own) & ~(grid.labels[:, :, None] == beside).any(axis=3)
    new = other & ~_list_renamed(scene)[grid.labels, own] & (grid.labels != NOWHERE)
    outside = other.any(axis=2)[group[:, None], seen]
    outside &= outside.cumsum(axis=1) <= OUTSIDE
    ray, step = np.nonzero(outside)
    entry, part = np.nonzero(new[group[ray], seen[ray, step]])
    ray, step = ray[entry], step[entry]
    gained = grid.labels[seen[ray, step], part]
    _, once = np.unique(ray * len(contact_table(scene)) + gained, return_index=True)
    return ray[once], gained[once], np.asarray(away[step[once]])


def _end(scene: Scene, rays: Rays, about: Array) -> Rays:
    """Rays that end right before what they gain touches, near where it is about to."""
    places = np.maximum(about - CLOSER * AROUND_END, 0.0)[:, None]
    end = _find_root(scene, rays, places + CLOSER * np.arange(2 * AROUND_END + 1))
    kept = end > FIRST + BESIDE
    rays, end = rays.pick(kept), end[kept, None]
    before, after = (rays.starts + (end + aside) * rays.ways for aside in (-BESIDE / 2, BESIDE / 2))
    rays = rays._replace(ends=before)
    return rays.pick(_is_inside(scene, rays, end, after))


def _find_root(scene: Scene, rays: Rays, places: Array) -> Array:
    """Where what rays gain first touches, near some places (n, m) [-]; NaN where it does not."""
    gaps, rows = _measure_gaps(scene, rays, places), np.arange(len(places))
    with np.errstate(invalid="ignore"):
        falls = (gaps[:, :-1] > 0) & (gaps[:, 1:] <= 0)
    first = falls.argmax(axis=1)
    near = np.clip(first - 1, 0, places.shape[1] - 4)[:, None] + np.arange(4)
    around = first[:, None] + np.arange(2)
    left, right = np.take_along_axis(places, around, 1).T
    own, values = (np.take_along_axis(part, near, 1) for part in (places, gaps))
    inner = _interpolate(own, values, left, right)
    inner_gap = _measure_gaps(scene, rays, inner[:, None])[:, 0]
    own = np.column_stack([left, inner, right])
    values = np.insert(np.take_along_axis(gaps, around, 1), 1, inner_gap, axis=1)
    left, right = np.where(inner_gap > 0, (inner, right), (left, inner))
    root = _interpolate(own, values, left, right)
    return np.where(falls[rows, first], root, np.nan)


def _measure_gaps(scene: Scene, rays: Rays, places: Array) -> Array:
    """Gaps [m] of what rays gain, with their cells' contacts closed, at places (n, m) [-]."""
    poses = rays.starts[:, None] + places[..., None] * rays.ways[:, None]
    each = np.repeat(np.arange(len(places)), places.shape[1])
    z = place(scene, rays.labels[each], poses.reshape(-1, 2))
    return measure_gap(scene, rays.gained[each], z).reshape(places.shape)


def _interpolate(s: Array, f: Array, left: Array, right: Array) -> Array:
    """Zeros of the inverse polynomials of values (n, m); the middle if they are not in between."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = f[:, None, :] / (f[:, None, :] - f[:, :, None])
        ratios[:, np.arange(s.shape[1]), np.arange(s.shape[1])] = 1.0
        root = (s * ratios.prod(axis=2)).sum(axis=1)
        return np.asarray(np.where((root >= left) & (root <= right), root, (left + right) / 2))


def _is_inside(scene: Scene, rays: Rays, end: Array, after: Array) -> Flags:
    """Whether rays are in their cells up to their ends, and gain what they should right after.

    Next to their ends, which are looked at closely, nothing else is looked for.
    """
    every, grid = np.arange(len(after)), map_labels(scene)
    poses = list_middles(rays.starts, rays.ends)
    away = end * np.minimum(MIDDLES, 1 - MIDDLES)
    unsure = grid.look_up(poses) != grid.find(rays.labels)[:, None]
    row, step = np.nonzero(unsure & (away > SPACING / 2))
    rows = np.concatenate([row, every, every])
    expected = rays.labels[rows]
    part = _list_parts(scene)[rays.gained]
    expected[len(rows) - len(after) + every, part] = rays.gained
    poses = np.concatenate([poses[row, step], rays.ends, after])
    wrong = (label_cells(scene, *poses.T)[:, [0, 2, 4]] != expected).any(axis=1)
    return np.asarray(np.bincount(rows, wrong, len(after)) == 0)


@lru_cache(maxsize=8)
def _list_parts(scene: Scene) -> Numbers:
    """0, 1, 2 for contacts with palm, finger 1 and finger 2, for all of `contact_table`."""
    return np.array([0 if c.finger is None else 1 + c.finger for c in contact_table(scene)])


@lru_cache(maxsize=8)
def _list_renamed(scene: Scene) -> Flags:
    """Whether one contact is another one that has changed its name, for all of `contact_table`."""
    table = contact_table(scene)
    return np.array([[_is_renamed(own, other) for other in table] for own in table])


def _is_renamed(contact: Contact, held: Contact) -> bool:
    """Whether one contact is another one that has changed its name, with no edge lying flush."""
    if contact.finger != held.finger or contact.finger is None:
        return False
    return "tip" in (contact.surface, held.surface) and (
        contact.surface == held.surface or contact.feature == held.feature
    )


class LabelMap(NamedTuple):
    """Labels on a grid of poses."""

    least: float  # [m]: least x
    steps: Array  # (2,) [m, rad]: distances of places in x and phi
    # (n, 3): every label that there is: indices of the contacts with palm and fingers, or
    # `borders.NOWHERE` where a finger cannot close
    labels: Numbers
    which: Numbers  # (n_x, AROUND): which of these is where. phi starts from zero.

    def look_up(self, poses: Array) -> Numbers:
        """Which label the nearest places of the grid have, shape (...), for poses (..., 2)."""
        row = np.rint((poses[..., 0] - self.least) / self.steps[0]).astype(np.int64)
        column = np.rint(poses[..., 1] / self.steps[1]).astype(np.int64)
        # The first and the last row are beyond the reach of a finger.
        return np.asarray(self.which[np.clip(row, 0, len(self.which) - 1), column % AROUND])

    def find(self, labels: Numbers) -> Numbers:
        """Which of the labels some are, shape (m,); -1 for those that are nowhere on the grid."""
        same = (labels[:, None] == self.labels).all(axis=2)
        return np.where(same.any(axis=1), same.argmax(axis=1), -1)


@lru_cache(maxsize=16)
def map_labels(scene: Scene) -> LabelMap:
    """Labels wherever both fingers reach the object."""
    steps: Array = 2 * np.pi / AROUND * unit_steps(scene)
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    bases = np.array([np.asarray(link.base)[0] for link in scene.fingers])
    reach = np.array([link.length + link.radius + size for link in scene.fingers])
    least, most = (bases - reach).max() - steps[0], (bases + reach).min() + steps[0]
    x = least + steps[0] * np.arange(max(2, np.ceil((most - least) / steps[0]) + 1))
    phi = steps[1] * np.arange(AROUND)
    labels = label_cells(scene, np.repeat(x, len(phi)), np.tile(phi, len(x)))[:, [0, 2, 4]]
    every, which = np.unique(labels, axis=0, return_inverse=True)
    return LabelMap(float(least), steps, every, which.reshape(len(x), len(phi)))
