from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from wholearm.benchmark.stress.event_tracing import follow, resample
from wholearm.benchmark.stress.slow_motion import fast_margin, inertia_ratio, slow_margin
from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve
from wholearm.mechanics.dynamics import Directions, reduced_inertia
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.problem.definition import Phase, Problem
from wholearm.scene.model import Friction, Scene

Course = tuple[Array, Array, Array]


@pytest.fixture(scope="module")
def course(heptagon: Problem, curves: tuple[Curve, ...]) -> tuple[Phase, Course]:
    phase = heptagon.phases[2]
    start = curves[2].evaluate(np.zeros(1)).z[0]
    (reached,) = (way for way in follow(heptagon.scene, phase, start) if way.reached)
    return phase, resample(heptagon.scene, phase, reached, 12)


def _weaker(scene: Scene, share: float) -> Scene:
    fingers = [replace(f, torque_limit=share * f.torque_limit) for f in scene.fingers]
    return replace(scene, fingers=(fingers[0], fingers[1]))


def test_where_a_plan_exists_a_motion_keeps_the_limits(
    heptagon: Problem, course: tuple[Phase, Course]
) -> None:
    phase, (s, z, z_s) = course
    slow, _ = slow_margin(heptagon.scene, phase, heptagon.epsilon, z, z_s)
    fast = fast_margin(heptagon.scene, phase, heptagon.epsilon, (s, z, z_s))
    assert 0.0 < slow <= fast + 1e-9


def test_friction_that_may_be_any_in_its_cone_only_allows_more(
    heptagon: Problem, course: tuple[Phase, Course]
) -> None:
    phase, curve = course
    scene = replace(heptagon.scene, friction=Friction(0.4, 0.4, 0.4))
    strict = fast_margin(scene, phase, heptagon.epsilon, curve)
    assert fast_margin(scene, phase, heptagon.epsilon, curve, loose=10.0) > strict + 1e-3


def test_a_larger_epsilon_takes_no_more_than_itself_from_the_margin(
    heptagon: Problem, course: tuple[Phase, Course]
) -> None:
    phase, (_, z, z_s) = course
    margin, _ = slow_margin(heptagon.scene, phase, heptagon.epsilon, z, z_s)
    more = 0.5 * margin
    epsilon = heptagon.epsilon + more * heptagon.scene.scales.force
    less, _ = slow_margin(heptagon.scene, phase, epsilon, z, z_s)
    assert margin - more - 1e-9 <= less < margin


def test_planner_and_linear_programme_agree_on_the_weakest_hand(
    heptagon: Problem, curves: tuple[Curve, ...], course: tuple[Phase, Course]
) -> None:
    """The planner still finds a motion where the programme has room, and the margin says so."""
    phase, (s, z, z_s) = course
    plan = plan_path(curves[2], heptagon.epsilon, PlanOptions(intervals=20), phase.number)
    peak = float(np.abs(plan.motion.evaluate(plan.motion.times).tau).max())
    scene = _weaker(heptagon.scene, 1.001 * peak / 2.0)
    assert fast_margin(scene, phase, heptagon.epsilon, (s, z, z_s)) >= -1e-9


def test_inertia_is_that_of_the_determinant(
    heptagon: Problem, course: tuple[Phase, Course], curves: tuple[Curve, ...]
) -> None:
    phase, (_, z, z_s) = course
    rough = replace(heptagon.scene, friction=Friction(0.6, 0.9, 0.9))
    formation = replace(phase.formation, scene=rough)
    ratios = inertia_ratio(rough, replace(phase, formation=formation), z, z_s)
    part = curves[2].segments[0]
    own = reduced_inertia(
        formation, formation.evaluate(z[:1], z_s[:1]), Directions(part.Xi, part.sigma)
    )
    assert ratios[0] == pytest.approx(own[0], rel=1e-9)
