"""Best-first search (lazy A*) for routes from a place to a goal, their plans and lower bounds.

Edges along borders are evaluated when their place is expanded; edges through cells, whose
evaluation takes longer, are in the queue with a heuristic cost first. A greedy heuristic finds a
first plan, a more cautious one faster routes near the start. Routes are planned in the order of
their estimated durations; a pattern search optimizes the places where they leave borders for cells.
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
    PartPlan,
    PlanFailure,
    RoutePart,
    add_time_to_go,
    find_time_to_go,
    free_landings,
    list_slow_phases,
    plan_coarsely,
    plan_part,
    plan_phases,
    round_phases,
    split_route,
)
from .edges import SAFETY, BlockedEdge, Edge, EdgeStep, describe_steps, end_at_pose
from .places import Key, RoadmapPlace, is_at
from .roadmap import Roadmap

CROSSING = 1.0  # heuristic least time of a motion through a cell, over the scene's time
MAX_EXPANSIONS = 2  # expansions of one place, on different routes
MAX_ENTRIES = 4000  # entries that are taken from the queue
MIN_STEP = 0.03  # smallest step of the place at which a border is left, over the border's length
STEPS = (4, 2, 1)  # steps of the pattern search, over the smallest one
GAIN = 0.998  # largest ratio of durations that counts as a gain
END_MARGIN = 0.02  # least distance of the place from both ends of the border, over its length
MIN_RATIO = 0.7  # empirical least ratio of planned to straight-path durations through cells
MAX_FAILURES = 6  # number of routes without a plan
MAX_RATIO = 1.1  # largest estimate of a route over that of the best one
MAX_EDGES, MORE_EDGES = 24, 8  # edges planned until there is a route, and after it
MAX_PLACES = 240  # places expanded for the lower bound


class Heuristic(NamedTuple):
    """Estimated cost-to-go, in the scene's time, and a limit of the search."""

    turn_cost: float  # per radian to the goal
    release_cost: float  # of leaving a border for a cell
    max_places: int  # largest number of expanded places


GREEDY: Heuristic = Heuristic(14.0, 4.0, 130)
"""Typical costs of routes through cells: a first plan is found soon."""
CAUTIOUS: Heuristic = Heuristic(4.0, 2.5, 200)
"""Nearly a lower bound of the costs: finds routes that start in the opposite direction.

Goals 26 and 30 of the corpus have routes that are 11 and 17 % faster behind 50 places, goals 5 and
7 routes that are 5 and 17 % faster behind 100.
"""


@dataclass(frozen=True, eq=False)
class Route:
    """A path in the roadmap: consecutive edges."""

    start: RoadmapPlace
    edges: tuple[Edge, ...] = ()

    @property
    def stop(self) -> RoadmapPlace:
        """The place at its end."""
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
        """Whether it leads through cells; then it has no lower bound."""
        return any(edge.in_cell for edge in self.edges)

    @property
    def key(self) -> object:
        """Formations and transitions of its phases."""
        steps = (step for edge in self.edges for step in edge.steps)
        return tuple((frozenset(step.contacts), step.end) for step in steps)

    def has_followed(self, contacts: Sequence[Contact]) -> bool:
        """Whether its last edge is along the border with these contacts."""
        last = self.edges[-1] if self.edges and not self.edges[-1].in_cell else None
        return last is not None and set(last.steps[-1].contacts) == set(contacts)


