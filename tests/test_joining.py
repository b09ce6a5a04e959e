from __future__ import annotations

import numpy as np

from shipped import HEPTAGON, problem_of
from wholearm.planning.options import PlanOptions
from wholearm.planning.result import Plan
from wholearm.problem.goal import Goal
from wholearm.search.chart import Chart
from wholearm.search.find import Search
from wholearm.search.joining import Kept, join_route
from wholearm.search.links import Link
from wholearm.search.measure import Measured
from wholearm.search.places import make_place

# Where plans come from does not depend on how accurate they are.
OPTIONS = PlanOptions(accuracy=0.1, replay=False)


def join(links: tuple[Link, ...], kept: Kept, jobs: int) -> Plan:
    own = [(link, list[Measured]()) for link in links]
    plan = join_route(problem_of(HEPTAGON), own, OPTIONS, kept, lambda _: None, jobs)
    assert isinstance(plan, Plan), plan
    return plan


def test_links_planned_at_the_same_time_make_the_same_plan() -> None:
    problem = problem_of(HEPTAGON)
    search = Search(Chart(problem, 0.1), make_place(problem.scene, problem.start), Goal(flush=6))
    route = next(search.run())
    assert len(route.links) > 1
    kept: Kept = {}
    one, other = join(route.links, {}, 1), join(route.links, kept, 2)
    assert one.duration == other.duration
    assert np.array_equal(one.trajectory.z, other.trajectory.z)
    # What solving has cost is said of each phase, wherever it was done, and of plans kept as well.
    again = join(route.links, kept, 1)
    for mine, theirs, kept_one in zip(one.phases, other.phases, again.phases, strict=True):
        assert mine.statistics.solves > 0 and mine.statistics.iterations > 0
        assert mine.statistics.iterations == theirs.statistics.iterations
        assert mine.statistics.iterations == kept_one.statistics.iterations
