"""Result of a search for routes, and the message where nothing leads to the goal."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

from ..common.document import Document, Result, Table
from ..common.signals import beat
from ..contacts.formation import describe
from ..planning.options import Objective
from ..planning.result import Plan
from ..problem.definition import Problem
from ..problem.table import SAME, describe_phase, write_toml
from .astar import EAGER, RoadmapRoute, RouteSearch
from .cuts import list_cut
from .edges import ROUGHLY, Blocked, Link, describe_steps
from .places import Key, RoadmapPlace, is_at
from .roadmap import LONGEST

MOST = 240  # Most places that are settled to bound routes from below
LISTED, FAILED = 2, 1  # most reasons in a message, and most of routes without a plan
NOT_CONSIDERED = (
    "not considered: rolling contacts, formations without the palm or without one of the fingers, "
    f"more than {LONGEST} borders passed without a stop, impacts out of or into cells, motions "
    "through cells that no straight way from rest shows to be possible, and what is further than "
    f"{EAGER.most} places; phases may be as many as it takes"
)


@dataclass(frozen=True, eq=False, repr=False)
class Alternative(Result):
    """A route with its plan."""

    plan: Plan

    @property
    def problem(self) -> Problem:
        """The problem with phases, the route, in place of its goals."""
        return self.plan.problem

    @property
    def headline(self) -> str:
        """Value, duration and number of phases, in a line."""
        return f"{self.plan.headline}, phases: {len(self.problem.phases)}"

    @property
    def document(self) -> Document:
        """The lines of `describe`, and the phases of the route."""
        rows = [
            (phase.number, ", ".join(phase.formation.names), str(phase.until), phase.end.value)
            for phase in self.problem.phases
        ]
        route = Table(["phase:d", "contacts", "until", "end"], rows)
        return Document("", parts=[*self.describe(), route])

    def describe(self) -> list[str]:
        """Value and duration, in lines."""
        return [f"{self.plan.value:.6f} {self.plan.unit}, {self.plan.duration:.6f} s"]

    @property
    def values(self) -> dict[str, Any]:
        """The content of JSON files."""
        phases = list(self.problem.table.get("phases", []))
        return {"value": self.plan.value, "duration": self.plan.duration, "phases": phases}


@dataclass(frozen=True, eq=False, repr=False)
class Answer(Alternative):
    """The best route that was found, with its plan."""

    route: RoadmapRoute  # to the last goal
    # lower bound of routes along borders; None with several goals or an interrupted search
    bound: BorderBound | None
    alternatives: tuple[Alternative, ...]
    failures: tuple[str, ...]  # why routes have no plan
    blocked: tuple[Blocked, ...]  # borders that no motion can follow
    settled: int  # places that were looked at
    complete: bool  # whether the search ended by itself

    @property
    def gap(self) -> float | None:
        """Relative gap of the duration to the bound.

        None without a bound, for routes through cells, and for other objectives.
        """
        timed = self.plan.options.goal is Objective.TIME
        if self.bound is None or self.bound.value <= 0 or self.route.in_cells or not timed:
            return None
        return max(0.0, self.plan.duration / self.bound.value - 1.0)

    def to_text(self) -> str:
        """The route as ``[[phases]]``, and how good it is, as comments."""
        lines = [f"# {line}" for line in self.describe()]
        lines += ["", format_phases(self.problem).rstrip()]
        for number, other in enumerate(self.alternatives, start=2):
            lines += [
                "",
                f"# alternative {number}: {other.describe()[0]}",
                *(f"# {line}".rstrip() for line in format_phases(other.problem).splitlines()),
            ]
        return "\n".join(lines).rstrip() + "\n"

    def describe(self) -> list[str]:
        """Value, bound and statistics of the search, in lines."""
        plan, count = self.plan, len(self.problem.phases)
        lines = [
            f"{count} phase{'s'[: count != 1]}, {plan.options.goal.value} = {plan.value:.6f} "
            f"{plan.unit}, {plan.duration:.6f} s in all"
        ]
        if not self.complete:
            lines.append("the search ended early: the best route so far")
        if self.bound is not None:
            text = "no route along borders, with stops or impacts, "
            # The bound is at most the duration of the plan.
            none = self.route.in_cells and self.bound.value >= plan.duration
            text += "is faster" if none else f"takes less than {self.bound.value:.6f} s"
            text += "" if self.gap is None else f": gap {100 * self.gap:.2g} %"
            ended = "" if self.bound.complete else " (the search for such routes ended early)"
            lines.append(text + ended)
        if self.route.in_cells:
            lines.append("this one leads through cells, where nothing bounds times from below")
        tried = f"{self.settled} places looked at, {len(self.blocked)} ways blocked"
        lines.append(f"{tried}, {len(self.failures)} routes without a plan")
        return [*lines, NOT_CONSIDERED]

    @property
    def values(self) -> dict[str, Any]:
        """The content of JSON files."""
        return {
            **super().values,
            "unit": self.plan.unit,
            "bound": None if self.bound is None else self.bound.value,
            "gap": self.gap,
            "complete": self.complete,
            "in_cells": self.route.in_cells,
            "alternatives": [other.values for other in self.alternatives],
            "failures": list(self.failures),
            "blocked": [f"{_describe_border(b)}: {b.reason}" for b in self.blocked],
            "not_considered": NOT_CONSIDERED,
        }


def format_phases(problem: Problem) -> str:
    """The phases of a problem as `[[phases]]` of a problem file."""
    return write_toml({"phases": [describe_phase(phase, SAME) for phase in problem.phases]})[1:]


def describe_block(
    search: RouteSearch,
    failures: Sequence[str],
    opening: str = "",
    explain: Callable[[Blocked], str] = lambda blocked: blocked.reason,
) -> str:
    """Why nothing leads to a goal: the cut, its violated limits, and the change that opens it."""
    cut, count = list_cut(search), search.settled
    text = f"nothing leads from {search.start} to {search.goal}: {count} place{'s'[: count != 1]}"
    text += f" reached, touching {describe(search.start.contacts)} at the start; "
    if not cut:
        text += "no border leads on from there, and no way through a cell"
    else:
        many = len(cut) != 1
        text += f"{len(cut)} border{'s'[:many]} lead{'s'[many:]} on from there, "
        text += "all of them blocked" if many else "and is blocked"
    # After the first part, reasons give advice on the plan.
    reasons = list(dict.fromkeys(reason.split("; ")[0] for reason in failures))[:FAILED]
    reasons += [f"{_describe_border(b)}: {explain(b)}" for b in cut[: LISTED - len(reasons)]]
    return "; ".join([text, *reasons, *([opening] if opening else [])])


def _describe_border(blocked: Blocked) -> str:
    return f"{describe_steps(blocked.steps)} from {blocked.start}"


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
            every = search.roadmap.list_along(place, search.goal)
            links_from[place.key] = [link for _, link, _ in every if isinstance(link, Link)]
        for link in links_from[place.key]:
            bound = link.fine_bound if link in refined else ROUGHLY * link.bound
            heapq.heappush(queue, (cost + bound, next(order), link.stop, (*links, link)))
    return BorderBound(enough, True), ()