@dataclass(eq=False)
class RouteSearch:
    """Search for routes from a start to a goal."""

    roadmap: Roadmap
    start: RoadmapPlace
    goal: Goal
    # blocked edges from expanded places
    blocked: list[BlockedEdge] = field(default_factory=list)
    # the first route to each expanded place, by its key
    reached: dict[Key, Route] = field(default_factory=dict)
    route_keys: set[object] = field(default_factory=set)  # keys of routes that were yielded
    limit: float = math.inf  # largest cost of routes [s]
    sources: Sequence[Route] = ()  # initial routes, if not from the start

    def measure(self, place: RoadmapPlace, turn_cost: float = 1.0) -> float:
        """Heuristic cost-to-go from a place to the goal [s]; `turn_cost` is per radian."""
        phi, scene = float(place.z[2]), self.roadmap.scene
        return turn_cost * scene.scales.time * abs(self.goal.find_angle(scene, phi) - phi)

    def run(self, heuristic: Heuristic = GREEDY) -> Iterator[Route]:
        """Yield new routes, about in the order of their durations."""
        time = self.roadmap.scene.scales.time
        number, expansions = count(), Counter[Key]()  # expansions of each place
        # Edges from the end of a route whose evaluation is postponed; None if it is to be expanded.
        Pending = Callable[[], list[Edge]] | None
        queue = list[tuple[float, int, Route, Pending]]()

        def push(route: Route, pending: Pending = None, extra: float = 0.0) -> None:
            priority = route.estimate + self.measure(route.stop, heuristic.turn_cost) + extra
            heapq.heappush(queue, (priority, next(number), route, pending))

        for source in self.sources or (Route(self.start),):
            push(source)
        for _ in range(MAX_ENTRIES):
            if not queue:
                return
            beat()
            priority, _, route, pending = heapq.heappop(queue)
            if priority > self.limit or len(expansions) > heuristic.max_places:
                return
            if pending:
                edges = pending()
                for edge in (*edges, *self.roadmap.land_at(edges, self.goal)):
                    push(route.extend(edge))
                continue
            place = route.stop
            if route.edges and is_at(place, self.goal):
                if route.key not in self.route_keys:
                    self.route_keys.add(route.key)
                    yield route
                continue
            last = route.edges[-1] if route.edges else None
            if last and last.chain and last.continues:
                shorter = Route(route.start, route.edges[:-1])
                for edge in self.roadmap.continue_chain(last.chain, self.goal):
                    push(shorter.extend(edge))
            if expansions[place.key] >= (1 if place.is_landing else MAX_EXPANSIONS):
                continue
            expansions[place.key] += 1
            self.reached.setdefault(place.key, route)
            for candidate in self.roadmap.list_edges(place, self.goal):
                if route.has_followed(candidate.steps[0].contacts):
                    continue
                if isinstance(candidate, Edge):
                    push(route.extend(candidate))
                elif expansions[place.key] == 1 and candidate not in self.blocked:
                    self.blocked.append(candidate)
            if not place.is_landing:
                followed = (chain.borders[0] for chain in self.roadmap.follow(place))
                borders = [b for b in followed if not route.has_followed(b.formation.contacts)]
                for border in borders:
                    release = partial(self.roadmap.release, border, borders)
                    push(route, release, heuristic.release_cost * time)
                push(route, partial(self.roadmap.cross_cells, place, self.goal), CROSSING * time)


class RefinedPath(NamedTuple):
    """Place at which an edge leaves its border, and the guess of its path through the cell."""

    move: int | None  # shift of the place in smallest steps; None: left without a stop
    straight: bool = True  # guess: straight through the cell, or to the nearest end of the phase


def search_release(
    plan: Callable[[RefinedPath, CoarsePlan | None], CoarsePlan | None],
    best: CoarsePlan,
    to_go: CostToGo | None = None,
    cached: Mapping[RefinedPath, CoarsePlan | None] = MappingProxyType({}),
) -> list[CoarsePlan]:
    """Pattern search for the place at which an edge leaves a border: the fastest plan, then others.

    The cost is the least time of the edge plus the cost-to-go from its landing (`to_go`). `plan`
    plans a path; without a stop also from a plan with one. `cached` are plans computed before.
    """
    best_time, planned, others = add_time_to_go(to_go, best), {RefinedPath(0)}, list[CoarsePlan]()

    def improves(path: RefinedPath) -> bool:
        """Plan a path, unless it has been planned; whether it is the fastest one."""
        if path in planned:
            return False
        planned.add(path)
        return accept(cached[path] if path in cached else plan(path, None))

    def accept(candidate: CoarsePlan | None) -> bool:
        """Store a plan, if there is one; whether it is the fastest."""
        nonlocal best, best_time
        if candidate is None:
            return False
        time = add_time_to_go(to_go, candidate)
        better = time < GAIN * best_time
        others.append(best if better else candidate)
        best, best_time = (candidate, time) if better else (best, best_time)
        return better

    def shift(path: RefinedPath, steps: Sequence[int]) -> RefinedPath:
        """Shift the place as long as the cost falls; first towards the start of the border."""
        place, sign = path.move or 0, -1
        for step in steps:
            moves = (sign * step, -sign * step)
            while move := next((m for m in moves if improves(path._replace(move=place + m))), 0):
                place, sign = place + move, 1 if move > 0 else -1
                moves = (move, -move)
        return path._replace(move=place)

    # Without a stop the planner chooses the place.
    motion = RefinedPath(None)
    if not improves(motion):
        path = shift(RefinedPath(0), STEPS[:-1])
        stop_plan = best
        # Cases: goals 10, 24, 33, 37, 46 and 51 of the corpus, 3 to 8 % faster; after the smallest
        # steps goals 0 and 16.
        if not accept(plan(motion, stop_plan)):
            path = shift(path, STEPS[-1:])
            if improves(path._replace(straight=False)):
                shift(path._replace(straight=False), STEPS[1:])
            if best is not stop_plan:
                accept(plan(motion, best))
    return [best, *others]


