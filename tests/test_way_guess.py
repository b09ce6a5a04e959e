from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from shipped import tipping
from wholearm.benchmark.stress.event_tracing import weights
from wholearm.benchmark.stress.slow_motion import fast_margin
from wholearm.common.errors import InfeasibleError
from wholearm.geometry.path_guess import connect, guess_phase
from wholearm.mechanics.limits import PRESS, TORQUE
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.initial_path import (
    SURE,
    WayForces,
    list_goals,
    list_ways,
    split_way,
)
from wholearm.planning.time_domain.time_explain import refuse_ways
from wholearm.planning.time_domain.time_plan import plan_phases


def test_stretches_of_a_way_keep_their_senses() -> None:
    problem = tipping()
    (phase,) = problem.phases
    (nearest,) = guess_phase(phase, problem.start)
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


def test_one_thing_turns_at_a_time() -> None:
    """Where a way turns back everything turns at once; a motion must not have to stop for that."""
    problem = tipping()
    (phase,) = problem.phases
    (nearest,) = guess_phase(phase, problem.start)
    there = connect(phase.formation, problem.start, nearest.z[-1])
    back = replace(there, z=np.concatenate([there.z, there.z[-2::-1]]))
    whole, way = split_way(there), split_way(back)
    signs = [np.concatenate(part.directions) for part in way]
    assert len(way) > 2 * len(whole) and (signs[-1] == -signs[0]).all()
    for part, coming, before, after in zip(way, way[1:], signs, signs[1:], strict=False):
        turned = np.flatnonzero(before != after)
        assert part.turns == tuple(turned)
        assert set(turned) == set(phase.formation.turn_with(int(turned[0])))
        assert (part.z[-1] == coming.z[0]).all() and len(part.z) > 2
    assert (way[0].z[0] == problem.start).all() and (way[-1].z[-1] == problem.start).all()


def test_margins_are_those_of_newton_and_euler() -> None:
    problem = tipping()
    (phase,) = problem.phases
    best, *_ = list_ways(problem, phase, problem.start, 3)
    assert best.margin > SURE
    part = best.stretches[0]
    s = np.append(0.0, np.cumsum(np.sqrt(np.diff(part.z, axis=0) ** 2 @ weights(problem.scene))))
    course = s, part.z, np.gradient(part.z, s, axis=0, edge_order=2)
    own = WayForces([part], problem.epsilon).find_margin()
    other = fast_margin(problem.scene, phase, problem.epsilon, course)
    # One looks at the middles of the intervals, the other one at their ends.
    assert other - 0.02 < own < other + 0.1
    # What epsilon takes of all normal forces, it takes of the margin at most.
    more = problem.epsilon + 0.05 * problem.scene.scales.force
    assert own - 0.05 - 1e-9 <= WayForces([part], more).find_margin() <= own + 1e-9


@pytest.mark.parametrize("key", ["torque_limit2", "epsilon"])
def test_ways_that_miss_a_limit_are_refused_with_it(key: str) -> None:
    problem = tipping()
    ways = list_ways(problem, problem.phases[0], problem.start, 1)
    refuse_ways(problem, problem.phases[0], ways)
    # Fingers too weak to hold the object on its vertex; forces as large as strong ones can have.
    problem = problem.with_({key: {"torque_limit2": 0.01, "epsilon": 60.0}[key]})
    ways = list_ways(problem, problem.phases[0], problem.start, 1)
    with pytest.raises(InfeasibleError, match=r"at any speed: .* short at the best") as caught:
        refuse_ways(problem, problem.phases[0], ways)
    (missed,) = caught.value.shortfalls
    assert missed.share == -ways[0].margin > 0 and missed.limit in str(caught.value)
    limits = {"torque_limit2": (TORQUE, "finger 2"), "epsilon": (PRESS, missed.part)}
    assert (missed.kind, missed.part) == limits[key]


def test_a_brisk_motion_keeps_half_the_margin_and_ends_at_rest() -> None:
    problem = tipping()
    best, *_ = list_ways(problem, problem.phases[0], problem.start, 1)
    profile = best.profile
    assert profile is not None and profile.t[0] == 0.0 and profile.s[-1] == pytest.approx(1.0)
    assert (np.diff(profile.t) > 0).all() and (np.diff(profile.s) > 0).all()
    speeds = np.diff(profile.s) / np.diff(profile.t)
    assert speeds[[0, -1]].max() < speeds.max()
    # No faster than gravity and the torques allow; no slower than a few falls over its length.
    length = sum(part.length for part in best.stretches)
    assert profile.forces.shape == (len(profile.t) - 1, problem.phases[0].formation.n_constraints)
    least = problem.epsilon / problem.scene.scales.force
    assert profile.forces[:, : problem.phases[0].formation.n_contacts].min() > least - 1e-9
    assert 0.1 < profile.t[-1] / np.sqrt(length / problem.scene.gravity) < 20.0


def test_a_way_that_slides_while_it_tips_is_planned() -> None:
    problem = tipping()
    (plan,) = plan_phases(
        problem,
        problem.phases,
        problem.start,
        PlanOptions(time_intervals=4, accuracy=1e-2),
        explained=False,
    )
    motion = plan.motion
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 50))
    assert np.degrees(samples.z[-1, 2]) == pytest.approx(9.5, abs=1e-5)
    assert samples.c_n.min() > problem.epsilon - 1e-6
