from __future__ import annotations

import numpy as np
import pytest

from plane import measure_gaps, measure_slip
from timed import fastest_landing, instants, integrate, landing, plan_landing
from wholearm.contact import parse_contact
from wholearm.curve import Curve
from wholearm.formation import Formation
from wholearm.model import Array
from wholearm.options import PlanOptions
from wholearm.outline import released_contacts
from wholearm.phaseplan import PhasePlan
from wholearm.plan import solve
from wholearm.problem import Problem
from wholearm.timemotion import StageMotion, TimeMotion
from wholearm.timeplan import plan_phases
from wholearm.trajectory import Trajectory

SLACK = 1e-6
"""What a limit may be missed by between the places that the planner looks at [N or N m]."""
COARSE = 6
"""Intervals where only what a plan is for is looked at, not how good it is."""


@pytest.fixture(scope="module")
def motions() -> list[TimeMotion]:
    return fastest_landing()


@pytest.fixture(scope="module")
def stages(motions: list[TimeMotion]) -> list[StageMotion]:
    return [stage for motion in motions for stage in motion.stages]


@pytest.fixture(scope="module")
def coarse() -> list[PhasePlan[TimeMotion]]:
    return plan_landing(time_intervals=COARSE)


@pytest.fixture(scope="module")
def gentle() -> list[PhasePlan[TimeMotion]]:
    return plan_landing(objective="effort", time_intervals=COARSE)


def effort(plans: list[PhasePlan[TimeMotion]]) -> float:
    return sum(plan.torque.integrate_squares() + plan.motion.duration for plan in plans)


@pytest.mark.parametrize("phase", [0, 1, 3])
def test_least_times_agree_with_those_along_the_curve(
    heptagon: Problem, curves: tuple[Curve, ...], trajectory: Trajectory, phase: int
) -> None:
    start = heptagon.start if phase == 0 else curves[phase - 1].end
    options = PlanOptions(transcription="time", time_intervals=30)
    (plan,) = plan_phases(heptagon, (heptagon.phases[phase],), start, options)
    # Two discretisations of one problem. Torques that jump inside an interval cost the coarser.
    expected = trajectory.meta["phase_durations"][phase]
    assert plan.motion.duration == pytest.approx(expected, rel=1e-3)
    assert plan.value == plan.motion.duration
    assert plan.motion.stages[0].directions.Xi.tolist() == curves[phase].segments[0].Xi.tolist()
    np.testing.assert_allclose(plan.motion.end.z, curves[phase].end, atol=1e-8)
    np.testing.assert_allclose(plan.motion.end.v, 0.0, atol=1e-8)


def test_the_whole_problem_can_be_planned_in_the_time_domain(
    heptagon: Problem, trajectory: Trajectory
) -> None:
    plan = solve(heptagon, transcription="time", time_intervals=8)
    assert all(isinstance(motion, TimeMotion) for motion in plan.motions)
    assert plan.meta["transcription"] == "time"
    # Coarse, so slower: never faster than the least time but by what both miss.
    ratio = np.array(plan.meta["phase_durations"]) / trajectory.meta["phase_durations"]
    assert (ratio > 0.998).all() and (ratio < 1.03).all()
    assert np.nanmin(plan.c_n) > heptagon.epsilon - SLACK
    assert np.abs(plan.tau).max() < 2.0 + SLACK


def test_friction_never_pushes_the_wrong_way(stages: list[StageMotion]) -> None:
    for stage in stages:
        samples = stage.evaluate(instants(stage, 12))
        states = zip(samples.z, samples.z_dot, strict=True)
        slip = np.array([measure_slip(stage.formation, z, v) for z, v in states])
        joints = samples.z_dot[:, 3:]
        # At a reversal, slip between points is known to the error of collocation.
        assert (slip * stage.directions.Xi).min() > -1e-4 * np.abs(slip).max()
        assert (joints * stage.directions.sigma).min() > -1e-4 * np.abs(joints).max()


def test_forces_and_torques_keep_their_limits_between_points(stages: list[StageMotion]) -> None:
    problem = landing()
    for stage in stages:
        samples = stage.evaluate(instants(stage, 41))
        assert samples.c_n.min() > problem.epsilon - SLACK
        assert (np.abs(samples.tau) < problem.scene.torque_limit + SLACK).all()


def test_formations_stay_valid_between_points(stages: list[StageMotion]) -> None:
    for stage in stages:
        limits = stage.formation.evaluate_limits(stage.evaluate(instants(stage, 12)).z)
        # What is gained or released is right on its limit at one end [m].
        assert limits.min() > -1e-7


def test_some_limit_is_used_all_along(stages: list[StageMotion]) -> None:
    problem = landing()
    used = []
    for stage in stages:
        samples = stage.evaluate(instants(stage, 12))
        room = np.abs(problem.scene.torque_limit - np.abs(samples.tau)).min(axis=1)
        used.append(np.minimum(room, samples.c_n.min(axis=1) - problem.epsilon))
    # Least time: the torque or the force of one finger is at its limit nearly everywhere.
    assert np.mean(np.concatenate(used) < 0.02) > 0.75


