"""Best-first search (lazy A*) for routes from a place to a goal, their plans and lower bounds.

Edges along borders are evaluated when their place is expanded; edges through cells, which cost more
time, wait in the queue with a heuristic lower bound. A greedy heuristic leads to a first plan, a
more cautious one finds faster routes near the start. Routes are planned in the order of their
estimated durations; a pattern search finds where their edges leave borders for cells.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import count, pairwise, takewhile
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from ..common.parallel import Task, run_tasks
from ..common.signals import Reporter, beat
from ..contacts.elemental import Contact
from ..geometry.tracing import CostToGo
from ..planning.blocks import free_torques
from ..planning.options import Objective, PlanOptions
from ..planning.result import Plan
from ..problem.definition import End, Goal, Problem, Until
from .edge_plans import (
    CoarsePlan,
    Lost,
    PartPlan,
    RoutePart,
    free_landings,
    list_printed,
    list_slow,
    look_ahead,
    plan_coarsely,
    plan_part,
    plan_phases,
    split_route,
    time_with,
)
from .edges import ROUGHLY, Blocked, Edge, EdgeStep, describe_steps, point_out
from .places import Key, RoadmapPlace, is_at
from .roadmap import Roadmap

CROSSING = 1.0  # heuristic least time of a motion through a cell, over the scene's time
OFTEN = 2  # expansions of one place, on different routes
MOST = 4000  # most entries that are taken from the queue
FINEST = 0.03  # finest step of the place where a border is left, over the border's length
STEPS = (4, 2, 1)  # steps of the pattern search, in the finest one
GAIN = 0.998  # largest ratio of durations that counts as a gain
INSIDE = 0.02  # least distance of the place from both ends of the border, over its length
FASTER = 0.7  # least ratio of planned to straight-path durations through cells; by experience
TRIED = 6  # most routes without a plan, beyond those asked for
BEYOND = 1.1  # largest estimate of a route over that of the best one
MEASURED, MORE = 24, 8  # most edges planned until there is a route, and after it
SETTLED = 240  # most places that are settled to bound routes from below


class Heuristic(NamedTuple):
    """Estimated cost to go, in the scene's time, and a limit of the search."""

    turning: float  # per radian that is left to turn
    leaving: float  # through a cell from a place along a border
    most: int  # most places that are expanded


EAGER: Heuristic = Heuristic(14.0, 4.0, 130)
"""As routes through cells take: greedy, leads to a first plan soon."""
CAREFUL: Heuristic = Heuristic(4.0, 2.5, 200)
"""Hardly any route takes less: finds routes that start in the wrong direction.

Goals 26 and 30 of the corpus have routes that are 11 and 17 % faster behind 50 places, goals 5 and
7 routes that are 5 and 17 % faster behind 100.
"""


@dataclass(frozen=True, eq=False)
class Route:
    """Edges one after the other."""

    start: RoadmapPlace
    edges: tuple[Edge, ...] = ()

    @property
    def stop(self) -> RoadmapPlace:
        """Where it leads."""
        return self.edges[-1].stop if self.edges else self.start

    def extend(self, edge: Edge) -> Route:
        """The route with another edge."""
        return Route(self.start, (*self.edges, edge))

    @property
    def estimate(self) -> float:
        """Estimated duration [s]."""
        return sum(edge.estimate for edge in self.edges)

    @property
    def in_cells(self) -> bool:
        """Whether it leads through cells, for which there is no lower bound."""
        return any(edge.in_cell for edge in self.edges)

    @property
    def key(self) -> object:
        """Its formations, and how phases end."""
        steps = (step for edge in self.edges for step in edge.steps)
        return tuple((frozenset(step.contacts), step.end) for step in steps)

    def has_followed(self, contacts: Sequence[Contact]) -> bool:
        """Whether contacts are those of the border that it has just followed."""
        last = self.edges[-1] if self.edges and not self.edges[-1].in_cell else None
        return last is not None and set(last.steps[-1].contacts) == set(contacts)


