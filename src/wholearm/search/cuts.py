"""Cut of the roadmap between reached places and goal, and changes of single numbers that open it.

Limits of the hand, friction and epsilon do not change the geometry: the curve of a border is kept.
The smallest opening change is bracketed by bisection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ..common.errors import Change, Parameter
from ..mechanics.limits import EPSILON, make_limits
from ..planning.explain import bracket, change_curve, list_frictions
from .astar import RoadmapRoute, RouteSearch
from .edges import Blocked, BorderEdge, Link, cut_curve, link_along
from .places import measure_along

CUT = 16  # Most borders that are looked at with other numbers, those nearest to the goal
FARTHEST = 10.0  # Most times that a number is made larger or smaller; friction may go to zero
HALVINGS = 6  # How often what is between such a number and the given one is halved


class CutBorder(NamedTuple):
    """A blocked border that leaves the reached part of the roadmap."""

    blocked: Blocked
    border: BorderEdge  # as far as it is to be followed


class Opening(NamedTuple):
    """Values of a number that open borders."""

    parameter: Parameter
    # for each of some borders the value with which it can be followed, NaN where there is none
    values: tuple[float, ...]

    def open_all(self, among: Sequence[int] | None = None) -> Change:
        """The least change that opens all borders, or some, which the number can open."""
        chosen = self.values if among is None else [self.values[k] for k in among]
        values = [value for value in chosen if not math.isnan(value)]
        return Change(self.parameter, max(values) if self.parameter.sign > 0 else min(values))

    def list_open(self, change: Change) -> list[int]:
        """Numbers of the borders that a change opens."""
        sign = self.parameter.sign
        return [k for k, value in enumerate(self.values) if sign * (change.value - value) >= 0]


def list_cut(search: RouteSearch) -> list[Blocked]:
    """Blocked borders out of the reached places, the nearest to the goal first.

    Every route along borders takes one of them.
    """
    cut = {
        (blocked.start.key, blocked.steps): blocked
        for blocked in search.blocked
        if blocked.stop.key not in search.reached
    }

    def rank(blocked: Blocked) -> tuple[float, ...]:
        # Along a flush edge nothing turns but by rounding, and x says which end is nearer.
        turns = (round(search.measure(place), 9) for place in (blocked.stop, blocked.start))
        x = search.goal.x
        return *turns, 0.0 if x is None else abs(float(blocked.stop.z[0]) - x)

    return sorted(cut.values(), key=rank)


def list_cut_borders(search: RouteSearch) -> list[CutBorder]:
    """At most `CUT` borders of the cut, the nearest to the goal first."""
    found = list[CutBorder]()
    for blocked in list_cut(search):
        for chain in search.roadmap.follow(blocked.start):
            border = chain.borders[0]
            if chain.link is blocked:
                found.append(CutBorder(blocked, border))
                break
            if set(border.formation.contacts) == set(blocked.steps[-1].contacts):
                goal = measure_along(border.curve, search.goal)
                if goal is not None and goal[1] == blocked.steps[-1].until:
                    part = replace(border, curve=cut_curve(border.curve, goal[0]))
                    found.append(CutBorder(blocked, part))
                    break
        if len(found) == CUT:
            break
    return found


def list_openings(cuts: Sequence[CutBorder]) -> list[Opening]:
    """Numbers that open some border, ordered by the nearest border that they open."""
    found: dict[str, tuple[Parameter, list[float]]] = {}
    for index, cut in enumerate(cuts):
        formation, epsilon = cut.border.formation, cut.border.terms.epsilon
        for number in (*make_limits(formation, epsilon).parameters, *list_frictions(formation)):
            friction = number.key.startswith("friction")
            farthest = 0.0 if friction else number.value * FARTHEST**number.sign

            def opens(value: float, number: Parameter = number, cut: CutBorder = cut) -> bool:
                return isinstance(link_changed(cut, Change(number, value)), Link)

            value = bracket(number, farthest, opens, HALVINGS)
            if value is not None:
                _, values = found.setdefault(number.key, (number, [math.nan] * len(cuts)))
                values[index] = value
    openings = [Opening(number, tuple(values)) for number, values in found.values()]

    def rank(opening: Opening) -> tuple[int, float]:
        first = next(k for k, value in enumerate(opening.values) if not math.isnan(value))
        return first, abs(opening.values[first] / opening.parameter.value - 1)

    return sorted(openings, key=rank)


def link_changed(cut: CutBorder, change: Change) -> Link | Blocked:
    """The link along a border of the changed problem, or why no motion follows it."""
    blocked, border, key = cut.blocked, cut.border, change.parameter.key
    if key == EPSILON:
        border = replace(border, terms=border.terms._replace(epsilon=change.value))
    else:
        border = replace(border, curve=change_curve(border.curve, key, change.value))
    stop = replace(blocked.stop, scene=border.formation.scene)
    return link_along((border,), (1.0,), blocked.steps, stop)


def pass_cut(search: RouteSearch, cut: CutBorder, change: Change) -> RoadmapRoute | None:
    """The route to a cut border and along it in the changed problem; None if it stays blocked."""
    before, link = search.reached.get(cut.blocked.start.key), link_changed(cut, change)
    if before is None or not isinstance(link, Link):
        return None
    return RoadmapRoute((*before.links, link))
