"""Routes that are joined, chosen and refined, and what is tried where an edge has no plan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from shipped import HEPTAGON, problem_of
from wholearm.common.arrays import Array
from wholearm.planning.blocks import BlockPlan
from wholearm.planning.options import PlanOptions
from wholearm.planning.result import Plan
from wholearm.problem.definition import Until
from wholearm.problem.goal import Goal
from wholearm.search import route_choice as choosing
from wholearm.search.astar import RoadmapRoute, RouteSearch, SearchRule
from wholearm.search.edge_plans import (
    BackgroundTask,
    Cache,
    Lost,
    PlannedLink,
    join_route,
    key_steps,
)
from wholearm.search.edges import EdgeStep, Link
from wholearm.search.feasibility import Measured
from wholearm.search.places import make_place
from wholearm.search.roadmap import Roadmap
from wholearm.search.route_choice import FINEST, STEPS, Chooser, Found, RefinedPath, ReleaseSearch

# Where plans come from does not depend on how accurate they are.
OPTIONS = PlanOptions(accuracy=0.1, replay=False)


def join(
    links: tuple[Link, ...], kept: Cache, jobs: int, aside: BackgroundTask[int] | None = None
) -> Plan:
    own = [(link, list[Measured]()) for link in links]
    plan = join_route(problem_of(HEPTAGON), own, OPTIONS, kept, lambda _: None, jobs, aside)
    assert isinstance(plan, Plan), plan
    return plan


def test_links_planned_at_the_same_time_make_the_same_plan() -> None:
    problem = problem_of(HEPTAGON)
    search = RouteSearch(
        Roadmap(problem, 0.1), make_place(problem.scene, problem.start), Goal(flush=6)
    )
    route = next(search.run())
    assert len(route.links) > 1
    kept: Cache = {}
    asides = [BackgroundTask(lambda: 7) for _ in range(2)]
    one, other = join(route.links, {}, 1, asides[0]), join(route.links, kept, 2, asides[1])
    assert [own.result for own in asides] == [None, 7]
    # Solves in another process may differ in the last bits, and by the solver's tolerance then.
    assert one.duration == pytest.approx(other.duration, rel=1e-6)
    assert one.trajectory.z[-1] == pytest.approx(other.trajectory.z[-1], abs=1e-6)
    # What solving has cost is said of each phase, wherever it was done, and of plans kept as well.
    again = join(route.links, kept, 1)
    for mine, theirs, kept_one in zip(one.phases, other.phases, again.phases, strict=True):
        assert mine.statistics.solves > 0 and mine.statistics.iterations > 0
        assert theirs.statistics.iterations == kept_one.statistics.iterations


PROBLEM = problem_of(HEPTAGON)
PLACE, PHASE = make_place(PROBLEM.scene, PROBLEM.start), PROBLEM.phases[0]


def make_steps(x: float) -> tuple[EdgeStep, ...]:
    return (EdgeStep(PLACE.contacts, Until(coordinate="x", value=x)),)


class Still(BlockPlan):
    """A plan that ends where it starts."""

    @property
    def end(self) -> Array:
        return self.start


class Plans(dict[Any, Any]):
    """Plans of every link, but of those with some steps, and what has been asked for."""

    def __init__(self, without: tuple[EdgeStep, ...] = ()) -> None:
        super().__init__()
        self.without, self.asked = key_steps(without), list[Any]()

    def __contains__(self, key: object) -> bool:
        return True

    def __getitem__(self, key: Any) -> Any:
        self.asked.append(key[1])
        if key[1] == self.without:
            return "too short of force"
        return PlannedLink((PHASE,), (Still((PHASE,), PROBLEM.start, 0, None, [], [], None),), ())


def test_where_nothing_leads_on_another_landing_is_tried() -> None:
    first = Link(PLACE, PLACE, make_steps(0.01), 1.0)
    landing = Link(PLACE, PLACE, make_steps(0.02), 1.0, in_cell=True)
    onward = Link(PLACE, PLACE, make_steps(0.03), 1.0)
    ways = [Measured(1.0, make_steps(x), []) for x in (0.021, 0.022)]
    plans = Plans(onward.steps)
    links = [(first, []), (landing, ways), (onward, [])]
    lost = join_route(PROBLEM, links, PlanOptions(), plans, lambda _: None)
    assert isinstance(lost, Lost) and "too short of force" in lost
    # The landing decides whether the border after it can be set out on, the border before does not.
    assert lost.links == (landing, onward)
    tried = [key for key in plans.asked if key not in (key_steps(first.steps), plans.without)]
    assert tried == [key_steps(own) for own in (*(way.steps for way in ways), landing.steps)]


def make_link(duration: float) -> Link:
    steps = (EdgeStep(PLACE.contacts, Until(coordinate="x", value=duration)),)
    return Link(PLACE, PLACE, steps, duration)


class FoundRoutes:
    """A search that finds some routes, each once, as long as they are within its limit."""

    def __init__(self, routes: Sequence[RoadmapRoute]) -> None:
        self.roadmap = SimpleNamespace(measured={}, others={}, joined={}, plans={}, refined=set())
        self.limit, self.waiting = math.inf, list(routes)

    def run(self, rule: SearchRule) -> Iterator[RoadmapRoute]:
        for route in list(self.waiting):
            if route.duration <= self.limit:
                self.waiting.remove(route)
                yield route


def test_what_has_no_plan_neither_bounds_nor_is_tried_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, lost, good = (make_link(duration) for duration in (0.1, 0.2, 0.9))
    routes = [RoadmapRoute((one, lost)), RoadmapRoute((lost, one, one)), RoadmapRoute((good, one))]
    planned = list[Any]()

    def join(problem: Any, links: Any, *rest: Any) -> Any:
        planned.append(tuple(link for link, _ in links))
        if lost in planned[-1]:
            return Lost.at((lost,), "no plan")
        return SimpleNamespace(value=1.0)

    monkeypatch.setattr(choosing, "join_route", join)
    chooser = Chooser(PROBLEM, [], FoundRoutes(routes), PlanOptions())  # type: ignore[arg-type]
    chooser.run(1, lambda _: None)
    # The second route has a link of the first one; the third is far longer than what had no plan.
    assert planned == [routes[0].links, routes[2].links]
    assert [route for _, route in chooser.made] == [routes[2]] and len(chooser.failures) == 1


def plan_of(duration: float) -> Measured:
    return Measured(duration, (), [])


class Cell:
    """Ways that take longer away from a best place, and none beyond an end."""

    def __init__(self, best: int, end: int, moving: float | None = None, saved: float = 0) -> None:
        self.best, self.end, self.moving, self.saved = best, end, moving, saved
        self.tried: list[RefinedPath] = []

    def __call__(self, way: RefinedPath) -> Found:
        assert way not in self.tried
        self.tried.append(way)
        if way.move is None:
            return "no guess leads to a plan" if self.moving is None else plan_of(self.moving)
        if way.move < self.end:
            return "no guess leads to a plan"
        saved = 0.0 if way.straight else self.saved
        return plan_of(1 + FINEST * abs(way.move - self.best) - saved)

    def leave(self) -> list[Measured]:
        return ReleaseSearch(self, plan_of(1 + FINEST * abs(self.best))).run()


@pytest.mark.parametrize(("best", "end"), [(0, -1), (-7, -8), (5, -20), (-3, -3)])
def test_a_border_is_left_where_that_is_best(best: int, end: int) -> None:
    cell = Cell(best, end)
    found, *others = cell.leave()
    assert found.duration == pytest.approx(1, abs=1e-9)
    assert all(own.duration >= found.duration for own in others)
    assert RefinedPath(0) not in cell.tried


def test_a_border_that_no_other_place_is_better_for_may_be_left_in_motion() -> None:
    cell = Cell(-1, -20, moving=0.9)
    found, *others = cell.leave()
    assert cell.tried == [RefinedPath(-STEPS[0]), RefinedPath(STEPS[0]), RefinedPath(None)]
    assert found.duration == 0.9 and len(others) == 3
    # Where another place is better, that is gone on with.
    other = Cell(-7, -20, moving=0.9)
    assert other.leave()[0].duration == pytest.approx(1) and RefinedPath(None) not in other.tried
