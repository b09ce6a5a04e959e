from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from timed import landing, plan_landing, total
from wholearm.common.arrays import Array
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.attempts import GAIN, choose_end
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stages import guess_stages
from wholearm.planning.time_domain.tightening import find_least
from wholearm.planning.time_domain.time_mesh import spread_halvings


def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Slopes, and rows of a polygon about zero with their slack, some of them touching it."""
    box = np.tile(np.concatenate([np.eye(2), -np.eye(2)]), (count, 1, 1))
    rows = np.concatenate([rng.normal(size=(count, 3, 2)), box], axis=1)
    slack = rng.uniform(0.0, 2.0, rows.shape[:2]) * (rng.uniform(size=rows.shape[:2]) > 0.2)
    return rng.normal(size=(count, 2)), rows, slack


def test_the_least_over_a_polygon_is_that_of_a_linear_programme() -> None:
    slopes, rows, slack = draw(np.random.default_rng(0), 30)
    least = find_least(slopes, 0.0, rows, slack)
    for k, slope in enumerate(slopes):
        answer = linprog(slope, -rows[k], slack[k], bounds=(None, None))
        assert least[k] == pytest.approx(answer.fun, abs=1e-9)
    assert (least < -0.1).sum() > 10


def test_the_least_square_over_a_polygon_is_that_of_a_solver() -> None:
    slopes, rows, slack = draw(np.random.default_rng(1), 30)
    least = find_least(slopes, 0.4, rows, slack)
    for k, slope in enumerate(slopes):
        limits = {"type": "ineq", "fun": lambda u, k=k: rows[k] @ u + slack[k]}
        answer = minimize(lambda u, g=slope: g @ u + 0.4 * u @ u, np.zeros(2), constraints=limits)
        assert least[k] == pytest.approx(answer.fun, abs=1e-6)
    assert len(set(np.round(least, 6))) > 10


def test_what_is_held_moves_along_its_limit_alone() -> None:
    slopes, rows, slack = draw(np.random.default_rng(2), 5)
    held = np.array([0.6, 0.8])
    both = np.concatenate([rows, np.tile([held, -held], (5, 1, 1))], axis=1)
    least = find_least(slopes, 0.0, both, np.hstack([slack, np.zeros((5, 2))]))
    way = np.array([-0.8, 0.6])
    for k, slope in enumerate(slopes):
        along = rows[k] @ way
        with np.errstate(divide="ignore"):
            ends = -slack[k] / along
        farthest = ends[along < 0].min(), ends[along > 0].max()
        assert least[k] == pytest.approx(min(slope @ way * end for end in farthest), abs=1e-9)


def test_the_estimated_error_is_about_that_of_a_finer_plan() -> None:
    coarse, fine = plan_landing(time_intervals=6), plan_landing()
    lost = total(coarse) / total(fine) - 1
    assert fine[0].error < PlanOptions().accuracy < coarse[0].error == coarse[1].error
    assert lost == pytest.approx(coarse[0].error - fine[0].error, rel=0.6)


def test_largest_shares_of_an_error_are_halved_first() -> None:
    shares = [np.array([1e-3, 1e-6, 4e-5]), np.array([3e-4, 0.0])]
    times = spread_halvings(shares, 1e-4)
    left = [share / 4.0**own for share, own in zip(shares, times, strict=True)]
    assert [own.tolist() for own in times] == [[2, 0, 1], [2, 0]]
    assert sum(own.sum() for own in left) < 2e-4
    assert not any(own.any() for own in spread_halvings(shares, 1e-2))


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