@dataclass(eq=False)
class RoutePlanner:
    """Routes of a search, and plans of the fastest ones."""

    problem: Problem
    previous: Plan | None  # to the previous goals
    search: RouteSearch
    options: PlanOptions
    report: Reporter
    n_plans: int = 1  # requested number of plans
    jobs: int = 1  # largest number of processes
    time_before: float = 0.0  # [s]: estimated least time to the previous goals
    first_only: bool = False  # whether the first plan is sufficient: edges are not refined
    all_guesses: bool = False  # whether all guesses are tried for edges through cells
    routes: list[Route] = field(default_factory=list)  # their edges through cells have plans
    plans: list[tuple[Plan, Route]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)  # why routes have no plan
    _n_planned: int = 0  # edges through cells
    _bound: tuple[float, BorderBound] | None = None  # limit and lower bound
    _failed_edges: list[tuple[Edge, ...]] = field(default_factory=list)

    @cached_property
    def free(self) -> Problem:
        """The problem with free torques, for plans of single edges."""
        return free_torques(self.problem, self.options)[0]

    @property
    def roadmap(self) -> Roadmap:
        """The roadmap of the search, which stores plans."""
        return self.search.roadmap

    def run(self) -> None:
        """Search and plan until there are `n_plans` plans, or no more routes."""
        for _ in range(MAX_FAILURES):
            n_failures = len(self.failures)
            self.collect_routes(GREEDY)
            self.collect_routes(CAUTIOUS)
            self.plan()
            if len(self.plans) >= self.n_plans:
                return
            if len(self.failures) == n_failures:
                if self.plans or self.all_guesses or self.first_only or not self._forget_failures():
                    return
            # The limit came from a route without a plan.
            self.search.limit = math.inf

    def _forget_failures(self) -> bool:
        """Discard edges of several phases without a plan; whether there are any.

        They are planned again from all guesses. Case: query 207 needs the friction homotopy.
        """
        self.all_guesses, plans = True, self.roadmap.coarse_plans
        # For a single phase, as after a stop, all guesses have been tried.
        failed = [edge for edge, planned in plans.items() if not planned]
        edges = [e for e in failed if len(e.steps) - (e.steps[0].end is End.REST) > 1]
        for edge in edges:
            del plans[edge]
        self.search.route_keys.clear()
        return bool(edges)

    def plan(self) -> None:
        """Plan the routes, the best first, until there are `n_plans` plans."""
        for route in sorted(self.routes, key=self.estimate):
            if len(self.plans) >= self.n_plans or len(self.failures) >= MAX_FAILURES:
                return
            if self._has_failed(route):
                self.routes.remove(route)
                continue
            if not self.first_only:
                self._refine(route)
            self.report(
                f"planning a route of {sum(len(edge.steps) for edge in route.edges)} phases"
            )
            plan = self._plan(route)
            if isinstance(plan, str) and self._use_others(route):
                plan = self._plan(route)
            # Removed after planning: an interrupted route is planned again.
            self.routes.remove(route)
            if isinstance(plan, str):
                self.failures.append(plan)
                if isinstance(plan, PlanFailure) and plan.edges:
                    self._failed_edges.append(plan.edges)
            else:
                self.plans.append((plan, route))

    def _use_others(self, route: Route) -> bool:
        """Replace plans of edges by the fastest of their other plans; whether there are any.

        Case: a part of the route of goal 25 of the corpus has no plan otherwise.
        """
        plans = self.roadmap.coarse_plans
        alternatives = [edge for edge in route.edges if len(plans.get(edge, ())) > 1]
        plans.update({edge: plans[edge][1:2] for edge in alternatives})
        return bool(alternatives)

    def _plan(self, route: Route) -> Plan | str:
        """The plan of the phases that are printed for a route.

        Their ends are those of plans of the route's parts. These plans are also the initial guess
        if they have the objective of the plan and there is no control period; otherwise only if
        there is no plan without (query 19, margin).
        """
        problem, options, scene = self.problem, self.options, self.problem.scene
        # Parts are planned for least time, and without control period.
        same_objective = options.goal is Objective.TIME and not scene.control_period
        if not same_objective:
            options = options.for_least_time()
        if scene.control_period:
            problem, options = free_torques(problem, options)
        parts = self._plan_parts(route, problem, options.scale_ranges(problem.ranges))
        if isinstance(parts, PlanFailure):
            return parts
        pairs = [pair for part in parts for pair in part]
        previous = self.previous.problem.phases if self.previous else ()
        plan: Plan | str = ""
        # Case without guesses: goal 59 of the corpus, whose plan from them fails in its replay.
        for guesses in (same_objective, not same_objective):
            phases = (*previous, *round_phases(scene, pairs, guesses))
            phases = tuple(replace(phase, index=k) for k, phase in enumerate(phases))
            printed = replace(self.problem, phases=phases, goals=())
            plan = plan_phases(printed, self.options, self.roadmap.plans, self.report)
            failed = plan.phases if isinstance(plan, PlanFailure) else ()
            if isinstance(plan, Plan) and same_objective:
                failed = list_slow_phases(plan, pairs)
            if relaxed := free_landings(printed, failed):
                second = plan_phases(relaxed, self.options, self.roadmap.plans, self.report)
                plans = [candidate for candidate in (plan, second) if isinstance(candidate, Plan)]
                plan = min(plans, key=lambda candidate: candidate.value, default=plan)
            if isinstance(plan, Plan):
                break
            if isinstance(plan, PlanFailure) and same_objective:
                numbers = [k - len(previous) for k in plan.phases if k > len(previous)]
                if numbers:
                    # A phase is also tried without its guess. Case: query 62, where four routes
                    # contain phases 18 and 19 of the first one.
                    plan.edges = self._find_failed(route, numbers)
                    break
        return plan

    def _find_failed(self, route: Route, phases: Sequence[int]) -> tuple[Edge, ...]:
        """Edges of a route with phases without a plan.

        Including the edge that lands at their start: another landing may be possible.
        """
        coarse, owners = self.roadmap.coarse_plans, list[int]()
        for k, edge in enumerate(route.edges):
            owners += [k] * len((coarse[edge][0] if edge.in_cell else edge).steps)
        first, last = owners[phases[0] - 1], owners[phases[-1] - 1]
        first -= first > 0 and route.edges[first - 1].in_cell
        return route.edges[first : last + 1]

    def _plan_parts(
        self, route: Route, problem: Problem, options: PlanOptions
    ) -> list[PartPlan] | PlanFailure:
        """Coarse plans of a route's parts, one after the other, or why one has none."""
        coarse = self.roadmap.coarse_plans
        parts = [
            tuple((edge, coarse[edge][0] if edge.in_cell else None) for edge in part)
            for part in split_route(route.edges)
        ]
        self.report(f"planning the route, in parts: {len(parts)}")
        # Several processes would report at the same time.
        report, failures = self.report if self.jobs == 1 else Reporter(None), list[PlanFailure]()

        def plan_one(part: RoutePart) -> PartPlan | PlanFailure | None:
            """Plan a part; None if another one has no plan."""
            begin = replace(problem, start=part[0][0].start.z)
            result = None if failures else plan_part(begin, part, options, report)
            if isinstance(result, PlanFailure):
                failures.append(result)
            return result

        cached = self.roadmap.part_plans
        keys = [(tuple((e, c and c.duration) for e, c in part), repr(options)) for part in parts]
        # Parts through cells, which take longest, come first; the first failure ends the loop.
        on_borders = [not part[0][0].in_cell for part in parts]
        order = sorted(range(len(parts)), key=on_borders.__getitem__)
        pending = takewhile(lambda k: not isinstance(cached.get(keys[k]), PlanFailure), order)
        new = [k for k in pending if keys[k] not in cached]
        tasks: list[Task[Any]] = [partial(plan_one, parts[k]) for k in new]
        limit = MAX_RATIO * self.estimate(route)
        if self.jobs > 1 and not self.previous and not self._bound:
            # The lower bound is computed in parallel, up to more than the duration of the plan.
            tasks.append(partial(bound_borders, self.search, limit))
        results = run_tasks(tasks, self.jobs)
        for bound in results[len(new) :]:
            self._bound = limit, bound
        cached.update({keys[k]: result for k, result in zip(new, results, strict=False) if result})
        for k in order:
            if isinstance(result := cached.get(keys[k]), PlanFailure):
                offset = sum(len((plan or edge).steps) for part in parts[:k] for edge, plan in part)
                result.edges = self._find_failed(route, [offset + n for n in result.phases])
                return result
        # Without failure all parts are planned.
        return [cast(PartPlan, cached[key]) for key in keys]

    def bound(self, duration: float, in_cells: bool) -> BorderBound:
        """Lower bound of all routes along borders; for a plan `in_cells` up to its `duration`."""
        limit = duration if in_cells else math.inf
        last_limit, bound = self._bound or (0.0, None)
        if bound is None or min(last_limit, limit) <= bound.value < limit:
            return bound_borders(self.search, limit)
        return bound.up_to(limit)

    def collect_routes(self, heuristic: Heuristic) -> None:
        """Collect routes by a heuristic search, while a better one is possible."""
        n_routes, max_edges = 0, self._n_planned + MAX_EDGES
        for route in self.search.run(heuristic):
            if len(self.routes) >= self.n_plans and self.estimate(route) > self._best:
                return
            if n_routes > self.n_plans + MAX_FAILURES or self._n_planned >= max_edges:
                return
            if self._plan_cells(route):
                n_routes += 1
                self.routes.append(route)
                if len(self.routes) >= self.n_plans:
                    self.search.limit = MAX_RATIO * self._best
                    max_edges = min(max_edges, self._n_planned + MORE_EDGES)

    @property
    def _best(self) -> float:
        """Least estimated time of the routes [s]."""
        return min((self.estimate(route) for route in self.routes), default=float("inf"))

    def _plan_cells(self, route: Route) -> bool:
        """Plan the edges of a route through cells; whether all have a plan."""
        if self._has_failed(route):
            return False
        plans = self.roadmap.coarse_plans
        in_cells = [edge for edge in route.edges if edge.in_cell]
        new = [edge for edge in in_cells if edge not in plans]
        self._n_planned += len(new)
        if new:
            self.report("; ".join(f"planning {describe_steps(edge.steps)}" for edge in new))
        plan = partial(plan_coarsely, self.free, options=self.options, all_guesses=self.all_guesses)
        tasks = [partial(plan, edge, edge.steps) for edge in new]
        for edge, coarse in zip(new, run_tasks(tasks, self.jobs), strict=True):
            plans[edge] = [coarse] if coarse else []
        return all(plans[edge] for edge in in_cells)

    def _refine(self, route: Route) -> None:
        """Optimize the places where a route leaves borders for cells."""
        roadmap, searches = self.roadmap, dict[Edge, partial[list[CoarsePlan]]]()
        for edge, later in pairwise((*route.edges, None)):
            if edge is None or edge.curve is None or edge in roadmap.refined:
                continue
            self.report(f"planning {describe_steps(edge.steps)} in other ways")
            single = later and not later.in_cell and len(later.steps) == 1
            to_go = find_time_to_go(self.problem, later, edge.stop) if later and single else None
            (plan,) = roadmap.coarse_plans[edge]
            searches[edge] = partial(search_release, partial(self._release, edge), plan, to_go)
        roadmap.refined.update(searches)
        if self.jobs > 1 and len(searches) == 1:
            ((edge, search),) = searches.items()
            paths = RefinedPath(None), RefinedPath(-STEPS[0]), RefinedPath(STEPS[0])
            plans = run_tasks([partial(search.args[0], path, None) for path in paths], self.jobs)
            searches[edge] = partial(search, cached=dict(zip(paths, plans, strict=True)))
        results = run_tasks(list(searches.values()), self.jobs)
        for edge, (best, *others) in zip(searches, results, strict=True):
            roadmap.coarse_plans[edge] = [best, *sorted(others, key=lambda plan: plan.duration)]

    def _release(
        self, edge: Edge, path: RefinedPath, stop_plan: CoarsePlan | None
    ) -> CoarsePlan | None:
        """Plan an edge that leaves its border at another place, or without a stop.

        `stop_plan`, which stops on the border, is a guess of the latter.
        """
        first, *rest = edge.steps
        step = EdgeStep(first.contacts, Until(), End.SMOOTH)
        if path.move is not None:
            place = edge.fraction + MIN_STEP * path.move
            if not END_MARGIN < place < 1 - END_MARGIN:
                return None
            assert edge.curve is not None
            z = edge.curve.evaluate(np.array([place * edge.curve.length])).z[0]
            step = first._replace(until=end_at_pose(first.contacts, z))
        # Without a stop all guesses: goal 48 of the corpus has no plan from the first one.
        return plan_coarsely(
            self.free,
            edge,
            (step, *rest),
            self.options,
            straight=path.straight,
            first_only=path.move is not None,
            stop_plan=stop_plan,
        )

    def _has_failed(self, route: Route) -> bool:
        """Whether a route contains edges that have no plan on another route."""
        return any(
            route.edges[k : k + len(failed)] == failed
            for failed in self._failed_edges
            for k in range(len(route.edges))
        )

    def estimate(self, route: Route) -> float:
        """Estimated least time of a plan along the routes to all goals [s]."""
        total = self.time_before
        for edge in route.edges:
            if plans := self.roadmap.coarse_plans.get(edge):
                total += plans[0].duration
            else:
                total += MIN_RATIO * edge.estimate if edge.in_cell else edge.estimate
        return total


