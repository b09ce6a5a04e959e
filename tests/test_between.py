from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from crossing import make_way, measure_fingers
from plane import finger_gap
from thrown import heave
from timed import instants, plan_landing, stages_of
from wholearm.common.arrays import Array
from wholearm.mechanics.limits import CONE, PRESS, make_limits
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.time_domain.refinement import (
    SETTINGS,
    check_between,
    find_misses,
    measure_misses,
)
from wholearm.planning.time_domain.stage import LimitMisses, Stage
from wholearm.planning.time_domain.time_motion import StageMotion
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.results.trajectory import Trajectory

EPSILON = 0.05


def as_stage(motion: StageMotion, **fields: object) -> Stage:
    stage = Stage(0, motion.formation, motion.directions, motion.points)
    return replace(stage, **fields)  # type: ignore[arg-type]


def in_newtons(stage: Stage, misses: LimitMisses, kind: str) -> Array:
    """Misses of one kind of limits of forces, shape (K, n)."""
    limits = make_limits(stage.formation, EPSILON)
    return (
        misses.held[:, np.isin(limits.sides[0], limits.of(kind))]
        * stage.formation.scene.scales.force
    )


def check(stage: Stage, motion: StageMotion, *least: float) -> LimitMisses:
    return find_misses(stage, check_between(stage, motion), *least)


@lru_cache(maxsize=1)
def landed() -> list[StageMotion]:
    return stages_of(plan_landing(time_intervals=6))


@lru_cache(maxsize=1)
def heaved() -> StageMotion:
    """The first phase of a plan with a rolling contact."""
    problem, _ = heave()
    plans = plan_phases(problem, problem.phases, problem.start, PlanOptions(time_intervals=6))
    return plans[0].motion.stages[0]


def test_a_plan_keeps_limits_between_points_too() -> None:
    """It would not on so few intervals, were limits not tightened there."""
    for motion in landed():
        stage, size = as_stage(motion), motion.formation.scene.scales.force
        misses = check(stage, motion, EPSILON)
        assert misses.held.shape == (stage.intervals, motion.formation.n_contacts + 4)
        assert measure_misses(misses).max() <= 1
        assert motion.evaluate(instants(motion, 41)).c_n.min() > EPSILON - 2 * SETTINGS.miss * size


def test_forces_are_missed_by_what_their_least_value_lacks() -> None:
    inside = np.linspace(1e-9, 1 - 1e-9, 401)
    for motion in landed():
        stage = as_stage(motion)
        t = motion.duration * motion.points.places(inside).ravel()
        dense = motion.evaluate(t).c_n.reshape(stage.intervals, 401, -1)
        asked = float(np.median(dense))
        misses = check(stage, motion, asked)
        expected = np.maximum(asked - dense.min(axis=1), 0.0)
        # Parabolas through 25 checks, of forces that are smooth inside an interval.
        pressed = in_newtons(stage, misses, PRESS)
        np.testing.assert_allclose(pressed, expected, atol=1e-3 * np.ptp(dense))
        assert measure_misses(misses).max() == pytest.approx(misses.held.max() / SETTINGS.miss)
        # A margin asks for as much as a larger epsilon.
        same = check(stage, motion, EPSILON, asked - EPSILON)
        again = in_newtons(stage, same, PRESS)
        np.testing.assert_allclose(again, pressed, atol=1e-12 * asked)


def test_cones_are_missed_by_what_epsilon_takes_from_them_but_the_margin_does_not() -> None:
    motion = heaved()
    stage = as_stage(motion)
    row = motion.formation.rolling_rows[0]
    mu = motion.formation.friction[row]
    dense = motion.evaluate(instants(motion, 200))
    grip = mu * dense.c_n[:, row] - np.abs(dense.c_t[:, row])
    least = grip.reshape(stage.intervals, 200).min(axis=1)
    assert not in_newtons(stage, check(stage, motion, EPSILON), CONE).any()
    large = 1.0 + least.min() / mu
    misses = in_newtons(stage, check(stage, motion, large), CONE).max(axis=1)
    np.testing.assert_allclose(misses, np.maximum(mu * large - least, 0), atol=0.02)
    assert misses.max() > 1.0
    assert not in_newtons(stage, check(stage, motion, EPSILON, large), CONE).any()


@lru_cache(maxsize=1)
def make_way_twice() -> tuple[Trajectory, Trajectory]:
    """Plans of least effort with fingers that pass each other, and with solid ones."""
    options: dict[str, Any] = {"time_intervals": 8, "replay": False}
    passing, solid = (
        solve(make_way(solid), "effort", **options).trajectory for solid in (False, True)
    )
    return passing, solid


def test_the_links_are_kept_apart_between_points_too() -> None:
    """Left alone, finger 1 would let the other link swing through it."""
    passing, solid = make_way_twice()
    scene = make_way(solid=True).scene
    least = []
    for plan in (passing, solid):
        (motion,) = plan.motions
        z = motion.evaluate(np.linspace(0.0, motion.duration, 4001)).z
        least.append(float(measure_fingers(scene, z).min()))
        for k in (0, 1):
            assert finger_gap(scene, z[::20, :3], k, z[::20, 3 + k]).min() > -2e-8
    assert least[0] < -5e-3 and least[1] > -2e-8
    # With less that is allowed effort is larger, to the accuracy of plans.
    assert solid.meta["value"] > (1 - 1e-4) * passing.meta["value"]
