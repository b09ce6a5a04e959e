from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from timed import landing
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.attempts import GAIN, choose_end, keep_apart
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stages import guess_stages


@lru_cache(maxsize=2)
def landed(intervals: int = 8) -> tuple[TimeSearch, TimeSolution]:
    """The landing alone: where along the palm it ends is left open."""
    problem = landing()
    search = TimeSearch.of(problem, PlanOptions())
    start = trace_phases(problem)[-1].end
    stages = guess_stages(problem, problem.phases[4:], start, search.scheme, intervals, 2.0)
    return search, search.solve(stages)


def test_an_end_is_moved_to_where_what_follows_costs_less() -> None:
    """Or kept, where the solver finds nothing better; it does on one of two grids at least."""
    price, gains = 0.5 * np.eye(5)[0], []
    for intervals in (4, 8):
        search, alone = landed(intervals)
        whole = replace(search, to_go=lambda z: (float(price @ z), price))
        priced, moved = choose_end(whole, alone)
        own = moved.cost - priced.charge(moved.end)
        gains.append(alone.cost + price @ alone.end - own - price @ moved.end)
        assert moved is alone or gains[-1] > GAIN * alone.cost
        if moved is not alone:
            # The stages alone cost least where they ended.
            assert own > alone.cost and moved.end[0] < alone.end[0]
    assert max(gains) > GAIN


def test_an_end_from_where_nothing_follows_is_kept() -> None:
    search, alone = landed()

    def fail(_: Array) -> tuple[float, Array]:
        raise InfeasibleError("nothing")

    assert choose_end(replace(search, to_go=fail), alone)[1] is alone


def test_a_stage_ends_clear_of_what_comes_next() -> None:
    _, alone = landed()
    stage = alone.stages[-1]
    open_limits = [limit for limit in stage.formation.limits if limit.gained is not None]
    kept = keep_apart(stage, open_limits[0].gained)
    row = next(k for k, limit in enumerate(stage.formation.limits) if limit is open_limits[0])
    least = kept.list_clearances(np.array([0.1, 0.9]), after=1 / 3)[:, kept.monitored.index(row)]
    assert least.tolist() == [0.0, pytest.approx(kept.clearance)]