class BorderBound(NamedTuple):
    """A lower bound of the duration of routes along borders.

    At junctions of borders they stop, pass smoothly, or have a possible plastic impact.
    """

    value: float  # [s]: no such route takes less
    # whether the search for it ended: at the bound of a route, or at the limit of the search; not
    # at `MAX_PLACES`
    complete: bool

    def up_to(self, limit: float) -> BorderBound:
        """The bound, at most `limit` [s]."""
        return self if self.value < limit else BorderBound(limit, True)


def bound_borders(search: RouteSearch, limit: float) -> BorderBound:
    """Lower bound of all routes along borders, up to `limit` [s].

    Dijkstra's algorithm with coarse bounds of edges. Bounds of edges on the shortest route are
    refined, until all of them are.
    """
    refined, edges_from = set[Edge](), dict[Key, list[Edge]]()
    while True:
        order, settled, edges = count(), set[Key](), tuple[Edge, ...]()
        bound = BorderBound(limit, True)
        queue = [(0.0, next(order), search.start, edges)]
        while queue:
            beat()
            cost, _, place, route = heapq.heappop(queue)
            if cost >= limit:
                break
            if is_at(place, search.goal):
                bound, edges = BorderBound(cost, True), route
                break
            if place.key in settled:
                continue
            if len(settled) >= MAX_PLACES:
                bound = BorderBound(cost, False)
                break
            settled.add(place.key)
            if place.key not in edges_from:
                edges_from[place.key] = list(search.roadmap.collect_edges(place, search.goal))
            for edge in edges_from[place.key]:
                edge_bound = edge.fine_bound if edge in refined else SAFETY * edge.bound
                heapq.heappush(queue, (cost + edge_bound, next(order), edge.stop, (*route, edge)))
        if refined.issuperset(edges):
            return bound
        refined.update(edges)
