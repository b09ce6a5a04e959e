"""Which routes are planned, and what is learnt from those that have no plan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from shipped import HEPTAGON, problem_of
from wholearm.planning.options import PlanOptions
from wholearm.problem.definition import Until
from wholearm.search import route_choice as choosing
from wholearm.search.astar import RoadmapRoute, SearchRule
from wholearm.search.candidates import Lost
from wholearm.search.edges import EdgeStep, Link
from wholearm.search.places import make_place
from wholearm.search.route_choice import Chooser

PROBLEM = problem_of(HEPTAGON)
PLACE = make_place(PROBLEM.scene, PROBLEM.start)


def make_link(duration: float) -> Link:
    steps = (EdgeStep(PLACE.contacts, Until(coordinate="x", value=duration)),)
    return Link(PLACE, PLACE, steps, duration)


class Found:
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
    chooser = Chooser(PROBLEM, [], Found(routes), PlanOptions())  # type: ignore[arg-type]
    chooser.run(1, lambda _: None)
    # The second route has a link of the first one; the third is far longer than what had no plan.
    assert planned == [routes[0].links, routes[2].links]
    assert [route for _, route in chooser.made] == [routes[2]] and len(chooser.failures) == 1
