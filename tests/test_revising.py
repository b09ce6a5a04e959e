from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from timed import plan_landing, stages_of, tables
from wholearm.timedomain.collocation import make_scheme
from wholearm.timedomain.revising import adopt, halve, watch_broken
from wholearm.timedomain.stage import Stage
from wholearm.timedomain.timemotion import StageMotion

SCHEME = make_scheme("radau", 3)


def make_stages(motions: list[StageMotion]) -> list[Stage]:
    return [Stage(0, motion.formation, motion.directions, motion.points) for motion in motions]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Those of the landing; every direction of friction is that of the motion."""
    return make_stages(stages_of(plan_landing(time_intervals=6)))


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


def test_halving_by_nothing_keeps_every_table(stages: list[Stage]) -> None:
    finer = halve(stages, SCHEME, [np.zeros(stage.intervals, dtype=bool) for stage in stages])
    for before, after in zip(stages, finer, strict=True):
        for one, other in zip(tables(before.guess), tables(after.guess), strict=True):
            np.testing.assert_array_equal(one, other)
