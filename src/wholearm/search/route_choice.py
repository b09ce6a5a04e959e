"""Which of the routes that a search finds are planned: those first that seem best."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from ..planning.options import Objective, PlanOptions
from ..planning.rate_limits import free_torques
from ..planning.result import Plan
from ..problem.definition import Problem
from .astar import CAREFUL, EAGER, RoadmapRoute, RouteSearch, SearchRule
from .bounds import BorderBound, bound_borders
from .candidates import FailedCandidate, Lost, plan_phases
from .edge_plans import Aside, can_join, join_route
from .edges import Link, describe_steps
from .feasibility import Measured
from .refinement import Polisher

FASTER = 0.7
"""Share of the time of straight ways through cells that plans take at least, by experience."""
TRIED = 6  # Most routes that are looked at, or planned in vain, beyond those that are asked for
OTHERS = 2
"""Most slower ways through a cell that are tried where the plan of the fastest does not hold."""
BEYOND = 1.1
"""Times of routes, by the search, over that of the best one, from which on they are left out."""
NEARBY = 30  # Most places that are looked at in a glance
MEASURED, MORE = 24, 8
"""Most links through cells that are planned for themselves, until there is a route and after it."""


class Chooser:
    """Routes of a search, and plans of those that seem best.

    Parameters
    ----------
    before   to the goals before
    jobs     most processes at the same time
    hurried  whether any plan will do: routes are planned as they are found

    Attributes
    ----------
    found     whose ways through cells have plans
    made
    failures
    """

    def __init__(
        self,
        problem: Problem,
        before: list[RoadmapRoute],
        search: RouteSearch,
        options: PlanOptions,
        jobs: int = 1,
        hurried: bool = False,
    ) -> None:
        self.hurried = hurried
        self.problem, self.before, self.search = problem, before, search
        self.options, self.chart, self.jobs = options, search.chart, jobs
        self.found: list[RoadmapRoute] = []
        self.made: list[tuple[Plan, RoadmapRoute]] = []
        self.failures: list[FailedCandidate] = []
        self._polisher = Polisher(problem, search.chart, options, jobs)
        self._measurements = 0
        self._bound: tuple[float, Aside[BorderBound]] | None = None
        self._lost: list[tuple[Link, ...]] = []

    def run(self, wanted: int, report: Callable[[str], None]) -> None:
        """Look for routes and plan them, for as long as there are fewer than `wanted` plans."""
        for _ in range(TRIED):
            failed = len(self.failures)
            self._look_by(EAGER, wanted, report)
            # Without a route by then, the other rule leads elsewhere, and as far.
            most = CAREFUL.most if self.found else EAGER.most
            self._look_by(CAREFUL._replace(most=most), wanted, report)
            self.plan(wanted, report)
            if len(self.made) >= wanted or len(self.failures) == failed:
                return
            # What had no plan bounds nothing.
            self.search.limit = math.inf

    def glance(self, report: Callable[[str], None], most: int = NEARBY) -> RoadmapRoute | None:
        """Look for any route over few places whose ways through cells have plans."""
        self._look_by(EAGER._replace(most=most), 1, report)
        return self.found[0] if self.found else None

    def plan(self, wanted: int, report: Callable[[str], None]) -> None:
        """Plan the routes that are found, the best first, until there are as many as wanted."""
        for route in sorted(self.found, key=self.estimate):
            if len(self.made) >= wanted or len(self.failures) >= TRIED:
                return
            if self._is_lost(route):
                self.found.remove(route)
                continue
            if not self.hurried:
                self._polisher.polish(route, report)
            report(f"planning a route of {sum(len(own.steps) for own in route.links)} phases")
            plan = self._plan(route, report)
            # An interrupted one is still there, to be planned then.
            self.found.remove(route)
            if isinstance(plan, str):
                self.failures.append(FailedCandidate(route, plan))
                if isinstance(plan, Lost):
                    self._lost.append(plan.links)
            else:
                self.made.append((plan, route))

    def _plan(self, route: RoadmapRoute, report: Callable[[str], None]) -> Plan | str:
        """The plan of a route: what its links make or, of another kind, where these land."""
        problem, options, ways = self.problem, self.options, self._list_ways
        joins = can_join(problem, options)
        if not joins:
            options = replace(options, objective=Objective.TIME, duration=None, replay=False)
            problem, options = free_torques(problem, options)
        if problem is not self.problem:
            # What was begun of them is of other motors.
            ways = self._list_unbegun
        links = [(own, ways(own)) for part in (*self.before, route) for own in part.links]
        given = options, self.chart.joined, report, self.jobs, self._bound_aside(route)
        joined = join_route(problem, links, *given)
        if joins or isinstance(joined, str):
            return joined
        own = replace(self.problem, phases=joined.problem.phases, goals=())
        return plan_phases(own, self.options, self.chart.plans)

    def _bound_aside(self, route: RoadmapRoute) -> Aside[BorderBound] | None:
        """A bound of routes along borders, up to more than a plan of a route will take."""
        if self.jobs == 1 or self.before or self._bound is not None:
            return None
        enough = BEYOND * self.estimate(route)
        self._bound = enough, Aside(partial(bound_borders, self.search, enough))
        return self._bound[1]

    def bound(self, duration: float, in_cells: bool) -> BorderBound:
        """Bound every route along borders from below; beside one `in_cells`, up to its duration."""
        enough, aside = self._bound or (0.0, None)
        known = aside.result if aside else None
        wanted = duration if in_cells else math.inf
        if known is None or min(enough, wanted) <= known.value < wanted:
            return bound_borders(self.search, wanted)
        return known.up_to(wanted)

    def _list_ways(self, link: Link) -> list[Measured]:
        """Ways in which a link through a cell can be gone, the fastest first."""
        best = self.chart.measured.get(link)
        others = sorted(self.chart.others.get(link, []), key=lambda own: own.duration)
        return [best, *others[:OTHERS]] if isinstance(best, Measured) else []

    def _list_unbegun(self, link: Link) -> list[Measured]:
        return [own._replace(begun=[]) for own in self._list_ways(link)]

    def _look_by(self, rule: SearchRule, wanted: int, report: Callable[[str], None]) -> None:
        """Look at routes as one rule of thumb leads to them, while one may be better."""
        looked, most = 0, self._measurements + MEASURED
        for route in self.search.run(rule):
            enough = len(self.found) >= wanted
            if enough and self.estimate(route) > self._best:
                return
            if looked > wanted + TRIED or self._measurements >= most:
                return
            if self._measure(route, report):
                looked += 1
                self.found.append(route)
                if len(self.found) >= wanted:
                    self.search.limit = BEYOND * self._best
                    most = min(most, self._measurements + MORE)

    @property
    def _best(self) -> float:
        """About the least time of a route that is found [s]."""
        return min((self.estimate(own) for own in self.found), default=float("inf"))

    def _measure(self, route: RoadmapRoute, report: Callable[[str], None]) -> bool:
        """Plan the links of a route that lead through cells; whether all have a plan."""
        known = self.chart.measured
        if self._is_lost(route):
            return False
        self._polisher.begin([own for own in route.links if own.in_cell and own not in known])
        for link in route.links:
            if not link.in_cell:
                continue
            if link not in known:
                self._measurements += 1
                report(f"planning {describe_steps(link.steps)}")
                known[link] = self._polisher.measure(link)
            if isinstance(known[link], str):
                return False
        return True

    def _is_lost(self, route: RoadmapRoute) -> bool:
        """Whether a route has links for which another one had no plan."""
        return any(
            route.links[k : k + len(lost)] == lost
            for lost in self._lost
            for k in range(len(route.links))
        )

    def estimate(self, route: RoadmapRoute) -> float:
        """About the least time that a plan along all routes may take [s]."""
        total = 0.0
        for link in (link for own in (*self.before, route) for link in own.links):
            known = self.chart.measured.get(link)
            if isinstance(known, Measured):
                total += known.duration
            else:
                total += FASTER * link.duration if link.in_cell else link.duration
        return total