def test_the_released_contact_opens(motions: list[TimeMotion]) -> None:
    problem = landing()
    (released,) = released_contacts(*problem.phases[4:])
    assert released.name == "v3-finger1"
    gaps = Formation(problem.scene, (released,))
    before, after = motions
    t = np.linspace(0.0, after.duration, 200)
    opening = np.array([measure_gaps(gaps, z)[0] for z in after.evaluate(t).z])
    assert abs(opening[0]) < 1e-9 and opening.min() > -1e-9
    assert opening[-1] > 1e-4
    # Held before, so it opens from zero speed, and it does not touch again.
    assert (opening[20:] > 1e-6).all()
    held = [measure_gaps(gaps, z)[0] for z in before.evaluate(np.linspace(0, before.duration, 9)).z]
    assert np.abs(held).max() < 1e-12


def test_the_object_lands_at_rest_on_its_next_edge(motions: list[TimeMotion]) -> None:
    problem, end = landing(), motions[-1].end
    scene = problem.scene
    edge = Formation(scene, tuple(parse_contact(f"v{k}-palm", scene) for k in (1, 2)))
    assert np.abs(measure_gaps(edge, end.z)).max() < 1e-9
    assert end.z[2] == pytest.approx(scene.polygon.flush_angle(1), abs=1e-8)
    # The solver's tolerance of 1e-8, of speeds of up to 20 rad/s.
    np.testing.assert_allclose(end.v, 0.0, atol=1e-6)
    last = motions[-1].evaluate(motions[-1].duration - np.array([2e-3, 1e-3, 0.0]))
    heights = [measure_gaps(edge, z)[1] for z in last.z]
    assert heights[0] > heights[1] > 0


def test_phases_are_joined_while_moving(motions: list[TimeMotion]) -> None:
    before, after = motions
    np.testing.assert_array_equal(before.end.z, after.stages[0].start.z)
    np.testing.assert_array_equal(before.end.v, after.stages[0].start.v)
    assert np.abs(before.end.v).max() > 1.0


def test_the_torques_alone_carry_the_object_to_its_goal(stages: list[StageMotion]) -> None:
    z, v = stages[0].start
    for stage in stages:
        z, v = integrate(stage, z, v)
        # The error of every stage so far, for a motion that nothing holds to its plan [m, rad].
        np.testing.assert_allclose(z, stage.points.z[-1], atol=1e-5)
    np.testing.assert_allclose(v, 0.0, atol=1e-3)


def test_finer_plans_are_replayed_more_exactly(coarse: list[PhasePlan[TimeMotion]]) -> None:
    def miss(motions: list[TimeMotion]) -> float:
        errors = [
            np.abs(integrate(stage, *stage.start)[0] - stage.points.z[-1]).max()
            for motion in motions
            for stage in motion.stages
        ]
        return float(max(errors))

    finer = miss(fastest_landing())
    # From 6 intervals to the default, with another solution each time: no clean order.
    assert finer < 0.3 * miss([plan.motion for plan in coarse])


@pytest.mark.parametrize("which", ["time", "effort", "margin"])
def test_values_are_those_of_the_objective(
    coarse: list[PhasePlan[TimeMotion]], gentle: list[PhasePlan[TimeMotion]], which: str
) -> None:
    if which == "time":
        assert [plan.value for plan in coarse] == [plan.motion.duration for plan in coarse]
        return
    if which == "effort":
        assert sum(plan.value for plan in gentle) == pytest.approx(effort(gentle), rel=1e-12)
        return
    allowed = 2.0 * sum(plan.motion.duration for plan in coarse)
    plans = plan_landing(objective="margin", time_intervals=COARSE, duration=allowed)
    assert sum(plan.motion.duration for plan in plans) < allowed * (1 + 1e-8)
    stages = [stage for plan in plans for stage in plan.motion.stages]
    least = min(stage.evaluate(instants(stage, 12)).c_n.min() for stage in stages)
    assert plans[0].value == plans[1].value
    # Forces keep to it between points too, where limits are tightened a little too much.
    assert plans[0].value < least + SLACK
    assert plans[0].value == pytest.approx(least, rel=2e-3)
    assert plans[0].value > 0.5


def test_the_effort_of_a_gentle_plan_is_least(
    coarse: list[PhasePlan[TimeMotion]], gentle: list[PhasePlan[TimeMotion]]
) -> None:
    assert effort(gentle) < 0.9 * effort(coarse)
    times = [sum(plan.motion.duration for plan in plans) for plans in (coarse, gentle)]
    assert times[0] < times[1]
    stages = [stage for plan in gentle for stage in plan.motion.stages]
    least = min(stage.evaluate(instants(stage, 12)).c_n.min() for stage in stages)
    assert least > landing().epsilon - SLACK


def test_plans_are_the_same_every_time(coarse: list[PhasePlan[TimeMotion]]) -> None:
    again = plan_landing(time_intervals=COARSE)

    def tables(plans: list[PhasePlan[TimeMotion]]) -> list[Array]:
        return [
            table
            for plan in plans
            for stage in plan.motion.stages
            for table in (*stage.points[1:], np.array([stage.duration]))
        ]

    for one, other in zip(tables(coarse), tables(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert [plan.iterations for plan in coarse] == [plan.iterations for plan in again]
