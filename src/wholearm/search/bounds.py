"""How much longer a plan may take than the best one along borders."""

from __future__ import annotations

import heapq
import math
from itertools import count
from typing import NamedTuple

from ..common.signals import beat
from .astar import RouteSearch
from .edges import ROUGHLY, Link
from .goals import is_at
from .places import Key, RoadmapPlace

MOST = 240  # Most places that are settled to bound routes from below


class BorderBound(NamedTuple):
    """A lower bound of what routes take that follow borders.

    Where these meet they stop, or go on at speed where the law of impacts lets them.
    """

    value: float  # [s]: no such route takes less
    # whether it is that of a route, or larger than what was asked for; otherwise more would have
    # had to be looked at
    complete: bool

    def up_to(self, enough: float) -> BorderBound:
        """What it is if no more than that is asked for [s]."""
        return self if self.value < enough else BorderBound(enough, True)


def bound_borders(search: RouteSearch, enough: float = math.inf) -> BorderBound:
    """Bound every route along borders from below, up to `enough` [s].

    Links have their bounds on a coarse grid, until those of the shortest route are all refined.
    """
    refined, known = set[Link](), dict[Key, list[Link]]()
    while True:
        found, links = _find_shortest(search, enough, refined, known)
        if refined.issuperset(links):
            return found
        refined.update(links)


def _find_shortest(
    search: RouteSearch, enough: float, refined: set[Link], known: dict[Key, list[Link]]
) -> tuple[BorderBound, tuple[Link, ...]]:
    """The shortest route along borders by bounds of its links, and these; none from `enough` on."""
    number, settled = count(), set[Key]()
    queue: list[tuple[float, int, RoadmapPlace, tuple[Link, ...]]] = [
        (0.0, next(number), search.start, ())
    ]
    while queue:
        beat()
        cost, _, place, links = heapq.heappop(queue)
        if cost >= enough:
            return BorderBound(enough, True), ()
        if is_at(place, search.goal):
            return BorderBound(cost, True), links
        if place.key in settled:
            continue
        if len(settled) >= MOST:
            return BorderBound(cost, False), ()
        settled.add(place.key)
        if place.key not in known:
            every = search.chart.list_along(place, search.goal)
            known[place.key] = [link for _, link in every if isinstance(link, Link)]
        for link in known[place.key]:
            own = link.fine_bound if link in refined else ROUGHLY * link.bound
            heapq.heappush(queue, (cost + own, next(number), link.stop, (*links, link)))
    return BorderBound(enough, True), ()
