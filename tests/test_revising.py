from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from plane import measure_slip
from thrown import lift
from timed import landing, plan_landing, stages_of, tables
from wholearm.dynamics import Directions
from wholearm.model import Array
from wholearm.options import PlanOptions
from wholearm.path import trace_phases
from wholearm.timedomain.collocation import make_scheme
from wholearm.timedomain.revising import adopt, halve, turn_friction, watch_broken
from wholearm.timedomain.stage import Stage
from wholearm.timedomain.staging import LEAST_INTERVALS, outline_stages
from wholearm.timedomain.timemotion import StageMotion, make_motions
from wholearm.timedomain.timesearch import Search, Solution

SCHEME = make_scheme("radau", 3)


def make_stages(motions: list[StageMotion]) -> list[Stage]:
    return [Stage(0, motion.formation, motion.directions, motion.points) for motion in motions]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Those of the landing; every direction of friction is that of the motion."""
    return make_stages(stages_of(plan_landing(time_intervals=6)))


def senses(motion: StageMotion, t: Array) -> Array:
    """Rates of sliding and of joints along the directions that friction has, by plane geometry."""
    samples = motion.evaluate(t)
    states = zip(samples.z, samples.z_dot, strict=True)
    slip = np.array([measure_slip(motion.formation, z, v) for z, v in states])
    rho = motion.formation.scene.polygon.gyration_radius
    rates = np.hstack([slip / rho, samples.z_dot[:, 3:]])
    return np.asarray(rates * np.concatenate(motion.directions))


def test_a_solution_becomes_the_guess(stages: list[Stage]) -> None:
    shifted = [stage.guess._replace(duration=2 * stage.guess.duration) for stage in stages]
    for before, after, guess in zip(stages, adopt(stages, shifted), shifted, strict=True):
        assert after.guess is guess and after.directions is before.directions


def test_only_marked_stages_are_halved(stages: list[Stage]) -> None:
    marked = [np.zeros(stage.intervals, dtype=bool) for stage in stages]
    marked[1][:2] = True
    finer = halve(stages, SCHEME, marked)
    assert finer[0] is stages[0] and finer[1].intervals == stages[1].intervals + 2
    assert finer[1].guess.duration == stages[1].guess.duration


def test_limits_that_are_broken_are_watched_from_then_on(stages: list[Stage]) -> None:
    watched = watch_broken(stages) or stages
    # What is broken already, by less than counts, changes nothing the second time.
    assert watch_broken(watched) is None
    low = watched[-1]
    sunk = low.guess.z.copy()
    sunk[2, 1, 1] -= 0.001
    guess = low.guess._replace(z=sunk)
    changed = watch_broken([*watched[:-1], replace(low, guess=guess)])
    assert changed is not None
    more = set(changed[-1].watched) - set(low.watched)
    values = low.formation.evaluate_limits(sunk[2, 1][None])[0]
    assert more and all(values[k] < -1e-9 for k in more)
    assert [stage.watched for stage in changed[:-1]] == [stage.watched for stage in watched[:-1]]


def test_friction_that_the_motion_follows_is_left_alone() -> None:
    problem = landing()
    options = PlanOptions()
    search = Search(problem, options, SCHEME, None, options.goal)
    start = trace_phases(problem)[-1].end
    guess = outline_stages(problem, problem.phases[4:], start, SCHEME, 8, 2.0)
    solution = search.solve(guess)
    assert solution.success and turn_friction(solution.stages, SCHEME) is None


def stall(stage: Stage, row: int, begin: int, stop: int) -> Stage:
    """The stage with finger 2's joint, or what `row` names, held back in some intervals."""
    v = stage.guess.v.copy()
    v[begin:stop, :, 3 + row] = 0.0
    return replace(stage, guess=stage.guess._replace(v=v))


