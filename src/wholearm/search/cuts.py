"""Borders that shut a search off from its goal, and the changes of single numbers that open them.

Numbers of the hand and epsilon leave the geometry as it is: a border is looked at anew along the
same curve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ..common.shortfalls import Change, Parameter
from ..mechanics.limits import EPSILON, make_limits
from ..planning.advice import bracket
from ..planning.path_domain.path_explain import change_curve, list_frictions
from .astar import RoadmapRoute, RouteSearch
from .edges import Blocked, BorderEdge, Link, cut_curve, link_along
from .goals import measure_along

CUT = 16  # Most borders that are looked at with other numbers, those nearest to the goal
FARTHEST = 10.0  # Most times that a number is made larger or smaller; friction may go to zero
HALVINGS = 6  # How often what is between such a number and the given one is halved


class Gate(NamedTuple):
    """A border that no motion can follow, out of what a search has reached."""

    blocked: Blocked
    border: BorderEdge  # as far as it is to be followed


class Opening(NamedTuple):
    """What values of a number open borders."""

    parameter: Parameter
    # for each of some borders the value with which it can be followed, NaN where there is none
    values: tuple[float, ...]

    def open_all(self, among: Sequence[int] | None = None) -> Change:
        """The least change with which all borders that it opens, or some of them, are open."""
        chosen = self.values if among is None else [self.values[k] for k in among]
        known = [value for value in chosen if not math.isnan(value)]
        return Change(self.parameter, max(known) if self.parameter.sign > 0 else min(known))

    def list_open(self, change: Change) -> list[int]:
        """Numbers of the borders that a change opens."""
        sign = self.parameter.sign
        return [k for k, own in enumerate(self.values) if sign * (change.value - own) >= 0]


def list_cut(search: RouteSearch) -> list[Blocked]:
    """Borders that lead out of all that is reached, those that end nearest to the goal first.

    Every route along borders takes one of them.
    """
    cut = {
        (own.start.key, own.steps): own
        for own in search.blocked
        if own.stop.key not in search.reached
    }

    def rank(own: Blocked) -> tuple[float, ...]:
        # Along a flush edge nothing turns but by rounding, and x says which end is nearer.
        turns = (round(search.measure(place), 9) for place in (own.stop, own.start))
        x = search.goal.x
        return *turns, 0.0 if x is None else abs(float(own.stop.z[0]) - x)

    return sorted(cut.values(), key=rank)


def list_gates(search: RouteSearch, most: int = CUT) -> list[Gate]:
    """Borders of the cut, the nearest to the goal first."""
    gates = list[Gate]()
    for own in list_cut(search):
        border = _find_border(search, own)
        if border is not None and len(gates) < most:
            gates.append(Gate(own, border))
    return gates


def _find_border(search: RouteSearch, blocked: Blocked) -> BorderEdge | None:
    for border, link in search.chart.follow(blocked.start):
        if link is blocked:
            return border
        if set(border.formation.contacts) == set(blocked.steps[-1].contacts):
            found = measure_along(border.curve, search.goal)
            if found is not None and found[1] == blocked.steps[-1].until:
                return replace(border, curve=cut_curve(border.curve, found[0]))
    return None


def list_openings(gates: Sequence[Gate]) -> list[Opening]:
    """Numbers that open any of some borders, those first that open what is nearest to the goal."""
    found: dict[str, tuple[Parameter, list[float]]] = {}
    for index, gate in enumerate(gates):
        formation, epsilon = gate.border.formation, gate.border.terms.epsilon
        for own in (*make_limits(formation, epsilon).parameters, *list_frictions(formation)):
            friction = own.key.startswith("friction")
            farthest = 0.0 if friction else own.value * FARTHEST**own.sign

            def opens(value: float, own: Parameter = own, gate: Gate = gate) -> bool:
                return isinstance(look_through(gate, Change(own, value)), Link)

            value = bracket(own, farthest, opens, HALVINGS)
            if value is not None:
                _, values = found.setdefault(own.key, (own, [math.nan] * len(gates)))
                values[index] = value
    openings = [Opening(own, tuple(values)) for own, values in found.values()]

    def rank(own: Opening) -> tuple[int, float]:
        first = next(k for k, value in enumerate(own.values) if not math.isnan(value))
        return first, abs(own.values[first] / own.parameter.value - 1)

    return sorted(openings, key=rank)


def look_through(gate: Gate, change: Change) -> Link | Blocked:
    """The link along a border with a change, or why no motion follows it."""
    own, border, key = gate.blocked, gate.border, change.parameter.key
    if key == EPSILON:
        border = replace(border, terms=border.terms._replace(epsilon=change.value))
    else:
        border = replace(border, curve=change_curve(border.curve, key, change.value))
    stop = replace(own.stop, scene=border.formation.scene)
    return link_along((border,), (1.0,), own.steps, stop)


def pass_gate(search: RouteSearch, gate: Gate, change: Change) -> RoadmapRoute | None:
    """The way by which a border was reached, and on along it, with a change that opens it."""
    before, link = search.reached.get(gate.blocked.start.key), look_through(gate, change)
    if before is None or not isinstance(link, Link):
        return None
    return RoadmapRoute((*before.links, link))
