"""The search: routes from a place to a goal, the shortest first.

Places are settled in the order of what it costs to get there and at least, by a rule of thumb, from
there on. Borders that lead on from a place are looked at when it is settled; cells, which take
longer, are put off by what motions through them cost at least, by the same rule. One rule leads
quickly to a first plan; one that expects less of what lies ahead finds others near the start.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import NamedTuple

from ..common.signals import beat
from ..problem.goal import Goal
from .chains import Chain
from .edges import Blocked, BorderEdge, Link
from .goals import is_at, measure_turn
from .places import Key, RoadmapPlace
from .roadmap import Ahead, Roadmap

CROSSING = 1.0
"""Least time of a motion through a cell from a place, by a rule of thumb, in the scene's time."""
OFTEN = 2  # How often a place is settled, on different ways
MOST = 4000  # Most entries of the queue that are looked at


class SearchRule(NamedTuple):
    """A rule of thumb for what lies ahead, in the scene's time, and how far it is followed."""

    turning: float  # time that turning by a radian takes
    leaving: float  # that of a motion through a cell from somewhere along a border
    most: int  # most places that are looked at


EAGER = SearchRule(14.0, 4.0, 130)
"""Times as routes through cells take them: it leads to a first plan soon."""
CAREFUL = SearchRule(4.0, 2.5, 16)
"""Times that hardly any route falls short of: it finds routes that set out the wrong way."""


@dataclass(frozen=True, eq=False)
class RoadmapRoute:
    """A way from a start, as links one after the other."""

    links: tuple[Link, ...]

    @property
    def duration(self) -> float:
        """About how long it takes [s]."""
        return sum(link.duration for link in self.links)

    @property
    def bound(self) -> float:
        """How long it takes at least [s], with a stop where links meet."""
        return sum(link.bound for link in self.links)

    @property
    def in_cells(self) -> bool:
        """Whether it leads through cells, which nothing bounds from below."""
        return any(link.in_cell for link in self.links)

    @property
    def signature(self) -> tuple[object, ...]:
        """By which routes differ."""
        return tuple(part for link in self.links for part in link.signature)

    @property
    def key(self) -> object:
        """What it is: its formations, and where it stops."""
        return self.signature, tuple(step.end for link in self.links for step in link.steps)


@dataclass(eq=False)
class RouteSearch:
    """Routes from a start to a goal."""

    roadmap: Roadmap
    start: RoadmapPlace
    goal: Goal
    # links that no motion can take, as they are met
    blocked: list[Blocked] = field(default_factory=list)
    # routes to places that have been settled, the first to each, by their keys
    reached: dict[Key, RoadmapRoute] = field(default_factory=dict)
    found: set[object] = field(default_factory=set)  # keys of routes that have been found
    limit: float = math.inf  # cost from which on nothing is of interest [s]
    sources: Sequence[RoadmapRoute] = ()  # ways to set out by, if not from the start itself

    @property
    def settled(self) -> int:
        """How many places have been settled."""
        return len(self.reached)

    def measure(self, place: RoadmapPlace, turning: float = 1.0) -> float:
        """About the time from a place to the goal, where turning by a radian takes that [s]."""
        return turning * self.roadmap.scene.scales.time * measure_turn(place, self.goal)

    def run(self, rule: SearchRule = EAGER) -> Iterator[RoadmapRoute]:
        """Find routes that have not been found before, about in the order of their durations."""
        time = self.roadmap.scene.scales.time
        number, queue = (
            count(),
            list[tuple[float, int, float, RoadmapRoute, RoadmapPlace, object]](),
        )
        times: Counter[object] = Counter()

        def put(route: RoadmapRoute, place: RoadmapPlace, work: object, more: float = 0.0) -> None:
            cost = route.duration
            least = cost + self.measure(place, rule.turning) + more
            heapq.heappush(queue, (least, next(number), cost, route, place, work))

        def put_along(before: tuple[Link, ...], own: Ahead) -> None:
            assert isinstance(own.link, Link)
            put(RoadmapRoute((*before, own.link)), own.link.stop, own.chain if own.whole else None)

        for way in self.sources or (RoadmapRoute(()),):
            put(way, way.links[-1].stop if way.links else self.start, None)
        for _ in range(MOST):
            if not queue:
                return
            beat()
            cost, _, _, route, place, work = heapq.heappop(queue)
            if cost > self.limit or len(times) > rule.most:
                return
            if work is None or isinstance(work, Chain):
                if route.links and is_at(place, self.goal):
                    if route.key not in self.found:
                        self.found.add(route.key)
                        yield route
                    continue
                if work is not None:
                    for own in self.roadmap.go_on(work, self.goal):
                        put_along(route.links[:-1], own)
                key = place.key
                if times[key] >= (1 if place.landed else OFTEN):
                    continue
                times[key] += 1
                self.reached.setdefault(key, route)
                for own in self._set_out(route, place):
                    if isinstance(own.link, Link):
                        put_along(route.links, own)
                    elif times[key] == 1 and own.link not in self.blocked:
                        self.blocked.append(own.link)
                if not place.landed:
                    for index, (border, _) in enumerate(self.roadmap.follow(place)):
                        if not self._is_back(route, border):
                            put(route, place, (border, index), rule.leaving * time)
                    put(route, place, "cells", CROSSING * time)
                continue
            if isinstance(work, tuple):
                border, index = work
                links = self.roadmap.release(border, index)
                links = [*links, *self.roadmap.land_at(links, self.goal)]
            else:
                links = [
                    *self.roadmap.cross_cells(place),
                    *self.roadmap.end_in_cell(place, self.goal),
                ]
                links += self.roadmap.land_at(links, self.goal)
            for link in links:
                if isinstance(link, Link):
                    put(RoadmapRoute((*route.links, link)), link.stop, None)
                elif link not in self.blocked:
                    self.blocked.append(link)

    def _set_out(self, route: RoadmapRoute, place: RoadmapPlace) -> list[Ahead]:
        """Links along borders from the end of a route, but not back."""
        return [
            own
            for own in self.roadmap.set_out(place, self.goal)
            if not self._is_back(route, own.chain.borders[0])
        ]

    @staticmethod
    def _is_back(route: RoadmapRoute, border: BorderEdge) -> bool:
        """Whether a border is the one that a route has just come along."""
        if not route.links or route.links[-1].in_cell:
            return False
        last = route.links[-1].steps[-1].contacts
        return set(last) == set(border.formation.contacts)
