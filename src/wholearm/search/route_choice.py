"""Planning of the routes that a search finds, in the order of their estimated durations.

Edge refinement plans links through cells first; a pattern search finds where they leave borders.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar

from ..common.parallel import Task, share
from ..planning.blocks import free_torques
from ..planning.options import Objective, PlanOptions
from ..planning.result import Plan
from ..problem.definition import Problem
from .astar import CAREFUL, EAGER, RoadmapRoute, RouteSearch, SearchRule
from .edge_plans import BackgroundTask, Lost, are_alike, list_printed, plan_links, plan_phases
from .edges import Link, describe_steps, leave_at
from .feasibility import Measured, leave_in_motion, measure_link
from .result import BorderBound, bound_borders

FINEST = 0.03  # finest step of the place where a border is left, over the border's length
STEPS = (4, 2, 1)  # steps of the pattern search, in the finest one
ELSEWHERE = (0.15, -0.15)  # shifts of the place, over that length, if there is no plan from it
GAIN = 0.998  # largest ratio of durations that counts as a gain
INSIDE = 0.02  # least distance of the place from both ends of the border, over its length

Found = Measured | str
T = TypeVar("T")


class RefinedPath(NamedTuple):
    """Where a link leaves its border, and the guess of its path through the cell."""

    move: int | None  # shift of the place in finest steps; None: the border is left in motion
    straight: bool = True  # guess: straight through the cell, or to the nearest end of the phase


@dataclass
class ReleaseSearch:
    """Pattern search for the place where a link leaves a border for a cell."""

    plan: Callable[[RefinedPath], Found]
    best: Measured
    _others: list[Measured] = field(default_factory=list)
    _prefetched: dict[RefinedPath, Found] = field(default_factory=dict)
    _tried: set[RefinedPath] = field(default_factory=lambda: {RefinedPath(0)})

    def prefetch(self, execute: Callable[[Sequence[Task[Found]]], list[Found]]) -> None:
        """Plan the first candidates in parallel."""
        paths = RefinedPath(None), RefinedPath(-STEPS[0]), RefinedPath(STEPS[0])
        found = execute([partial(self.plan, path) for path in paths])
        self._prefetched = dict(zip(paths, found, strict=True))

    def run(self) -> list[Measured]:
        """The fastest plan, followed by the others."""
        path = self._move(RefinedPath(0), STEPS[:1])
        # In motion the planner chooses the place: tried first where no shift has gained anything.
        if path.move or not self._try(RefinedPath(None)):
            path = self._move(path, STEPS[1:])
            if self._try(path._replace(straight=False)):
                self._move(path._replace(straight=False), STEPS[1:])
        return [self.best, *self._others]

    def _move(self, path: RefinedPath, steps: Sequence[int]) -> RefinedPath:
        """Shift the place for as long as that gains; first towards the start of the border."""
        place, sign = path.move or 0, -1
        for step in steps:
            moves = (sign * step, -sign * step)
            while moved := next((m for m in moves if self._try(path._replace(move=place + m))), 0):
                place, sign = place + moved, 1 if moved > 0 else -1
                moves = (moved, -moved)
        return path._replace(move=place)

    def _try(self, path: RefinedPath) -> bool:
        """Plan a path that has not been tried; whether it is the fastest one."""
        if path in self._tried:
            return False
        self._tried.add(path)
        found = self._prefetched[path] if path in self._prefetched else self.plan(path)
        if isinstance(found, str):
            return False
        better = found.duration < GAIN * self.best.duration
        self._others.append(self.best if better else found)
        self.best = found if better else self.best
        return better


FASTER = 0.7  # least ratio of planned to straight-path durations through cells; by experience
AGREES = 1 + 1e-4  # ratio of a plan of printed phases to those of the links, above which another
# initial guess is tried
TRIED = 6  # most routes without a plan, beyond those asked for
OTHERS = 2  # most slower plans of a link that are tried if the fastest fails the replay
BEYOND = 1.1  # largest estimate of a route over that of the best one
NEARBY = 30  # most places of `find_first`
MEASURED, MORE = 24, 8  # most links planned until there is a route, and after it


class Chooser:
    """Routes of a search, and plans of those that seem best.

    Parameters
    ----------
    before      routes to the goals before
    jobs        most processes at the same time
    first_only  whether any plan will do: then links are not refined

    Attributes
    ----------
    found           routes whose links through cells have plans
    made, failures  plans of routes, and routes without one
    """

    def __init__(
        self,
        problem: Problem,
        before: list[RoadmapRoute],
        search: RouteSearch,
        options: PlanOptions,
        jobs: int = 1,
        first_only: bool = False,
    ) -> None:
        self.first_only = first_only
        self.problem, self.before, self.search = problem, before, search
        self.options, self.roadmap, self.jobs = options, search.roadmap, jobs
        self.found: list[RoadmapRoute] = []
        self.made: list[tuple[Plan, RoadmapRoute]] = []
        self.failures: list[str] = []
        self._prefetched: dict[Link, Found] = {}
        self._measurements = 0
        self._bound: tuple[float, BackgroundTask[BorderBound]] | None = None
        self._lost: list[tuple[Link, ...]] = []

    def run(self, wanted: int, report: Callable[[str], None]) -> None:
        """Search and plan until there are `wanted` plans, or no more routes."""
        for _ in range(TRIED):
            failed = len(self.failures)
            self._look_by(EAGER, wanted, report)
            # Without a route by then, the other rule leads elsewhere, and as far.
            most = CAREFUL.most if self.found else EAGER.most
            self._look_by(CAREFUL._replace(most=most), wanted, report)
            self.plan(wanted, report)
            if len(self.made) >= wanted or len(self.failures) == failed:
                return
            # A route without a plan bounds nothing.
            self.search.limit = math.inf

    def find_first(self, report: Callable[[str], None], most: int = NEARBY) -> RoadmapRoute | None:
        """The first route over few places whose links through cells have plans."""
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
            if not self.first_only:
                self._refine(route, report)
            report(f"planning a route of {sum(len(link.steps) for link in route.links)} phases")
            plan = self._plan(route, report)
            # An interrupted one is still there, to be planned then.
            self.found.remove(route)
            if isinstance(plan, str):
                self.failures.append(plan)
                if isinstance(plan, Lost):
                    self._lost.append(plan.links)
            else:
                self.made.append((plan, route))

    def _plan(self, route: RoadmapRoute, report: Callable[[str], None]) -> Plan | str:
        """The plan of the phases that are printed for a route.

        Their ends are those of plans of the route's links. If these have the torques and the
        objective of the plan, they are the initial guess, too.
        """
        problem, options = self.problem, self.options
        alike = are_alike(problem, options)
        if not alike:
            options = replace(options, objective=Objective.TIME, duration=None)
            problem, options = free_torques(problem, options)
        links = [(link, self._list_plans(link)) for r in (*self.before, route) for link in r.links]
        if problem is not self.problem:
            # Their guesses are of other motors.
            links = [(link, [m._replace(begun=[]) for m in plans]) for link, plans in links]
        background = None
        if self.jobs > 1 and not self.before and self._bound is None:
            # A bound up to more than the plan will take, computed beside it.
            enough = BEYOND * self.estimate(route)
            background = BackgroundTask(partial(bound_borders, self.search, enough))
            self._bound = enough, background
        planned = plan_links(
            problem, links, options, self.roadmap.joined, report, self.jobs, background
        )
        if isinstance(planned, Lost):
            return planned
        reached = sum(link.duration for link in planned)
        best: Plan | str = ""
        # Without guesses: query 61, whose guess leads to worse contact modes.
        for guesses in (True, False) if alike else (False,):
            phases = list_printed(problem.scene, planned, guesses)
            printed = replace(self.problem, phases=phases, goals=())
            plan = plan_phases(printed, self.options, self.roadmap.plans, report)
            if not isinstance(best, Plan) or (isinstance(plan, Plan) and plan.value < best.value):
                best = plan
            if isinstance(plan, Plan) and plan.value < AGREES * reached:
                break
        return best

    def bound(self, duration: float, in_cells: bool) -> BorderBound:
        """Lower bound of all routes along borders; up to `duration` of a plan `in_cells`."""
        enough, task = self._bound or (0.0, None)
        known = task.result if task else None
        wanted = duration if in_cells else math.inf
        if known is None or min(enough, wanted) <= known.value < wanted:
            return bound_borders(self.search, wanted)
        return known.up_to(wanted)

    def _list_plans(self, link: Link) -> list[Measured]:
        """Plans of a link through a cell, the fastest first."""
        best = self.roadmap.measured.get(link)
        others = sorted(self.roadmap.others.get(link, []), key=lambda plan: plan.duration)
        return [best, *others[:OTHERS]] if isinstance(best, Measured) else []

    def _look_by(self, rule: SearchRule, wanted: int, report: Callable[[str], None]) -> None:
        """Collect routes by one heuristic, while a better one is possible."""
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
        return min((self.estimate(route) for route in self.found), default=float("inf"))

    def _measure(self, route: RoadmapRoute, report: Callable[[str], None]) -> bool:
        """Plan the links of a route that lead through cells; whether all have a plan."""
        known = self.roadmap.measured
        if self._is_lost(route):
            return False
        kept = self._prefetched
        new = [own for own in route.links if own.in_cell and own not in known and own not in kept]
        if self.jobs > 1 and len(new) > 1:
            found = self._share([partial(self._measure_link, link) for link in new])
            kept.update(zip(new, found, strict=True))
        for link in route.links:
            if not link.in_cell:
                continue
            if link not in known:
                self._measurements += 1
                report(f"planning {describe_steps(link.steps)}")
                known[link] = kept.pop(link) if link in kept else self._measure_link(link)
            if isinstance(known[link], str):
                return False
        return True

    def _refine(self, route: RoadmapRoute, report: Callable[[str], None]) -> None:
        """Optimize the places where a route leaves borders for cells."""
        roadmap = self.roadmap
        links = [link for link in route.links if link.left and link not in roadmap.refined]
        roadmap.refined.update(links)
        for link in links:
            report(f"planning {describe_steps(link.steps)} in other ways")
        plans = {link: roadmap.measured[link] for link in links}
        searches = [
            ReleaseSearch(partial(self._release, link), plan)
            for link, plan in plans.items()
            if isinstance(plan, Measured)
        ]
        if self.jobs > 1 and len(searches) == 1:
            searches[0].prefetch(self._share)
        found = self._share([search.run for search in searches])
        for link, (best, *others) in zip(links, found, strict=True):
            roadmap.measured[link] = best
            roadmap.others.setdefault(link, []).extend(others)

    def _share(self, tasks: Sequence[Task[T]]) -> list[T]:
        return share(tasks, self.jobs, (self.problem, self.problem.scene))

    def _measure_link(self, link: Link) -> Found:
        """Plan a link through a cell, from other places of its border if that fails."""
        found = measure_link(self.problem, link, link.steps, self.options, further=True)
        for move in ELSEWHERE if link.left else ():
            place = link.share + move
            if not isinstance(found, str):
                break
            if INSIDE < place < 1 - INSIDE:
                found = measure_link(self.problem, link, leave_at(link, place), self.options)
        return found

    def _release(self, link: Link, path: RefinedPath) -> Found:
        """Plan a link that leaves its border at another place, or in motion."""
        steps = leave_in_motion(link.steps)
        if path.move is not None:
            place = link.share + FINEST * path.move
            if not INSIDE < place < 1 - INSIDE:
                return "it is too near to the end of the border"
            steps = leave_at(link, place)
        return measure_link(
            self.problem, link, steps, self.options, straight=path.straight, first_only=True
        )

    def _is_lost(self, route: RoadmapRoute) -> bool:
        """Whether a route contains links that had no plan on another one."""
        return any(
            route.links[k : k + len(lost)] == lost
            for lost in self._lost
            for k in range(len(route.links))
        )

    def estimate(self, route: RoadmapRoute) -> float:
        """About the least time that a plan along all routes may take [s]."""
        total = 0.0
        for link in (link for r in (*self.before, route) for link in r.links):
            known = self.roadmap.measured.get(link)
            if isinstance(known, Measured):
                total += known.duration
            else:
                total += FASTER * link.duration if link.in_cell else link.duration
        return total
