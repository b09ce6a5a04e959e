"""What is known of a scene's borders and cells: followed when they are first asked for, then kept.

The graph depends on the scene and on epsilon alone, so that searches from any start to any goal
share it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.explore import close_contacts, is_inside
from ..planning.result import Plan
from ..problem.definition import End, Problem, Until
from ..problem.goal import Goal
from .cells import TIED, Crossing, cross, go_to
from .chains import LONGEST, Chain
from .goals import is_flush, list_pins, list_poses, measure_along
from .ground import Unstopped
from .links import (
    Blocked,
    Border,
    Link,
    Step,
    Terms,
    cut_curve,
    follow_borders,
    link_border,
    point_out,
    time_parts,
)
from .measure import Measured
from .places import Key, Place, list_formations_at, make_place, settle

if TYPE_CHECKING:
    from .linking import PlannedLink

RELEASES = (0.15, 0.4, 0.6, 0.75, 0.88)
"""Shares of a border at which contacts may be let go."""

NEAR = 1.0
"""How far landings are moved to where a goal is, at most, in radii of gyration."""

Found = list[Link | Blocked]


class Ahead(NamedTuple):
    """A link along borders.

    Attributes
    ----------
    chain : Chain
        The borders.
    link : Link or Blocked
    whole : bool
        Whether it follows the last one whole, so that a motion may go on from there.
    """

    chain: Chain
    link: Link | Blocked
    whole: bool


class Chart:
    """Places, borders and cells of a scene, as far as searches have looked at them.

    Parameters
    ----------
    problem : Problem
        Whose scene and epsilon it is for.
    uniqueness_margin : float
        See `PlanOptions`.

    Attributes
    ----------
    plans : dict
        Plans of routes through it, or why there are none; see `candidates`.
    others : dict
        Slower plans of these.
    joined : dict
        Plans of links from rest to rest; see `linking`.
    polished : set of Link
        Those that were planned with borders left in motion, too.
    measured : dict
        Links through cells that were planned for themselves, or why they have no plan.
    """

    def __init__(self, problem: Problem, uniqueness_margin: float) -> None:
        self.scene, self.epsilon = problem.scene, problem.epsilon
        self.terms = Terms(problem.epsilon, uniqueness_margin)
        self.polished: set[Link] = set()
        self._borders: dict[tuple[Key, tuple[Contact, ...]], list[Border]] = {}
        self._curves: dict[frozenset[Contact], list[Curve]] = {}
        self._links: dict[Key, list[tuple[Border, Link | Blocked | None]]] = {}
        self._cells: dict[Key, Found] = {}
        self.plans: dict[object, Plan | str] = {}
        self.others: dict[Link, list[Measured]] = {}
        self.joined: dict[tuple[object, ...], PlannedLink | str] = {}
        self.measured: dict[Link, Measured | str] = {}
        self._releases: dict[tuple[Key, int], Found] = {}
        self._longer: dict[tuple[Border, ...], list[tuple[Chain, Link | Blocked | None]]] = {}

    def trace(self, place: Place, chain: Chain | None = None) -> list[Border]:
        """Borders that lead on from a place; only those that a chain may enter, if one is given."""
        settled, found = settle(place) if place.landed else place, list[Border]()
        for formation in list_formations_at(settled, 4) if settled else ():
            if settled and (chain is None or chain.can_enter(formation)):
                key = place.key, formation.contacts
                if key not in self._borders:
                    known = self._curves.setdefault(frozenset(formation.contacts), [])
                    self._borders[key] = follow_borders(settled, formation, self.terms, known)
                found += self._borders[key]
        return found

    def follow(self, place: Place) -> list[tuple[Border, Link | Blocked | None]]:
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

    def pass_on(self, place: Place) -> Iterator[tuple[Chain, Link | Blocked | None]]:
        """Borders passed one after the other from a place, with the link along each whole chain."""
        waiting = [(Chain.of(border), link) for border, link in self.follow(place)]
        while waiting:
            chain, link = waiting.pop()
            if not _is_barred(link):
                longer = self.extend(chain)
                yield from longer
                waiting += longer

    def list_along(self, place: Place, goal: Goal) -> Iterator[tuple[Border, Link | Blocked]]:
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

    def set_out(self, place: Place, goal: Goal) -> Iterator[Ahead]:
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

    def cross_cells(self, place: Place) -> Found:
        """Links from rest at a place through the cells around it."""
        if place.key not in self._cells:
            ways = cross((place,), self.epsilon)
            found: Found = [self._link_cell(place, (), way, 0.0) for way in ways]
            self._cells[place.key] = found
        return self._cells[place.key]

    def release(self, border: Border, number: int) -> Found:
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
                first = Step(held, point_out(held, z[way.source]))
                link = self._link_cell(border.start, (first,), way, times[way.source])
                own = *way.contacts, way.gained
                if own not in best or link.duration < TIED * best[own].duration:
                    share = float(shares[way.source])
                    best[own] = replace(link, left=border.curve, share=share)
        self._releases[key] = list(best.values())
        return self._releases[key]

    def _link_cell(
        self, start: Place, before: tuple[Step, ...], way: Crossing, spent: float
    ) -> Link:
        steps = (*before, Step(way.contacts, Until(contact=way.gained)))
        assert way.gained is not None
        stop = Place(self.scene, way.z, (*way.contacts, way.gained), landed=True)
        return Link(start, stop, steps, spent + way.duration, True)

    def _end_chain(self, chain: Chain, goal: Goal) -> Link | Blocked | None:
        """The link along a chain to where its last border meets a goal; None if it does not."""
        last = chain.borders[-1]
        found = measure_along(last.curve, goal)
        if found is None:
            return None
        s, until = found
        cut = replace(last, curve=cut_curve(last.curve, s))
        step = Step(last.formation.contacts, until)
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
                first = [Step(own.contacts, Until(), End.SMOOTH) for own in before]
                found.append(replace(link, stop=stop, steps=(*first, step), left=None))
        return found

    def end_in_cell(self, place: Place, goal: Goal) -> Iterator[Link]:
        """Links from a place straight to a goal inside a cell around it."""
        poses = list_poses(self.scene, place.z, goal)
        if not len(poses):
            return
        for formation in list_formations_at(place, 3):
            way = go_to(place, formation, poses, self.epsilon)
            if way is not None:
                assert goal.phi is not None
                until = Until(None, "phi", goal.phi, list_pins(goal))
                steps = (Step(formation.contacts, until),)
                stop = Place(self.scene, way.z, formation.contacts, landed=True)
                yield Link(place, stop, steps, way.duration, True)


def _is_barred(link: Link | Blocked | None) -> bool:
    """Whether no motion can go on beyond a link either."""
    return isinstance(link, Blocked) and not isinstance(link.reason, Unstopped)