@dataclass(eq=False)
class RouteSearch:
    """Routes from a start to a goal."""

    roadmap: Roadmap
    start: RoadmapPlace
    goal: Goal
    # blocked edges, as they are met
    blocked: list[Blocked] = field(default_factory=list)
    # the first route to each expanded place, by its key
    reached: dict[Key, Route] = field(default_factory=dict)
    found: set[object] = field(default_factory=set)  # keys of routes that have been found
    limit: float = math.inf  # largest cost of routes [s]
    sources: Sequence[Route] = ()  # routes to start with, if not from the start itself

    def measure(self, place: RoadmapPlace, turning: float = 1.0) -> float:
        """Heuristic time to turn from a place to the goal [s]; `turning` is that of a radian."""
        phi, scene = float(place.z[2]), self.roadmap.scene
        return turning * scene.scales.time * abs(self.goal.find_angle(scene, phi) - phi)

    def run(self, heuristic: Heuristic = EAGER) -> Iterator[Route]:
        """Yield new routes, about in the order of their durations."""
        time = self.roadmap.scene.scales.time
        number, times = count(), Counter[Key]()  # times: expansions of places
        # Looked at in place of where the route leads: edges from there that are costly to find.
        Pending = Callable[[], list[Edge]] | None
        queue = list[tuple[float, int, Route, Pending]]()

        def push(route: Route, pending: Pending = None, more: float = 0.0) -> None:
            least = route.estimate + self.measure(route.stop, heuristic.turning) + more
            heapq.heappush(queue, (least, next(number), route, pending))

        for source in self.sources or (Route(self.start),):
            push(source)
        for _ in range(MOST):
            if not queue:
                return
            beat()
            least, _, route, pending = heapq.heappop(queue)
            if least > self.limit or len(times) > heuristic.most:
                return
            if pending:
                edges = pending()
                for edge in (*edges, *self.roadmap.land_at(edges, self.goal)):
                    push(route.extend(edge))
                continue
            place = route.stop
            if route.edges and is_at(place, self.goal):
                if route.key not in self.found:
                    self.found.add(route.key)
                    yield route
                continue
            last = route.edges[-1] if route.edges else None
            if last and last.chain and last.onwards:
                before = Route(route.start, route.edges[:-1])
                for edge in self.roadmap.go_on(last.chain, self.goal):
                    push(before.extend(edge))
            if times[place.key] >= (1 if place.landed else OFTEN):
                continue
            times[place.key] += 1
            self.reached.setdefault(place.key, route)
            for candidate in self.roadmap.set_out(place, self.goal):
                if route.has_followed(candidate.steps[0].contacts):
                    continue
                if isinstance(candidate, Edge):
                    push(route.extend(candidate))
                elif times[place.key] == 1 and candidate not in self.blocked:
                    self.blocked.append(candidate)
            if not place.landed:
                every = (chain.borders[0] for chain in self.roadmap.follow(place))
                borders = [b for b in every if not route.has_followed(b.formation.contacts)]
                for border in borders:
                    release = partial(self.roadmap.release, border, borders)
                    push(route, release, heuristic.leaving * time)
                push(route, partial(self.roadmap.cross_cells, place, self.goal), CROSSING * time)


class RefinedPath(NamedTuple):
    """Where an edge leaves its border, and the guess of its path through the cell."""

    move: int | None  # shift of the place in finest steps; None: the border is left in motion
    straight: bool = True  # guess: straight through the cell, or to the nearest end of the phase


