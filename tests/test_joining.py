"""Routes put together from their links, and what is tried where a link has no plan."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from shipped import HEPTAGON, problem_of
from wholearm.common.arrays import Array
from wholearm.common.errors import ReplayError
from wholearm.planning.block_plan import BlockPlan, Planning
from wholearm.planning.options import PlanOptions
from wholearm.planning.result import Plan
from wholearm.problem.definition import Until
from wholearm.problem.goal import Goal
from wholearm.search import edge_plans as joining
from wholearm.search.astar import RouteSearch
from wholearm.search.candidates import Lost
from wholearm.search.edge_plans import BackgroundTask, Cache, PlannedLink, join_route, key_steps
from wholearm.search.edges import EdgeStep, Link
from wholearm.search.feasibility import Measured
from wholearm.search.places import make_place
from wholearm.search.roadmap import Roadmap

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


def test_a_link_from_a_crossing_is_alone_to_blame() -> None:
    first, second = (Link(PLACE, PLACE, make_steps(x), 1.0) for x in (0.01, 0.02))
    plans = Plans(second.steps)
    lost = join_route(PROBLEM, [(first, []), (second, [])], PlanOptions(), plans, lambda _: None)
    assert isinstance(lost, Lost) and lost.links == (second,)
    assert plans.asked == [key_steps(first.steps), key_steps(second.steps)]


def test_where_a_plan_never_holds_it_is_landed_with_regard_to_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    landing = Link(PLACE, PLACE, make_steps(0.02), 1.0, in_cell=True)
    onward = Link(PLACE, PLACE, make_steps(0.03), 1.0)
    ways = [Measured(1.0, make_steps(x), []) for x in (0.021, 0.022)]
    plans, finished = Plans(), list[int]()

    def finish(made: Planning, *rest: object) -> str:
        finished.append(len(made.problem.phases))
        if len(finished) == 1:
            raise ReplayError("does not hold, however fine it is")
        return "holds"

    monkeypatch.setattr(joining, "finish_plan", finish)
    monkeypatch.setattr(joining, "assemble_plan", lambda made: None)
    fails = SimpleNamespace(failure=(2, "a contact is lost"))
    found = SimpleNamespace(culprit=2, usually=fails)
    checked = SimpleNamespace(of=lambda *given: found)
    monkeypatch.setattr(joining, "Checked", checked)
    links = [(landing, ways), (onward, list[Measured]())]
    assert join_route(PROBLEM, links, PlanOptions(), plans, lambda _: None) == "holds"
    # The border has no other ways: its plan is first refined, then the landing chosen anew.
    tried = [key for key in plans.asked if key != key_steps(onward.steps)]
    assert tried == [key_steps(ways[0].steps), key_steps(landing.steps)] and finished == [2, 2]
