from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from shipped import HEPTAGON
from wholearm.benchmark.lpmotion import slow_margin
from wholearm.benchmark.tracing import weights
from wholearm.options import PlanOptions
from wholearm.outline import connect, outline_phase
from wholearm.problem import Problem, build_problem, read_problem
from wholearm.timedomain.timeplan import plan_phases
from wholearm.timedomain.wayguess import (
    AMPLE,
    find_margin,
    list_goals,
    list_ways,
    split_way,
)


@cache
def tipping() -> Problem:
    """The heptagon tips over its left vertex; to do so, it has to slide."""
    table = dict(read_problem(str(HEPTAGON)).table)
    contacts = ["v0-palm", "v2-finger1", "v5-finger2"]
    return build_problem({**table, "phases": [{"contacts": contacts, "until": {"phi_deg": 9.5}}]})


def test_ends_beside_the_nearest_are_ends_too() -> None:
    problem = tipping()
    (phase,) = problem.phases
    (nearest,) = outline_phase(problem, phase, problem.start)
    goals = np.array(list_goals(phase, problem.start, nearest.z[-1]))
    assert len(goals) > 5 and np.ptp(goals[:, 0]) > 0.01
    assert np.abs(np.degrees(goals[:, 2]) - 9.5).max() < 1e-6
    assert np.abs(phase.formation.evaluate(goals, goals).C).max() < 1e-9


def test_stretches_of_a_way_keep_their_senses() -> None:
    problem = tipping()
    (phase,) = problem.phases
    (nearest,) = outline_phase(problem, phase, problem.start)
    for goal in list_goals(phase, problem.start, nearest.z[-1]):
        way = split_way(connect(phase.formation, problem.start, goal))
        assert (way[0].z[0] == problem.start).all()
        for part, coming in pairwise(way):
            assert (part.z[-1] == coming.z[0]).all() and part.turns
        for part in way:
            steps, middles = np.diff(part.z, axis=0), (part.z[1:] + part.z[:-1]) / 2
            A_t = phase.formation.evaluate(middles, steps).A_t
            along = np.hstack([np.einsum("nij,nj->ni", A_t, steps), steps[:, 3:]])
            signs = np.concatenate(part.directions)
            # But for stretches too short to count.
            assert ((along * signs).sum(axis=0) > 0).all()


def test_margins_are_those_of_newton_and_euler() -> None:
    problem = tipping()
    (phase,) = problem.phases
    best, *_ = list_ways(problem, phase, problem.start, 3)
    assert best.margin > AMPLE
    z = np.concatenate([part.z for part in best.stretches[:1]])
    z_s = np.gradient(z, axis=0)
    z_s /= np.sqrt(z_s**2 @ weights(problem.scene))[:, None]
    own = find_margin(best.stretches[:1], problem.epsilon)
    margin, _ = slow_margin(problem.scene, phase, problem.epsilon, z, z_s)
    assert own == pytest.approx(margin, abs=0.02)


def test_a_way_that_slides_while_it_tips_is_planned() -> None:
    problem = tipping()
    (plan,) = plan_phases(
        problem, problem.phases, problem.start, PlanOptions(time_intervals=5), explained=False
    )
    motion = plan.motion
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 50))
    assert np.degrees(samples.z[-1, 2]) == pytest.approx(9.5, abs=1e-5)
    assert samples.c_n.min() > problem.epsilon - 1e-6


def test_a_release_and_one_freedom_have_no_slow_ways(heptagon: Problem) -> None:
    assert not list_ways(heptagon, heptagon.phases[0], heptagon.start, 3)