@pytest.mark.parametrize("begin, stop", [(0, 2), (2, 4), (3, 6), (0, 6)])
def test_a_stage_is_split_where_a_joint_is_held_back(begin: int, stop: int) -> None:
    rng = np.random.default_rng(3)
    motion = stages_of(plan_landing(time_intervals=6))[1]
    part, K, d = motion.points, len(motion.points.fractions), 3
    assert K >= 6
    directions = Directions(np.ones(4), np.ones(2))
    # Only the joints count here: contacts slide along their directions by chance of none.
    v = np.abs(rng.uniform(0.5, 1.0, size=(K, d, 5)))
    A_t = motion.formation.evaluate(part.z.reshape(-1, 5), v.reshape(-1, 5)).A_t
    slip = np.einsum("nij,nj->ni", A_t, v.reshape(-1, 5))
    # Directions that every point of a contact agrees with, or rows that turn.
    mixed = tuple(k for k in range(4) if np.ptp(np.sign(slip[:, k])) > 0)
    directions = Directions(np.sign(slip[0]), np.ones(2))
    guess = part._replace(v=v)
    whole = Stage(7, motion.formation, directions, guess, turns=mixed)
    stage = replace(stall(whole, 1, begin, stop), opens=True)
    pieces = turn_friction([stage], SCHEME)
    assert pieces is not None
    ends = sorted({0, begin, stop, K})
    assert len(pieces) == len(ends) - 1
    for piece, start, end in zip(pieces, ends[:-1], ends[1:], strict=True):
        signs = np.array([1.0, -1.0]) if start == begin else np.ones(2)
        np.testing.assert_array_equal(piece.directions.sigma, signs)
        np.testing.assert_array_equal(piece.directions.Xi, directions.Xi)
        share = part.fractions[start:end].sum()
        assert piece.guess.duration == pytest.approx(share * part.duration, rel=1e-12)
        assert piece.intervals >= LEAST_INTERVALS
        assert piece.opens == (start == 0) and piece.phase == 7
        # Between two pieces the joint turns; the last one ends as the whole did.
        assert piece.turns == (mixed if end == K else (5,))
        np.testing.assert_allclose(piece.guess.nodes[0, 0], part.nodes[start, 0], atol=1e-12)


@lru_cache(maxsize=1)
def lifted() -> tuple[Search, Solution]:
    """Both fingers lift a square; where finger 2 first follows it, its joint is guessed to."""
    problem, _ = lift()
    options = PlanOptions()
    search = Search(problem, options, SCHEME, None, options.goal)
    stages = outline_stages(problem, problem.phases, problem.start, SCHEME, 8, 2.0)
    solution = search.solve(stages)
    assert solution.success
    return search, solution


def test_a_sense_that_is_guessed_wrong_is_turned_where_the_motion_would_rather_go_on() -> None:
    search, wrong = lifted()
    turned = turn_friction(wrong.stages, SCHEME)
    assert turned is not None and len(turned) == len(wrong.stages) + 1
    assert [stage.directions.sigma[1] for stage in turned[:2]] == [1.0, -1.0]
    assert turned[0].turns == (4,)
    right = search.solve(turned)
    assert right.success
    # 46.8 ms instead of 53.7 ms, and every direction is that of the motion.
    assert right.cost < 0.9 * wrong.cost
    for solution in (wrong, right):
        for motion in make_motions(solution.stages, SCHEME):
            t = np.linspace(0.0, 1.0, 200) * motion.duration
            rates = senses(motion, t)
            # At reversals rates are known to the error of collocation.
            assert rates.min() > -1e-3 * np.abs(rates).max()


@pytest.mark.parametrize("row", range(5))
def test_directions_that_cannot_be_are_no_solution(row: int) -> None:
    search, wrong = lifted()
    signs = np.concatenate(wrong.stages[0].directions)
    signs[row] *= -1
    stage = replace(wrong.stages[0], directions=Directions(signs[:3], signs[3:]))
    answer = search.solve([stage, *wrong.stages[1:]])
    if answer.success:
        motion = make_motions(answer.stages, SCHEME)[0]
        rates = senses(motion, np.linspace(0.0, 1.0, 200) * motion.duration)
        assert rates.min() > -1e-3 * np.abs(rates).max()


def test_halving_by_nothing_keeps_every_table(stages: list[Stage]) -> None:
    finer = halve(stages, SCHEME, [np.zeros(stage.intervals, dtype=bool) for stage in stages])
    for before, after in zip(stages, finer, strict=True):
        for one, other in zip(tables(before.guess), tables(after.guess), strict=True):
            np.testing.assert_array_equal(one, other)