def search_release(
    plan: Callable[[RefinedPath, CoarsePlan | None], CoarsePlan | None],
    best: CoarsePlan,
    to_go: CostToGo | None = None,
    known: Mapping[RefinedPath, CoarsePlan | None] = MappingProxyType({}),
) -> list[CoarsePlan]:
    """Pattern search for the place where an edge leaves a border: the fastest plan, then others.

    By the least time of the edge and of a border that follows where it lands (`to_go`). `plan`
    plans a path, one without a stop also from a plan with one; `known` are plans made before.
    """
    least, tried, others = time_with(to_go, best), {RefinedPath(0)}, list[CoarsePlan]()

    def gains(path: RefinedPath) -> bool:
        """Plan a path that has not been tried; whether it is the fastest one."""
        if path in tried:
            return False
        tried.add(path)
        return accept(known[path] if path in known else plan(path, None))

    def accept(made: CoarsePlan | None) -> bool:
        """Keep a plan, if it is one; whether it is the fastest."""
        nonlocal best, least
        if made is None:
            return False
        time = time_with(to_go, made)
        better = time < GAIN * least
        others.append(best if better else made)
        best, least = (made, time) if better else (best, least)
        return better

    def shift(path: RefinedPath, steps: Sequence[int]) -> RefinedPath:
        """Shift the place for as long as that gains; first towards the start of the border."""
        place, sign = path.move or 0, -1
        for step in steps:
            moves = (sign * step, -sign * step)
            while moved := next((m for m in moves if gains(path._replace(move=place + m))), 0):
                place, sign = place + moved, 1 if moved > 0 else -1
                moves = (moved, -moved)
        return path._replace(move=place)

    # In motion the planner chooses the place.
    motion = RefinedPath(None)
    if not gains(motion):
        path = shift(RefinedPath(0), STEPS[:-1])
        stopped = best
        # Cases: goals 10, 24, 33, 37, 46 and 51 of the corpus, 3 to 8 % faster; from the finest
        # place goals 0 and 16.
        if not accept(plan(motion, stopped)):
            path = shift(path, STEPS[-1:])
            if gains(path._replace(straight=False)):
                shift(path._replace(straight=False), STEPS[1:])
            if best is not stopped:
                accept(plan(motion, best))
    return [best, *others]


