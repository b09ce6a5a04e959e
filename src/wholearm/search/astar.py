"""Best-first search (lazy A*) for routes from a place to a goal.

Links along borders are evaluated when their place is expanded; links through cells, which cost more
time, wait in the queue with a heuristic lower bound. A greedy heuristic leads to a first plan, a
more cautious one finds faster routes near the start.
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
from ..problem.definition import Goal
from .edges import Blocked, Link
from .places import Key, RoadmapPlace, is_at, measure_turn
from .roadmap import Ahead, Chain, Roadmap

CROSSING = 1.0  # heuristic least time of a motion through a cell, over the scene's time
OFTEN = 2  # expansions of one place, on different routes
MOST = 4000  # most entries that are taken from the queue


class SearchRule(NamedTuple):
    """Heuristic cost to go, in the scene's time, and a limit of the search."""

    turning: float  # per radian that is left to turn
    leaving: float  # through a cell from a place along a border
    most: int  # most places that are expanded


EAGER = SearchRule(14.0, 4.0, 130)
"""As routes through cells take: greedy, leads to a first plan soon."""
CAREFUL = SearchRule(4.0, 2.5, 16)
"""Hardly any route takes less: finds routes that start in the wrong direction."""


@dataclass(frozen=True, eq=False)
class RoadmapRoute:
    """Links one after the other."""

    links: tuple[Link, ...]

    @property
    def duration(self) -> float:
        """Estimated duration [s]."""
        return sum(link.duration for link in self.links)

    @property
    def in_cells(self) -> bool:
        """Whether it leads through cells, for which there is no lower bound."""
        return any(link.in_cell for link in self.links)

    @property
    def signature(self) -> tuple[object, ...]:
        """Names of the contacts of each phase."""
        return tuple(part for link in self.links for part in link.signature)

    @property
    def key(self) -> object:
        """Its formations, and how phases end."""
        return self.signature, tuple(step.end for link in self.links for step in link.steps)


@dataclass(eq=False)
class RouteSearch:
    """Routes from a start to a goal."""

    roadmap: Roadmap
    start: RoadmapPlace
    goal: Goal
    # blocked links, as they are met
    blocked: list[Blocked] = field(default_factory=list)
    # the first route to each expanded place, by its key
    reached: dict[Key, RoadmapRoute] = field(default_factory=dict)
    found: set[object] = field(default_factory=set)  # keys of routes that have been found
    limit: float = math.inf  # largest cost of routes [s]
    sources: Sequence[RoadmapRoute] = ()  # routes to start with, if not from the start itself

    @property
    def settled(self) -> int:
        """Number of expanded places."""
        return len(self.reached)

    def measure(self, place: RoadmapPlace, turning: float = 1.0) -> float:
        """Heuristic time from a place to the goal [s]; `turning` is that of a radian."""
        return turning * self.roadmap.scene.scales.time * measure_turn(place, self.goal)

    def run(self, rule: SearchRule = EAGER) -> Iterator[RoadmapRoute]:
        """Yield new routes, about in the order of their durations."""
        time = self.roadmap.scene.scales.time
        number, times = count(), Counter[object]()
        queue = list[tuple[float, int, float, RoadmapRoute, RoadmapPlace, object]]()

        def put(route: RoadmapRoute, place: RoadmapPlace, work: object, more: float = 0.0) -> None:
            cost = route.duration
            least = cost + self.measure(place, rule.turning) + more
            heapq.heappush(queue, (least, next(number), cost, route, place, work))

        def put_along(before: tuple[Link, ...], ahead: Ahead) -> None:
            chain, link, whole = ahead
            assert isinstance(link, Link)
            put(RoadmapRoute((*before, link)), link.stop, chain if whole else None)

        for source in self.sources or (RoadmapRoute(()),):
            put(source, source.links[-1].stop if source.links else self.start, None)
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
                    for ahead in self.roadmap.go_on(work, self.goal):
                        put_along(route.links[:-1], ahead)
                key = place.key
                if times[key] >= (1 if place.landed else OFTEN):
                    continue
                times[key] += 1
                self.reached.setdefault(key, route)
                for ahead in list(self.roadmap.set_out(place, self.goal)):
                    if self._is_back(route, ahead[0]):
                        continue
                    if isinstance(ahead[1], Link):
                        put_along(route.links, ahead)
                    elif times[key] == 1 and ahead[1] not in self.blocked:
                        self.blocked.append(ahead[1])
                if not place.landed:
                    for index, chain in enumerate(self.roadmap.follow(place)):
                        if not self._is_back(route, chain):
                            put(route, place, (chain.borders[0], index), rule.leaving * time)
                    put(route, place, "cells", CROSSING * time)
                continue
            if isinstance(work, tuple):
                links = self.roadmap.release(*work)
            else:
                links = self.roadmap.cross_cells(place)
            moved = self.roadmap.land_at(links, self.goal)
            ends = () if isinstance(work, tuple) else self.roadmap.end_in_cell(place, self.goal)
            for link in (*links, *ends, *moved):
                put(RoadmapRoute((*route.links, link)), link.stop, None)

    @staticmethod
    def _is_back(route: RoadmapRoute, chain: Chain) -> bool:
        """Whether a chain begins with the border that a route has just followed."""
        if not route.links or route.links[-1].in_cell:
            return False
        last = route.links[-1].steps[-1].contacts
        return set(last) == set(chain.borders[0].formation.contacts)
