from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from timed import plan_landing, stages_of
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.time_mesh import (
    AT_ONCE,
    DEAR,
    DEFECT,
    bisect_intervals,
    cap_halvings,
    count_halvings,
    monitor_violated,
)
from wholearm.planning.time_domain.time_motion import StageMotion

SCHEME = make_scheme("radau", 3)


def make_stages(motions: list[StageMotion]) -> list[Stage]:
    return [Stage(0, motion.formation, motion.directions, motion.points) for motion in motions]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Those of the landing; every direction of friction is that of the motion."""
    return make_stages(stages_of(plan_landing(time_intervals=6)))


def test_only_marked_stages_are_halved(stages: list[Stage]) -> None:
    times = [np.zeros(stage.intervals, dtype=int) for stage in stages]
    times[1][:2] = 1, 2
    finer = bisect_intervals(stages, SCHEME, times)
    assert finer[0] is stages[0] and finer[1].intervals == stages[1].intervals + 4
    assert finer[1].guess.duration == stages[1].guess.duration


@pytest.mark.parametrize("name, degree", [("radau", 2), ("radau", 3), ("legendre", 3)])
def test_defects_that_shrink_with_the_order_need_one_round(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    rng = np.random.default_rng(1)
    sizes = DEFECT * 10 ** rng.uniform(-3, 3, 40)
    defects = sizes[:, None, None] * rng.uniform(-1, 1, (40, 2, 5))
    defects[:, 1, 2] = -sizes
    times = count_halvings(np.zeros(40), defects, scheme)
    left = sizes * 0.5 ** (scheme.order * times)
    assert (left <= DEFECT)[times < AT_ONCE].all()
    # Once less would not have done.
    assert (left * 2**scheme.order > DEFECT)[times > 0].all()
    assert set(times[sizes < DEFECT].tolist()) == {0}


def test_dearer_misses_are_halved_more_often() -> None:
    prices = DEAR * np.array([0.0, 0.9, 1.1, 10.0, 100.0, 1e9])
    times = count_halvings(prices, np.zeros((6, 2, 5)), SCHEME)
    assert times[:3].tolist() == [0, 0, 1] and times[-1] == AT_ONCE
    assert (np.diff(times) >= 0).all()


def test_limits_that_are_broken_are_watched_from_then_on(stages: list[Stage]) -> None:
    monitored = monitor_violated(stages) or stages
    # What is broken already, by less than counts, changes nothing the second time.
    assert monitor_violated(monitored) is None
    low = monitored[-1]
    sunk = low.guess.z.copy()
    sunk[2, 1, 1] -= 0.001
    guess = low.guess._replace(z=sunk)
    changed = monitor_violated([*monitored[:-1], replace(low, guess=guess)])
    assert changed is not None
    more = set(changed[-1].monitored) - set(low.monitored)
    values = low.formation.evaluate_limits(sunk[2, 1][None])[0]
    assert more and all(values[k] < -1e-9 for k in more)
    assert [stage.monitored for stage in changed[:-1]] == [
        stage.monitored for stage in monitored[:-1]
    ]


def test_intervals_are_quartered_only_where_that_makes_few() -> None:
    times = [np.array([2, 0, 1]), np.array([2, 2])]
    for wanted, own in zip(times, cap_halvings(times, 15), strict=True):
        assert (wanted == own).all()
    first, second = cap_halvings(times, 14)
    assert first.tolist() == [1, 0, 1] and second.tolist() == [1, 1]