@dataclass(eq=False)
class RoutePlanner:
    """Routes of a search, and plans of those that seem best."""

    problem: Problem
    before: Plan | None  # to the goals before
    search: RouteSearch
    options: PlanOptions
    report: Reporter
    wanted: int = 1  # number of plans
    jobs: int = 1  # most processes at the same time
    spent: float = 0.0  # [s]: estimated least time to the goals before
    first_only: bool = False  # whether any plan will do: then edges are not refined
    thorough: bool = False  # whether all guesses are tried for edges through cells
    found: list[Route] = field(default_factory=list)  # their edges through cells have plans
    made: list[tuple[Plan, Route]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)  # why routes have no plan
    _measurements: int = 0
    _bound: tuple[float, BorderBound] | None = None  # up to what it was asked for
    _lost: list[tuple[Edge, ...]] = field(default_factory=list)

    @cached_property
    def free(self) -> Problem:
        """The problem with free torques, with which edges are planned alone."""
        return free_torques(self.problem, self.options)[0]

    @property
    def roadmap(self) -> Roadmap:
        """The roadmap of the search, which keeps plans."""
        return self.search.roadmap

    def run(self) -> None:
        """Search and plan until there are as many plans as wanted, or no more routes."""
        for _ in range(TRIED):
            failed = len(self.failures)
            self.look_by(EAGER)
            self.look_by(CAREFUL)
            self.plan()
            if len(self.made) >= self.wanted:
                return
            if len(self.failures) == failed:
                if self.made or self.thorough or self.first_only or not self._forget_failures():
                    return
            # A route without a plan bounds nothing.
            self.search.limit = math.inf

    def _forget_failures(self) -> bool:
        """Have edges of several phases without a plan planned from all guesses, if there are any.

        Case: query 207, where a release has a plan from the friction homotopy alone.
        """
        self.thorough, plans = True, self.roadmap.coarse_plans
        # For a phase alone, as after a stop, they have been tried.
        failed = [edge for edge, made in plans.items() if not made]
        lost = [e for e in failed if len(e.steps) - (e.steps[0].end is End.REST) > 1]
        for edge in lost:
            del plans[edge]
        self.search.found.clear()
        return bool(lost)

    def plan(self) -> None:
        """Plan the routes that are found, the best first, until there are as many as wanted."""
        for route in sorted(self.found, key=self.estimate):
            if len(self.made) >= self.wanted or len(self.failures) >= TRIED:
                return
            if self._is_lost(route):
                self.found.remove(route)
                continue
            if not self.first_only:
                self._refine(route)
            self.report(
                f"planning a route of {sum(len(edge.steps) for edge in route.edges)} phases"
            )
            plan = self._plan(route)
            if isinstance(plan, str) and self._take_others(route):
                plan = self._plan(route)
            # An interrupted one is still there, to be planned then.
            self.found.remove(route)
            if isinstance(plan, str):
                self.failures.append(plan)
                if isinstance(plan, Lost) and plan.edges:
                    self._lost.append(plan.edges)
            else:
                self.made.append((plan, route))

    def _take_others(self, route: Route) -> bool:
        """Take the other plans of edges that last least by themselves; whether there are any.

        A part of the route of goal 25 of the corpus has no plan otherwise.
        """
        plans = self.roadmap.coarse_plans
        several = [edge for edge in route.edges if len(plans.get(edge, ())) > 1]
        plans.update({edge: plans[edge][1:2] for edge in several})
        return bool(several)

    def _plan(self, route: Route) -> Plan | str:
        """The plan of the phases that are printed for a route.

        Their ends are those of plans of the route's edges. These are the initial guess, too, if
        they have the objective of the plan and its torques are not held; otherwise if there is no
        plan without (query 19, margin).
        """
        problem, options, scene = self.problem, self.options, self.problem.scene
        # Parts are planned for least time, and not with held torques.
        alike = options.goal is Objective.TIME and not scene.control_period
        if not alike:
            options = replace(options, objective=Objective.TIME, duration=None)
        if scene.control_period:
            problem, options = free_torques(problem, options)
        planned = self._plan_parts(route, problem, options.scale_ranges(problem.ranges))
        if isinstance(planned, Lost):
            return planned
        found = [pair for part in planned for pair in part]
        before = self.before.problem.phases if self.before else ()
        plan: Plan | str = ""
        # Without guesses: goal 59 of the corpus, whose plan from them does not hold in its replay.
        for guesses in (alike, not alike):
            phases = (*before, *list_printed(scene, found, guesses))
            phases = tuple(replace(phase, index=k) for k, phase in enumerate(phases))
            printed = replace(self.problem, phases=phases, goals=())
            plan = plan_phases(printed, self.options, self.roadmap.plans, self.report)
            lost = plan.phases if isinstance(plan, Lost) else ()
            if isinstance(plan, Plan) and alike:
                lost = list_slow(plan, found)
            if freed := free_landings(printed, lost):
                other = plan_phases(freed, self.options, self.roadmap.plans, self.report)
                plans = [made for made in (plan, other) if isinstance(made, Plan)]
                plan = min(plans, key=lambda made: made.value, default=plan)
            if isinstance(plan, Plan):
                break
            if isinstance(plan, Lost) and alike:
                numbers = [k - len(before) for k in plan.phases if k > len(before)]
                if numbers:
                    # Without its guess a phase was tried, too. Case: query 62, four of whose routes
                    # go through phases 18 and 19 of the first one.
                    plan.edges = self._find_lost(route, numbers)
                    break
        return plan

    def _find_lost(self, route: Route, phases: Sequence[int]) -> tuple[Edge, ...]:
        """Edges of a route that phases without a plan belong to.

        The one that lands at their start, which may have landed at another place, is before them.
        """
        coarse, owners = self.roadmap.coarse_plans, list[int]()
        for k, edge in enumerate(route.edges):
            owners += [k] * len((coarse[edge][0] if edge.in_cell else edge).steps)
        first, last = owners[phases[0] - 1], owners[phases[-1] - 1]
        first -= first > 0 and route.edges[first - 1].in_cell
        return route.edges[first : last + 1]

    def _plan_parts(
        self, route: Route, problem: Problem, options: PlanOptions
    ) -> list[PartPlan] | Lost:
        """Coarse plans of a route's parts, one after the other, or why one has none."""
        coarse = self.roadmap.coarse_plans
        parts = [
            tuple((edge, coarse[edge][0] if edge.in_cell else None) for edge in part)
            for part in split_route(route.edges)
        ]
        self.report(f"planning the route, in parts: {len(parts)}")
        # Several processes would tell their progress at once.
        tell, lost = self.report if self.jobs == 1 else Reporter(None), list[Lost]()

        def plan_one(part: RoutePart) -> PartPlan | Lost | None:
            """Plan a part; None if another one has no plan."""
            begin = replace(problem, start=part[0][0].start.z)
            made = None if lost else plan_part(begin, part, options, tell)
            if isinstance(made, Lost):
                lost.append(made)
            return made

        known = self.roadmap.part_plans
        keys = [(tuple((e, c and c.duration) for e, c in part), repr(options)) for part in parts]
        # Parts through cells take longest, and the first of them without a plan ends this.
        along = [not part[0][0].in_cell for part in parts]
        order = sorted(range(len(parts)), key=along.__getitem__)
        wanted = takewhile(lambda k: not isinstance(known.get(keys[k]), Lost), order)
        new = [k for k in wanted if keys[k] not in known]
        tasks: list[Task[Any]] = [partial(plan_one, parts[k]) for k in new]
        enough = BEYOND * self.estimate(route)
        if self.jobs > 1 and not self.before and not self._bound:
            # A bound up to more than the plan will take, computed beside it.
            tasks.append(partial(bound_borders, self.search, enough))
        results = run_tasks(tasks, self.jobs)
        for bound in results[len(new) :]:
            self._bound = enough, bound
        known.update({keys[k]: made for k, made in zip(new, results, strict=False) if made})
        for k in order:
            if isinstance(made := known.get(keys[k]), Lost):
                passed = sum(len((plan or edge).steps) for part in parts[:k] for edge, plan in part)
                made.edges = self._find_lost(route, [passed + number for number in made.phases])
                return made
        # None is lost, and so all are planned.
        return [cast(PartPlan, known[key]) for key in keys]

    def bound(self, duration: float, in_cells: bool) -> BorderBound:
        """Lower bound of all routes along borders; up to `duration` of a plan `in_cells`."""
        wanted = duration if in_cells else math.inf
        enough, bound = self._bound or (0.0, None)
        if bound is None or min(enough, wanted) <= bound.value < wanted:
            return bound_borders(self.search, wanted)
        return bound.up_to(wanted)

    def look_by(self, heuristic: Heuristic) -> None:
        """Collect routes by a heuristic, while a better one is possible."""
        looked, most = 0, self._measurements + MEASURED
        for route in self.search.run(heuristic):
            if len(self.found) >= self.wanted and self.estimate(route) > self._best:
                return
            if looked > self.wanted + TRIED or self._measurements >= most:
                return
            if self._measure(route):
                looked += 1
                self.found.append(route)
                if len(self.found) >= self.wanted:
                    self.search.limit = BEYOND * self._best
                    most = min(most, self._measurements + MORE)

    @property
    def _best(self) -> float:
        """About the least time of a route that is found [s]."""
        return min((self.estimate(route) for route in self.found), default=float("inf"))

    def _measure(self, route: Route) -> bool:
        """Plan the edges of a route that lead through cells; whether all have a plan."""
        if self._is_lost(route):
            return False
        plans = self.roadmap.coarse_plans
        in_cells = [edge for edge in route.edges if edge.in_cell]
        new = [edge for edge in in_cells if edge not in plans]
        self._measurements += len(new)
        if new:
            self.report("; ".join(f"planning {describe_steps(edge.steps)}" for edge in new))
        plan = partial(plan_coarsely, self.free, options=self.options, thorough=self.thorough)
        tasks = [partial(plan, edge, edge.steps) for edge in new]
        for edge, coarse in zip(new, run_tasks(tasks, self.jobs), strict=True):
            plans[edge] = [coarse] if coarse else []
        return all(plans[edge] for edge in in_cells)

    def _refine(self, route: Route) -> None:
        """Optimize the places where a route leaves borders for cells."""
        roadmap, searches = self.roadmap, dict[Edge, partial[list[CoarsePlan]]]()
        for edge, after in pairwise((*route.edges, None)):
            if edge is None or edge.left is None or edge in roadmap.refined:
                continue
            self.report(f"planning {describe_steps(edge.steps)} in other ways")
            single = after and not after.in_cell and len(after.steps) == 1
            to_go = look_ahead(self.problem, after, edge.stop) if after and single else None
            (plan,) = roadmap.coarse_plans[edge]
            searches[edge] = partial(search_release, partial(self._release, edge), plan, to_go)
        roadmap.refined.update(searches)
        if self.jobs > 1 and len(searches) == 1:
            ((edge, search),) = searches.items()
            paths = RefinedPath(None), RefinedPath(-STEPS[0]), RefinedPath(STEPS[0])
            made = run_tasks([partial(search.args[0], path, None) for path in paths], self.jobs)
            searches[edge] = partial(search, known=dict(zip(paths, made, strict=True)))
        results = run_tasks(list(searches.values()), self.jobs)
        for edge, (best, *others) in zip(searches, results, strict=True):
            roadmap.coarse_plans[edge] = [best, *sorted(others, key=lambda plan: plan.duration)]

    def _release(
        self, edge: Edge, path: RefinedPath, stopped: CoarsePlan | None
    ) -> CoarsePlan | None:
        """Plan an edge that leaves its border at another place; or in motion, from a plan if any.

        That plan stops where it leaves the border.
        """
        first, *rest = edge.steps
        step = EdgeStep(first.contacts, Until(), End.SMOOTH)
        if path.move is not None:
            place = edge.share + FINEST * path.move
            if not INSIDE < place < 1 - INSIDE:
                return None
            assert edge.left is not None
            z = edge.left.evaluate(np.array([place * edge.left.length])).z[0]
            step = first._replace(until=point_out(first.contacts, z))
        # In motion the first guess has no plan in goal 48 of the corpus.
        return plan_coarsely(
            self.free,
            edge,
            (step, *rest),
            self.options,
            straight=path.straight,
            first_only=path.move is not None,
            stopped=stopped,
        )

    def _is_lost(self, route: Route) -> bool:
        """Whether a route contains edges that had no plan on another one."""
        return any(
            route.edges[k : k + len(lost)] == lost
            for lost in self._lost
            for k in range(len(route.edges))
        )

    def estimate(self, route: Route) -> float:
        """About the least time that a plan along all routes may take [s]."""
        total = self.spent
        for edge in route.edges:
            if plans := self.roadmap.coarse_plans.get(edge):
                total += plans[0].duration
            else:
                total += FASTER * edge.estimate if edge.in_cell else edge.estimate
        return total


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


def bound_borders(search: RouteSearch, enough: float) -> BorderBound:
    """Bound every route along borders from below, up to `enough` [s].

    Dijkstra's algorithm with coarse bounds of edges; those of the shortest route are refined until
    all of its edges are.
    """
    refined, edges_from = set[Edge](), dict[Key, list[Edge]]()
    while True:
        order, settled, edges = count(), set[Key](), tuple[Edge, ...]()
        bound = BorderBound(enough, True)
        queue = [(0.0, next(order), search.start, edges)]
        while queue:
            beat()
            cost, _, place, route = heapq.heappop(queue)
            if cost >= enough:
                break
            if is_at(place, search.goal):
                bound, edges = BorderBound(cost, True), route
                break
            if place.key in settled:
                continue
            if len(settled) >= SETTLED:
                bound = BorderBound(cost, False)
                break
            settled.add(place.key)
            if place.key not in edges_from:
                edges_from[place.key] = list(search.roadmap.list_along(place, search.goal))
            for edge in edges_from[place.key]:
                least = edge.fine_bound if edge in refined else ROUGHLY * edge.bound
                heapq.heappush(queue, (cost + least, next(order), edge.stop, (*route, edge)))
        if refined.issuperset(edges):
            return bound
        refined.update(edges)
