"""Lower bound of the duration of all routes along borders, by Dijkstra's algorithm.

Edge costs are bounds on a coarse grid, refined until those of the shortest route all are.
"""

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
    """A lower bound of the duration of routes along borders.

    They stop where borders meet, or pass through by a plastic impact that is possible.
    """

    value: float  # [s]: no such route takes less
    # whether it is that of a route, or larger than what was asked for; otherwise more would have
    # had to be looked at
    complete: bool

    def up_to(self, enough: float) -> BorderBound:
        """The bound, at most `enough` [s]."""
        return self if self.value < enough else BorderBound(enough, True)


def bound_borders(search: RouteSearch, enough: float = math.inf) -> BorderBound:
    """Bound every route along borders from below, up to `enough` [s]."""
    refined, links_from = set[Link](), dict[Key, list[Link]]()
    while True:
        bound, links = _find_shortest(search, enough, refined, links_from)
        if refined.issuperset(links):
            return bound
        refined.update(links)


def _find_shortest(
    search: RouteSearch, enough: float, refined: set[Link], links_from: dict[Key, list[Link]]
) -> tuple[BorderBound, tuple[Link, ...]]:
    """The shortest route along borders by bounds of its links, and these; none from `enough` on."""
    order, settled = count(), set[Key]()
    queue: list[tuple[float, int, RoadmapPlace, tuple[Link, ...]]] = [
        (0.0, next(order), search.start, ())
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
        if place.key not in links_from:
            pairs = search.roadmap.list_along(place, search.goal)
            links_from[place.key] = [link for _, link in pairs if isinstance(link, Link)]
        for link in links_from[place.key]:
            bound = link.fine_bound if link in refined else ROUGHLY * link.bound
            heapq.heappush(queue, (cost + bound, next(order), link.stop, (*links, link)))
    return BorderBound(enough, True), ()
