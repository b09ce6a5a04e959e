"""Plans over time: contact modes, impacts, pinned ends; impacts of plans along curves too."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import scenes
import shipped
import wholearm
import wholearm.planning.time_domain.guesses as guesses
from once import once
from plane import finger_gap, make_formation, measure_gaps, measure_slip, unbalance
from planned import plan_landing as known_landing
from timed import fastest_landing, instants, integrate, landing, plan_landing, stages_of, total
from wholearm import End, PlanOptions, Problem, Trajectory, verify
from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mapping.formation_list import write_template
from wholearm.mechanics.dynamics import Directions, close_contacts, metric_weights
from wholearm.mechanics.impact import compute_impact
from wholearm.planning.blocks import ImpactSequence
from wholearm.planning.nlp import Solver, build_solver
from wholearm.planning.path_domain.path_plan import Task, plan_curves
from wholearm.planning.phase_plan import PlanPart, plan_stops
from wholearm.planning.plan import solve
from wholearm.planning.time_domain import time_nlp, time_plan
from wholearm.planning.time_domain.guesses import NEAREST_END, Guess, guess_stages, list_stages
from wholearm.planning.time_domain.mode_search import drop, link, mode_of, with_mode
from wholearm.planning.time_domain.solution import (
    ITERATIONS,
    SETTINGS,
    TimeSearch,
    TimeSolution,
    minimize_quadratic,
)
from wholearm.planning.time_domain.stage import Stage, in_scene_units, resample
from wholearm.planning.time_domain.time_motion import StageMotion, TimeMotion
from wholearm.planning.time_domain.time_nlp import pack
from wholearm.planning.time_domain.time_plan import plan_phases, try_phases
from wholearm.problem.read import build_problem, read_problem
from wholearm.results.report import DEPARTURE
from wholearm.results.trajectory import Samples
from wholearm.verification.verify import Allowance, describe_failures

SLACK = 1e-6
"""What a limit may be missed by between the places that the planner looks at [N or N m]."""
ANY = -5.0
"""Least uniqueness margin of a palm so rough that a vertex rolls on it however it is heaved."""
COARSE = 6
"""Intervals where only what a plan is for is looked at, not how good it is."""
SCHEMES = [("radau", 2), ("radau", 5), ("legendre", 3)]


@pytest.fixture(scope="module")
def stages() -> list[StageMotion]:
    return [stage for motion in fastest_landing() for stage in motion.stages]


THROWN: dict[str, Any] = {"time_intervals": 8, "mode_search": False, "replay": False}
THROWN["uniqueness_margin"] = ANY


@cache
def thrown(
    throw: Callable[[], tuple[Problem, float]], objective: str = "time"
) -> tuple[Problem, Trajectory, float]:
    """A problem of one and two contacts, its plan, and the time that its second phase takes."""
    problem, expected = throw()
    return problem, solve(problem, objective, **THROWN).trajectory, expected


def statistics(stages: list[StageMotion]) -> float:
    """Integral of tau^T tau plus the duration, by the midpoint rule."""
    squares = [(stage.evaluate(instants(stage, 100)).tau ** 2).sum(axis=1) for stage in stages]
    weights = [np.repeat(stage.points.fractions, 100) / 100 for stage in stages]
    parts = zip(stages, squares, weights, strict=True)
    return sum(stage.duration * (1.0 + float(own @ share)) for stage, own, share in parts)


def test_least_times_agree_with_those_along_the_curve(
    curves: tuple[Curve, ...], trajectory: Trajectory
) -> None:
    """The heptagon's last slide, over time."""
    problem = shipped.part_of(shipped.problem_of(shipped.HEPTAGON), 2, 3)
    expected = trajectory.meta["phase_durations"][2]
    plan = solve(problem, transcription="time", time_intervals=8, replay=False).trajectory
    (motion,) = plan.motions
    assert isinstance(motion, TimeMotion) and plan.meta["transcription"] == "time"
    assert verify(problem, plan).ok
    assert np.nanmin(plan.c_n) > problem.epsilon - SLACK
    assert np.abs(plan.tau).max() < 2.0 + SLACK
    # Two discretisations of one problem: torques are linear over a 16th of the phase here, or half
    # of that where they switch, so that it takes longer.
    assert -1e-4 < motion.duration / expected - 1 < 1e-3
    end = motion.stages[-1].points.nodes[-1]
    np.testing.assert_allclose(end[0], curves[2].end, atol=1e-8)
    np.testing.assert_allclose(end[1], 0.0, atol=1e-6)
    # Friction is against the motion, which one freedom leaves no choice.
    check_friction(motion.stages)


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_schemes_and_degrees_agree(
    heptagon: Problem, curves: tuple[Curve, ...], trajectory: Trajectory, name: str, degree: int
) -> None:
    options = PlanOptions(scheme=name, degree=degree, time_intervals=12)
    plans = plan_phases(heptagon, (heptagon.phases[3],), curves[2].end, options)
    # Intervals end where torques switch; what is left is that these are linear in between.
    above = total(plans) / trajectory.meta["phase_durations"][3] - 1
    assert -1e-5 < above < 1e-3
    stage = plans[0].motion.stages[0]
    z, _ = integrate(stage, *stage.points.nodes[0])
    error = np.abs(z - stage.points.nodes[-1, 0]).max()
    # What collocation misses over the phase [m, rad], falling with the order.
    assert error < {3: 1e-4, 4: 1e-5}.get(stage.scheme.order, 1e-6)


def test_rolling_contacts_are_planned_like_along_the_curve() -> None:
    """The phase in which the box tips over a vertex."""
    problem = shipped.part_of(scenes.box(), 1, 2)
    options: dict[str, Any] = {"time_intervals": 16, "mode_search": False, "accuracy": 1e-2}
    within = solve(problem, transcription="time", replay=False, **options)
    # Torques that are linear in each interval cost less than the accuracy asked for.
    assert -1e-4 < within.duration / scenes.tipped().meta["phase_durations"][1] - 1 < 1e-2
    rolls = problem.phases[0].formation.rolling
    (motion,) = within.trajectory.motions
    assert isinstance(motion, TimeMotion) and len(rolls) == 1
    for stage in motion.stages:
        samples = stage.evaluate(instants(stage, 9))
        for k, contact in enumerate(stage.formation.contacts):
            if contact in rolls:
                grip = scenes.PALM * (samples.c_n[:, k] - problem.epsilon)
                assert (grip - np.abs(samples.c_t[:, k])).min() > -SLACK
                slip = measure_slip(stage.formation, samples.z, samples.z_dot)
                assert np.abs(slip[:, k]).max() < 1e-12
    assert verify(problem, within).ok


def test_a_contact_passes_from_a_link_over_its_tip_to_an_edge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its three features follow in one motion, and an impact that leaves the tip."""
    monkeypatch.setattr("wholearm.planning.plan._find_saving", lambda *_: np.nan)
    whole = build_problem(tomllib.loads(scenes.LYING))
    passing = shipped.part_of(whole, 3)
    options: dict[str, Any] = {"replay": False, "accuracy": 1e-3}
    along = solve(passing, **options)
    within = solve(passing, transcription="time", time_intervals=4, **options)
    # Either is good to the accuracy that is asked for.
    assert within.duration == pytest.approx(along.duration, rel=1e-3)
    speeds = [plan.meta["transitions"][-1]["speed"] for plan in (within, along)]
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-2)
    assert [len(phase.modes) for phase in within.phases] == [1, 1, 1, 1]


def test_modes_without_freedom_are_refused_without_the_solver(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """A single interval with constant torques, at whose end two contacts turn back."""
    search = TimeSearch(landing(), PlanOptions(), controls=1)
    stage = list_stages(plan_landing())[-1]
    guess = resample(stage.guess, search.scheme, np.array([0.0, 1.0]))
    solution = search.solve([replace(stage, guess=guess, reversals=(0, 1))])
    assert not solution.success and "more equations than unknowns" in solution.status
    assert capfd.readouterr() == ("", "")


def test_contacts_that_reverse_at_one_place_do_not_stop_the_motion() -> None:
    """On the square both fingers reverse halfway, by symmetry."""
    halfway = shipped.part_of(shipped.problem_of(shipped.SQUARE), 1, 2)
    options: dict[str, Any] = {"replay": False, "accuracy": 1e-3}
    along, within = solve(halfway, **options), solve(halfway, transcription="time", **options)
    assert within.duration == pytest.approx(along.duration, rel=2e-3)  # errors of both
    assert len(within.phases[0].modes) == 2


THROWS = [(scenes.shove, "radau"), (scenes.heave, "radau"), (scenes.lift, "radau")]


@pytest.mark.parametrize("throw, name", [*THROWS, (scenes.heave, "legendre")])
def test_what_moves_by_itself_takes_its_time(
    throw: Callable[[], tuple[Problem, float]], name: str
) -> None:
    problem, plan, expected = thrown(throw)
    if name != "radau":
        plan = solve(problem, scheme=name, **THROWN).trajectory
    # One or two contacts are left, and with them four or three freedoms.
    formation = problem.phases[1].formation
    assert formation.n_constraints == 2 - (throw is scenes.lift)
    # Collocation misses a falling body by powers of an eighth of its time; a sliding one, whose
    # acceleration is constant, not at all.
    accuracy = 1e-12 if throw is scenes.shove else 2e-8
    assert plan.meta["phase_durations"][1] == pytest.approx(expected, rel=accuracy)
    assert verify(problem, plan, uniqueness_margin=ANY).ok
    motion = plan.motions[1]
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 50))
    y, phi = samples.z[:, 1], samples.z[:, 2]
    if throw is scenes.shove:
        # Weight and friction, whose moment the two forces share: closed form.
        weight = problem.scene.polygon.mass * 9.81
        lean = 0.3 * 0.03 / 0.06
        shares = np.array([0.5 + lean, 0.5 - lean]) * weight
        np.testing.assert_allclose(samples.c_n, np.tile(shares, (50, 1)), rtol=1e-9)
        np.testing.assert_allclose(samples.z_ddot[:, 0], 0.3 * 9.81, rtol=1e-9)
    else:
        body = problem.scene.polygon
        rates = samples.z_dot[:, :3]
        kinetic = 0.5 * rates**2 @ np.array([body.mass, body.mass, body.inertia or 0.0])
        energy = kinetic + body.mass * 9.81 * y
        # Nothing takes energy away; the potential energy changes by millijoules.
        assert np.ptp(energy) < 1e-7
        if throw is scenes.lift:
            np.testing.assert_allclose(rates[:, 0], 0.0, atol=1e-7)
        assert phi[-1] == pytest.approx(problem.phases[1].until.value, abs=1e-8)


@pytest.mark.parametrize("throw, objective", [(scenes.shove, "margin"), (scenes.heave, "effort")])
def test_one_and_two_contacts_are_planned_for_every_objective(
    throw: Callable[[], tuple[Problem, float]], objective: str
) -> None:
    problem, fastest, expected = thrown(throw)
    plan = thrown(throw, objective)[1]
    # The second phase has no choice; the first one has.
    assert plan.meta["phase_durations"][1] == pytest.approx(expected, rel=1e-6)
    assert plan.meta["phase_durations"][0] > fastest.meta["phase_durations"][0]
    least = [float(np.nanmin(trajectory.c_n)) for trajectory in (fastest, plan)]
    assert min(least) > problem.epsilon - SLACK
    if objective == "margin":
        # Phases without a choice may limit both.
        assert least[1] > least[0] - SLACK
        one, other = plan.meta["phase_values"]
        assert one == other


def check_friction(stages: Sequence[StageMotion]) -> None:
    """Friction of contacts and joints is against the motion."""
    for stage in stages:
        samples = stage.evaluate(instants(stage, 12))
        slip = measure_slip(stage.formation, samples.z, samples.z_dot)
        for rates, signs in zip((slip, samples.z_dot[:, 3:]), stage.directions, strict=True):
            # At a reversal, slip between points is known to the error of collocation.
            assert (rates * signs).min() > -1e-4 * np.abs(rates).max()


def test_limits_hold_between_points_and_some_limit_is_used_all_along(
    stages: list[StageMotion],
) -> None:
    problem, used = landing(), []
    check_friction(stages)
    for stage in stages:
        samples = stage.evaluate(instants(stage, 41))
        assert samples.c_n.min() > problem.epsilon - SLACK
        assert (np.abs(samples.tau) < problem.scene.torque_limit + SLACK).all()
        # What is gained or released is right on its limit at one end [m].
        assert stage.formation.evaluate_limits(samples.z).min() > -1e-7
        room = np.abs(problem.scene.torque_limit - np.abs(samples.tau)).min(axis=1)
        used.append(np.minimum(room, samples.c_n.min(axis=1) - problem.epsilon))
    # Least time: the torque or the force of one finger is near its limit nearly everywhere.
    assert np.mean(np.concatenate(used) < 0.05) > 0.75


def test_the_released_contact_opens() -> None:
    gaps = make_formation(landing().scene, "v3-finger1")
    before, after = fastest_landing()
    t = np.linspace(0.0, after.duration, 200)
    opening = measure_gaps(gaps, after.evaluate(t).z)[:, 0]
    assert abs(opening[0]) < 1e-9 and opening.min() > -1e-9
    assert opening[-1] > 1e-4
    # Held before, so it opens from zero speed, and it does not touch again.
    assert (opening[100:] > 1e-5).all() and (opening[20:] > 1e-7).all()
    held = measure_gaps(gaps, before.evaluate(np.linspace(0, before.duration, 9)).z)
    assert np.abs(held).max() < 1e-9


def test_little_less_friction_takes_little_more_time() -> None:
    """The landing with friction 0.06 is that with 0.07, continued: no limit of it is far."""
    lasts = []
    for friction in (0.07, 0.06):
        problem = shipped.part_of(shipped.problem_of(shipped.HEPTAGON).with_(friction=friction), 4)
        given = problem, problem.phases, problem.start, PlanOptions()
        lasts.append(total(plan_phases(*given, coarse=True)))
    assert lasts[1] == pytest.approx(lasts[0], rel=0.03)


def test_given_modes_are_compared_where_their_plan_takes_far_longer() -> None:
    """The modes and poses of a plan of 0.094 s lead the solver to one of 0.37 s by themselves."""
    corners = np.array([[0.0, 0.0], [0.06, 0.0], [0.085, 0.035], [0.045, 0.075], [-0.005, 0.05]])
    table = tomllib.loads(write_template("pentagon", vertices=corners, mass=0.22))
    modes = [
        {"t": 0.03595, "x": -0.0215248, "phi_deg": 129.47072, "signs": "+-- --"},
        {"t": 0.07190, "x": 0.00024108, "phi_deg": 115.12488, "signs": "+-- --"},
        {"t": 0.09446, "x": 0.00245673, "phi_deg": 118.36311, "signs": "+++ --"},
    ]
    phase = {"contacts": ["v4-palm", "v1-finger1", "v2-finger2"], "guess": modes}
    table["phases"].append(phase | {"until": {"contact": "v0-finger1", "x": 0.00245673267}})
    for finger, x in (("1", 0.0743), ("2", -0.0743)):
        table["fingers"][finger]["base"][0] = x
    problem = build_problem(table)
    z = np.array([-0.03378038, 0.04124561, 2.36886814, 2.37978117, 1.58346998])
    (plan,) = plan_phases(problem, problem.phases[1:], z, PlanOptions(), coarse=True)
    assert plan.motion.duration < 0.1


def test_the_torques_alone_carry_the_object_to_its_goal(stages: list[StageMotion]) -> None:
    z, v = stages[0].points.nodes[0]
    for stage in stages:
        z, v = integrate(stage, z, v)
        # The error of every stage so far, for a motion that nothing holds to its plan [m, rad].
        np.testing.assert_allclose(z, stage.points.nodes[-1, 0], atol=1e-5)
    np.testing.assert_allclose(v, 0.0, atol=1e-3)


def test_the_value_of_a_margin_is_the_least_force() -> None:
    problem, allowed, options = scenes.raised(), 0.07, PlanOptions("margin", time_intervals=COARSE)
    plans = plan_phases(problem, problem.phases, problem.start, options, allowed)
    # With more time it would be larger.
    assert total(plans) == pytest.approx(allowed, rel=1e-8)
    least = min(stage.evaluate(instants(stage, 12)).c_n.min() for stage in stages_of(plans))
    # Forces keep to it between points too, where limits are tightened a little too much.
    assert plans[0].value < least + SLACK
    assert plans[0].value == pytest.approx(least, rel=2e-3)
    assert plans[0].value > 5 * problem.epsilon


def test_values_are_times_and_efforts_and_the_effort_of_a_gentle_plan_is_least() -> None:
    coarse = plan_landing(time_intervals=COARSE)
    assert [plan.value for plan in coarse] == [plan.motion.duration for plan in coarse]
    gentle = plan_landing(objective="effort", time_intervals=COARSE)
    stages = stages_of(gentle)
    effort = statistics(stages)
    assert sum(plan.value for plan in gentle) == pytest.approx(effort, rel=1e-4)
    assert effort < 0.9 * statistics(stages_of(coarse))
    assert total(coarse) < sum(stage.duration for stage in stages)
    least = min(stage.evaluate(instants(stage, 12)).c_n.min() for stage in stages)
    assert least > landing().epsilon - SLACK


def test_plans_are_the_same_every_time() -> None:
    """Nothing is left of what was planned before, nor of what was planned in between."""
    (problem, _), (other, _) = scenes.shove(), scenes.heave()
    plans = [
        plan_phases(each, each.phases, each.start, PlanOptions(time_intervals=COARSE))
        for each in (problem, other, problem)
    ]
    for one, again in zip(stages_of(plans[0]), stages_of(plans[2]), strict=True):
        for before, after in zip(one.points, again.points, strict=True):
            expected = np.asarray(before, dtype=float)
            size = np.abs(expected).max(initial=0.0)
            found = np.asarray(after, dtype=float)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * size)


def test_equations_of_motion_hold_and_contacts_are_closed_at_any_instant(
    stages: list[StageMotion],
) -> None:
    rng = np.random.default_rng(8)
    for stage in stages:
        formation = stage.formation
        samples = stage.evaluate(np.sort(rng.uniform(0, stage.duration, 40)))
        sigma = np.tile(stage.directions.sigma, (40, 1))
        residual, size = unbalance(formation, samples, sigma)
        # Rounding of sums of a few terms.
        assert (np.abs(residual) < 1e-11 * size).all()
        law = -formation.friction * stage.directions.Xi * samples.c_n
        np.testing.assert_allclose(samples.c_t, law, rtol=1e-12)
        assert np.abs(measure_gaps(formation, samples.z)).max() < 1e-14
        kinematics = formation.evaluate(samples.z, samples.z_dot)
        opening = np.einsum("nij,nj->ni", kinematics.P, samples.z_dot)
        change = np.einsum("nij,nj->ni", kinematics.P, samples.z_ddot) + kinematics.P_dot_v
        # Rounding, of speeds of some m/s and accelerations of some 100 m/s^2.
        assert np.abs(opening).max() < 1e-13 and np.abs(change).max() < 1e-9


def test_velocities_are_derivatives(stages: list[StageMotion]) -> None:
    for stage in stages:
        t, h = instants(stage, 10), 1e-3 * stage.duration / len(stage.points.h)
        around = [stage.evaluate(t + k * h) for k in (-2, -1, 1, 2)]
        weights = np.array([1, -8, 8, -1]) / (12 * h)
        z_dot = np.tensordot(weights, [part.z for part in around], 1)
        z_ddot = np.tensordot(weights, [part.z_dot for part in around], 1)
        samples = stage.evaluate(t)
        # Pulling onto the contacts is no part of the derivative, nor is the error of collocation
        # that is spread over an interval part of the forces.
        assert np.abs(z_dot - samples.z_dot).max() < 1e-6 * np.abs(samples.z_dot).max()
        assert np.abs(z_ddot - samples.z_ddot).max() < 1e-3 * np.abs(samples.z_ddot).max()


def test_stages_and_phases_pass_into_one_another(stages: list[StageMotion]) -> None:
    state = np.stack([stages[0].points.nodes[0, 0], np.zeros(5)])
    for stage in stages:
        # Rounding of velocities that count in the durations of two stages, and the tolerance of
        # the solver.
        np.testing.assert_allclose(stage.points.nodes[0], state, atol=1e-6)
        state = stage.points.nodes[-1]
    np.testing.assert_allclose(state[1], 0.0, atol=1e-6)


PARTS = {"time": (0, 2), "effort": (1, 4)}
"""Phases that are planned: one impact; another, and a stop where no impact is possible."""


@cache
def problem(objective: str) -> Problem:
    part = shipped.part_of(shipped.problem_of(shipped.IMPACTS), *PARTS[objective])
    *moving, last = part.phases
    return replace(part, phases=(*moving, replace(last, end=End.REST)))


@once
def planned(objective: str) -> Trajectory:
    """Plans on few intervals, whose replay is a test of its own."""
    options: dict[str, Any] = {"time_intervals": 4, "replay": False}
    return solve(problem(objective), objective, transcription="time", **options).trajectory


@once
def along(objective: str) -> Trajectory:
    return solve(problem(objective), objective, intervals=80, replay=False).trajectory


def ends_of(trajectory: Trajectory, phase: int) -> tuple[Samples, Samples]:
    """The last sample of a phase and the first one of the next."""
    before, after = trajectory.motions[phase], trajectory.motions[phase + 1]
    return before.evaluate(np.array([before.duration])), after.evaluate(np.zeros(1))


def plan_again() -> float:
    own = solve(problem("time"), time_intervals=4, transcription="time", replay=False)
    return own.value / float(planned("time").meta["value"])


def test_an_impact_is_passed_where_no_motion_comes_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(part: PlanPart, bounds: list[int], *others: Any) -> Any:
        if len(bounds) > 2:
            raise wholearm.InfeasibleError("no motion comes to rest")
        return plan_stops(part, bounds, *others)

    monkeypatch.setattr(time_plan, "plan_stops", stop)
    assert plan_again() == pytest.approx(1, rel=1e-4)


def test_what_fails_near_a_solution_is_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*args: Any, **options: Any) -> Solver:
        if options["max_iter"] > ITERATIONS and "mu_strategy" not in options:
            options["max_iter"] = 1
        return build_solver(*args, **options)

    monkeypatch.setattr(time_nlp, "build_solver", build)
    assert plan_again() == pytest.approx(1, rel=1e-4)


def test_a_worse_optimum_than_along_the_curve_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    solve_guesses = time_plan.solve_guesses

    def worsen(search: TimeSearch, guesses: Sequence[Guess]) -> TimeSolution | None:
        solution = solve_guesses(search, guesses)
        if solution is None or guesses[0].name == NEAREST_END:
            return solution
        stages = [stage.stretch(1.01) for stage in solution.stages]
        return solution._replace(stages=stages, cost=1.01 * solution.cost)

    monkeypatch.setattr(time_plan, "solve_guesses", worsen)
    slide = shipped.part_of(shipped.problem_of(shipped.HEPTAGON), 2, 3)
    along, whole = (solve(slide, transcription=t, replay=False).value for t in ("auto", "time"))
    assert whole == pytest.approx(along, rel=1e-3)


def test_guesses_after_the_homotopy_are_refined_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Case: scene 486 of the stress study, seed 1128: its coarse plans are lost when refined."""
    refined = list[str]()

    def solve_coarse(_: TimeSearch, guess: Guess, most: int) -> Any:
        return SimpleNamespace(success=guess.name > "b", name=guess.name, most=most)

    monkeypatch.setattr(time_plan, "solve_coarse", solve_coarse)
    monkeypatch.setattr(time_plan, "may_gain", lambda *_: True)
    monkeypatch.setattr(time_plan, "is_same", lambda *_: False)
    monkeypatch.setattr(
        time_plan, "_refine_best", lambda _, all: refined.extend(x.name for x in all)
    )
    guesses = [Guess(name, [], homotopy=name == "b") for name in "abcd"]
    slide = shipped.problem_of(shipped.BOX)
    assert time_plan.solve_guesses(TimeSearch(slide, PlanOptions()), guesses) is None
    assert refined[:2] == ["c", "d"]


def test_a_part_of_a_block_starts_at_rest() -> None:
    """Although the plan of the whole block, its guess, passes there at speed."""
    own, options = problem("time"), PlanOptions(time_intervals=4)
    curves = ImpactSequence(own.phases, trace_phases(own)).continuous_curves
    first, free = plan_curves(Task(curves, own.epsilon, options, (1, 2)))
    assert np.abs(free.motion.evaluate(np.zeros(1)).z_dot).max() > 0.1
    z = first.motion.evaluate(np.array([first.motion.duration])).z[0]
    (part,) = plan_phases(own, own.phases[1:], z, options, free_plans=[free])
    assert np.abs(part.motion.evaluate(np.zeros(1)).z_dot).max() < 1e-9


def find_impulses(formation: wholearm.Formation, z: Array, v: Array, v_next: Array) -> Array:
    """Impulses on sliding contacts that explain a jump of z', by least squares: M5 dv = G^T p."""
    kinematics = formation.evaluate(z[None], v_next[None])
    slip = kinematics.A_t[0] @ v_next
    G = kinematics.A[0] - (formation.friction * np.sign(slip))[:, None] * kinematics.A_t[0]
    right = formation.scene.mass_diagonal * (v_next - v)
    p, *_ = np.linalg.lstsq(G.T, right, rcond=None)
    np.testing.assert_allclose(G.T @ p, right, rtol=0, atol=1e-6 * np.abs(right).max())
    return np.asarray(p)


def test_least_times_with_impacts_agree_with_those_along_the_curves() -> None:
    within, expected = planned("time"), along("time").meta["phase_durations"]
    # The planner along curves passes impacts by a condition on speeds alone.
    # Either is good to the accuracy that is asked for, 1e-4.
    assert -1e-4 < within.duration / sum(expected) - 1 < 3e-3
    np.testing.assert_allclose(within.meta["phase_durations"], expected, rtol=5e-3)
    report = verify(problem("time"), within)
    assert report.ok, report.to_text()
    impulses = [phase.impact.impulse for phase in report.phases if phase.impact is not None]
    assert len(impulses) == 1 and min(impulses) > 0


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_transitions_agree_with_those_along_the_curves(objective: str) -> None:
    rows, others = (plan(objective).meta["transitions"] for plan in (planned, along))
    assert [row["phase"] for row in rows] == list(range(1, len(problem(objective).phases)))
    for row, other in zip(rows, others, strict=True):
        for key in ("phase", "gained", "possible", "least_impulse_contact"):
            assert row[key] == other[key]
        assert abs(row["velocity_ratio"]) == pytest.approx(abs(other["velocity_ratio"]), rel=1e-5)
        assert row["least_impulse"] == pytest.approx(other["least_impulse"], rel=1e-4)
        assert row["speed"] == pytest.approx(other["speed"], rel=1e-2)
        if row["possible"]:
            # Both find it as the difference of two plans, each a bit slower than possible.
            assert row["saves"] == pytest.approx(other["saves"], rel=2e-2)
        else:
            assert row["saves"] is None and row["reason"] == other["reason"]


@pytest.mark.parametrize("objective, over_time", list(product(("time", "effort"), (True, False))))
def test_velocities_jump_by_the_impact_law(objective: str, over_time: bool) -> None:
    """Over time impacts are solved for, along curves they are known."""
    plan, own = shipped.plan_of(shipped.IMPACTS, objective), shipped.problem_of(shipped.IMPACTS)
    if over_time:
        plan, own = planned(objective), problem(objective)
    metric, close = metric_weights(own.scene), 1e-5 if over_time else 1e-9
    for k, row in enumerate(plan.meta["transitions"]):
        if not row["possible"]:
            continue
        before, after = (phase.formation for phase in own.phases[k : k + 2])
        end, start = ends_of(plan, k)
        z, v, v_next = end.z[0], end.z_dot[0], start.z_dot[0]
        np.testing.assert_allclose(start.z[0], z, rtol=0, atol=1e-2 * close)
        p = find_impulses(after, z, v, v_next)
        assert p.min() > 0
        speed = np.sqrt(metric @ v**2)
        assert speed > 0.1 and row["speed"] == pytest.approx(speed)
        assert p.min() == pytest.approx(row["least_impulse"] * speed, rel=1e-4)
        assert np.sqrt(metric @ v_next**2) == pytest.approx(row["velocity_ratio"] * speed, rel=1e-5)
        impact = compute_impact(before, after, z, v)
        np.testing.assert_allclose(v_next, impact.v, rtol=0, atol=close)
        assert impact.least_impulse[0] == row["least_impulse_contact"]
        # The contacts of the next formation neither part nor press into one another.
        assert np.abs(measure_gaps(after, z)).max() < 1e-8
        assert np.abs(after.evaluate(z[None], v_next[None]).A[0] @ v_next).max() < close
        energies = [0.5 * own.scene.mass_diagonal @ u**2 for u in (v, v_next)]
        assert energies[1] < energies[0]


def test_least_effort_with_impacts_is_near_that_along_the_curves() -> None:
    within = planned("effort")
    # Torques that are linear in a sixth of a phase cannot be as gentle.
    assert -1e-4 < within.meta["value"] / along("effort").meta["value"] - 1 < 1e-2
    assert verify(problem("effort"), within).ok


def test_an_impact_that_is_not_possible_next_to_a_landing_is_a_stop() -> None:
    """The heptagon's landing and the phase before it."""
    part = shipped.part_of(landing(), 3)
    expected = shipped.plan_of(shipped.LANDING).meta["phase_durations"][3:]
    first, *others = part.phases
    one = replace(part, phases=(replace(first, end=End.IMPACT), *others))
    struck = solve(one, time_intervals=4, replay=False)
    (row,) = struck.meta["transitions"]
    assert (row["phase"], row["possible"], row["gained"]) == (1, False, "v4-finger1")
    assert row["least_impulse"] < 0 and row["least_impulse_contact"] in row["reason"]
    # That phase is planned in the time domain then, and what follows is what it was.
    got = struck.meta["phase_durations"]
    assert -1e-4 < got[0] / expected[0] - 1 < 1e-2
    assert sum(got[1:]) == pytest.approx(sum(expected[1:]), rel=1e-3)


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_it_stops_where_no_impact_is_possible(objective: str) -> None:
    trajectory = shipped.plan_of(shipped.IMPACTS, objective)
    rows = trajectory.meta["transitions"]
    assert [(row["phase"], row["possible"]) for row in rows] == [
        (1, True), (2, True), (3, False), (4, False)
    ]  # fmt: skip
    for k, row in enumerate(rows[2:], start=2):
        for samples in ends_of(trajectory, k):
            assert np.abs(samples.z_dot).max() < 1e-6
        assert (row["speed"], row["saves"]) == (0.0, None)
        contact = row["least_impulse_contact"]
        assert row["reason"].startswith(f"impulse on {contact} would be -0.")
        assert row["reason"].endswith(" N s per m/s") and row["least_impulse"] < 0
    assert [row["reason"] for row in rows[:2]] == ["", ""]
    assert [row["gained"] for row in rows] == "v3-finger1 v6-finger2 v0-finger2 v4-finger1".split()


def test_what_an_impact_saves_is_what_a_stop_costs() -> None:
    meta = shipped.plan_of(shipped.IMPACTS, "effort").meta
    row = meta["transitions"][0]
    stopping = shipped.problem_of(shipped.IMPACTS).with_({f"phases[{row['phase']}].end": "rest"})
    stopped = solve(stopping, "effort", replay=False)
    assert row["saves"] == pytest.approx(stopped.meta["value"] - meta["value"], abs=1e-9)
    assert row["saves"] > 0.01


def slide(*ends: float) -> Problem:
    """The heptagon slides to x [m] and on to others, joined smoothly."""
    whole = shipped.problem_of(shipped.HEPTAGON)
    contacts = whole.table["phases"][0]["contacts"]
    phases = [{"contacts": contacts, "until": {"x": x}, "end": "smooth"} for x in ends]
    return whole.with_({"phases": [*phases[:-1], phases[-1] | {"end": "rest"}]})


def test_a_slide_that_goes_on_smoothly_is_as_fast_as_in_one_piece_and_stops_to_turn_back() -> None:
    ends = (0.02,), (0.035, 0.02), (0.02, 0.03)
    whole, parts, back = (solve(slide(*own), replay=False) for own in ends)
    assert parts.value == pytest.approx(whole.value, rel=1e-4)
    end, start = ends_of(parts.trajectory, 0)
    np.testing.assert_allclose(start.z_dot, end.z_dot, rtol=0, atol=1e-12)
    assert np.abs(end.z_dot).max() > 0.01
    assert parts.transitions == ()
    assert back.phases[0].value == pytest.approx(whole.value, rel=1e-6)
    end, start = ends_of(back.trajectory, 0)
    assert max(np.abs(end.z_dot).max(), np.abs(start.z_dot).max()) < 1e-9


def test_the_links_are_kept_apart_between_points_too() -> None:
    """Left alone, finger 1 would let the other link swing through it."""
    options: dict[str, Any] = {"time_intervals": 8, "replay": False}
    passing, solid = (
        solve(scenes.make_way(solid), "effort", **options).trajectory for solid in (False, True)
    )
    scene, least = scenes.make_way(solid=True).scene, []
    for plan in (passing, solid):
        (motion,) = plan.motions
        z = motion.evaluate(np.linspace(0.0, motion.duration, 4001)).z
        least.append(float(scenes.measure_fingers(scene, z).min()))
        for k in (0, 1):
            assert finger_gap(scene, z[::20, :3], k, z[::20, 3 + k]).min() > -2e-8
    assert least[0] < -5e-3 and least[1] > -2e-8
    # With less that is allowed effort is larger, to the accuracy of plans.
    assert solid.meta["value"] > (1 - 1e-4) * passing.meta["value"]


def test_plans_are_the_same_whichever_way_a_joint_is_guessed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, options = scenes.raised(), PlanOptions(time_intervals=6)

    def guess_wrong(*given: object, **named: object) -> list[Stage]:
        stages = guess_stages(*given, **named)  # type: ignore[arg-type]
        flip = np.array([1.0, -1.0])
        signs = (Directions(own.directions.Xi, flip * own.directions.sigma) for own in stages)
        return link(
            [replace(own, directions=sign) for own, sign in zip(stages, signs, strict=True)]
        )

    (right,) = plan_phases(problem, problem.phases, problem.start, options)
    monkeypatch.setattr(guesses, "guess_stages", guess_wrong)
    (plan,) = plan_phases(problem, problem.phases, problem.start, options)
    assert plan.motion.duration == pytest.approx(right.motion.duration, rel=1e-3)
    check_friction(plan.motion.stages)


def test_changed_stages_begin_and_end_where_they_did() -> None:
    stages = list_stages(plan_landing(time_intervals=COARSE, replay=False))
    last = [stage for stage in stages if stage.phase == stages[-1].phase]
    left = drop(last, 0)
    assert left and np.array_equal(left[0].guess.nodes[0], last[0].guess.nodes[0])
    # A given end determines a pose in modes without freedoms, too.
    stuck, end = with_mode(last[-1], (0.0,) * len(mode_of(last[-1]))), last[-1].guess.nodes[-1, 0]
    (stage,) = Guess("", [stuck]).end_at(end, in_scene_units(landing())).stages
    assert stage.end_pose is not None and np.isfinite(stage.end_pose).sum() == 2


def test_what_may_slide_or_roll_is_faster_than_what_has_to_roll() -> None:
    """Rolling throughout is one of its motions, with one freedom: the bound is along a curve."""
    problem = scenes.tilting()
    (phase,) = problem.phases
    rolls = replace(phase, formation=scenes.roll(phase.formation, "v1-palm"))
    bound = solve(replace(problem, phases=(rolls,)), intervals=10, replay=False)
    plan = solve(problem, time_intervals=6, replay=False)
    assert plan.duration < 0.95 * bound.duration
    assert verify(problem, plan).ok


def test_a_contact_slides_in_one_phase_and_rolls_in_the_next() -> None:
    sliding = scenes.tilting()
    (phase,) = sliding.phases
    rolling = scenes.roll(phase.formation, "v1-palm")
    first = replace(phase, until=wholearm.Until(), end=End.SMOOTH)
    last = replace(phase, index=1, formation=rolling)
    problem = replace(sliding, phases=(first, last))
    plan = solve(problem, time_intervals=5, replay=False).trajectory
    report = verify(problem, plan)
    assert report.ok, report.to_text()
    assert report.phases[0].until == "change of v1-palm"
    ends = np.cumsum([motion.duration for motion in plan.motions])
    # How late a contact comes to rest, or slips, is an error of its speed over what slows it down,
    # or of its force over how fast that grows: no more than a replay may depart.
    assert report.phases[0].arrival == pytest.approx(ends[0], abs=DEPARTURE * ends[1])
    # No interval is halved for ever, and neither phase shrinks to nothing.
    motions = [motion for motion in plan.motions if isinstance(motion, TimeMotion)]
    stages = [stage for motion in motions for stage in motion.stages]
    assert sum(len(stage.points.h) for stage in stages) <= 2 * SETTINGS.intervals
    assert min(motion.duration for motion in plan.motions) > 0.1 * plan.duration
    # What rolls does so all along; what slides has friction against its motion.
    for motion, rolls in zip(motions, (False, True), strict=True):
        for stage in motion.stages:
            samples = stage.evaluate(instants(stage, 12))
            slip = measure_slip(stage.formation, samples.z, samples.z_dot)[:, 0]
            mu = stage.formation.friction[0]
            share = samples.c_t[:, 0] / (mu * samples.c_n[:, 0])
            assert bool(stage.formation.rolling) == rolls
            if rolls:
                assert np.abs(slip).max() < 1e-9 and np.abs(share).max() < 1.0
            else:
                Xi = stage.directions.Xi[0]
                assert mu > 0 and (slip * Xi).min() > -1e-4 * np.abs(slip).max()
                np.testing.assert_allclose(share, -Xi, rtol=1e-9)


def pin(problem: Problem, index: int, *pins: tuple[str, float]) -> Problem:
    phases = list(problem.phases)
    phases[index] = replace(phases[index], until=replace(phases[index].until, pins=pins))
    return replace(problem, phases=tuple(phases))


def test_a_landing_comes_to_rest_where_it_is_pinned() -> None:
    """Also beside the end that is the fastest, and far from the nearest."""
    problem = pin(landing(), 5, ("x", 0.0195))
    start = trace_phases(problem)[-1].end
    # All guesses: what a single one leads to depends on the last bits.
    plans = plan_phases(problem, problem.phases[4:], start, PlanOptions(time_intervals=4))
    motion = plans[-1].motion
    end = motion.evaluate(np.array([motion.duration]))
    size, speed = problem.scene.scales.length, problem.scene.scales.speed
    assert end.z[0, 0] == pytest.approx(0.0195, abs=1e-7 * size)
    assert np.abs(end.z_dot[0, :2]).max() < 1e-6 * speed
    names = " ".join([*problem.phases[5].formation.names, "v2-palm"])
    formation = make_formation(problem.scene, names)
    assert np.abs(measure_gaps(formation, end.z)).max() < 1e-6 * size


def test_with_one_freedom_pins_have_to_agree_with_the_curve() -> None:
    problem = shipped.problem_of(shipped.HEPTAGON)
    x, phi = trace_phases(problem)[0].end[[0, 2]].tolist()
    same = pin(problem, 0, ("x", x), ("phi", phi))
    assert trace_phases(same)[0].end.tolist() == trace_phases(problem)[0].end.tolist()
    with pytest.raises(
        wholearm.InputError, match=r"v3-finger1 at x = .* is never reached"
    ) as caught:
        trace_phases(pin(problem, 0, ("x", x + 1e-3)))
    assert caught.value.key == "phases[1].until"
    assert caught.value.problem.endswith("; one freedom leaves no choice")


def test_another_place_than_the_one_pinned_fails() -> None:
    problem, trajectory = known_landing()
    simulation = wholearm.simulate(problem, trajectory.torque)
    allowance, length = Allowance(), problem.scene.scales.length
    for off, missed in ((0.0, False), (0.9, False), (1.1, True)):
        # The motion ends at 16 mm.
        x = 0.016 + off * allowance.departure * length
        pinned = replace(simulation, problem=pin(problem, 1, ("x", x)))
        failures = list(describe_failures(pinned, (), None, allowance))
        assert bool(failures) == missed
        for failure in failures:
            assert failure.text.startswith("phase 2 ends at x = 16 mm, phi = ")
            assert failure.text.endswith(f"and not with v2-palm at x = {x:g} m")


def test_a_vertex_in_a_corner_may_go_back_first() -> None:
    """The triangle turns about a vertex in the corner of palm and link, which first goes back."""
    table = dict(read_problem(str(shipped.FOLDER / "triangle.toml")).table)
    turn = {"contacts": ["v1-palm", "v1-finger1", "v0-finger2"], "until": "v2-finger1"}
    problem = build_problem({**table, "phases": [table["phases"][0], turn]})
    phase = problem.phases[1]
    near = np.array([0.030153, 0.02887, -1e-9, 1.032, 2.713])
    z = close_contacts(phase.formation, near, np.zeros(0), ((2, 0.0),))
    assert z is not None
    own = replace(problem, start=z, phases=(replace(phase, index=0),))
    assert verify(own, solve(own, time_intervals=6, replay=False)).ok


def test_the_estimated_error_is_about_that_of_a_finer_plan() -> None:
    coarse, fine = plan_landing(time_intervals=COARSE), shipped.plan_of(shipped.LANDING).meta
    lost = total(coarse) / sum(fine["phase_durations"][4:]) - 1
    error = fine["phase_errors"][4]
    assert error < PlanOptions().accuracy < coarse[0].error == coarse[1].error
    assert lost == pytest.approx(coarse[0].error - error, rel=0.6)


def test_friction_is_worth_what_a_little_less_of_it_saves() -> None:
    """By the envelope theorem: as much as the Lagrangian falls, all else as it is."""
    problem, share = landing(), 1e-3
    start = trace_phases(problem)[-1].end
    least = PlanOptions(objective="effort", time_intervals=8)
    begun = try_phases(problem, problem.phases[4:], start, least, all_guesses=True)
    assert begun is not None
    solution = TimeSearch(problem, least).solve(list_stages(begun))
    assert solution.success

    def value(other: Problem) -> float:
        formations = [phase.formation for phase in in_scene_units(other).phases]
        stages = [replace(one, formation=formations[one.phase]) for one in solution.stages]
        nlp = TimeSearch(other, least).build(stages)
        x = pack([stage.guess for stage in stages], nlp.layouts, 0.0)
        g = nlp.solver.function.get_function("nlp_g")(x, [])
        return float(solution.multipliers["lam_g0"] @ g.full()[:, 0])

    for contact in ("palm", "finger1", "finger2"):
        mu = getattr(problem.scene.friction, contact)
        other = problem.with_({f"friction_{contact}": (1 - share) * mu})
        own = [
            solution.price_friction(k)[
                ..., [name.endswith(contact) for name in stage.formation.names]
            ].sum()
            for k, stage in enumerate(solution.stages)
        ]
        # The other way is less by twice of all there is.
        saved = pytest.approx(share / 2 * sum(own), rel=1e-6, abs=1e-12)
        assert value(problem) - value(other) == saved


@pytest.mark.parametrize("square", [0.0, 0.4])
def test_the_least_over_a_polygon_is_that_of_a_solver(square: float) -> None:
    """Over polygons about zero, some of whose sides touch it."""
    rng, sides = np.random.default_rng(1), np.tile([*np.eye(2), *-np.eye(2)], (30, 1, 1))
    rows = np.concatenate([rng.normal(size=(30, 3, 2)), sides], axis=1)
    slack = rng.uniform(0.0, 2.0, rows.shape[:2]) * (rng.uniform(size=rows.shape[:2]) > 0.2)
    slopes = rng.normal(size=(30, 2))
    least = minimize_quadratic(slopes, square, rows, slack)
    for k, slope in enumerate(slopes):
        limits = {"type": "ineq", "fun": lambda u, k=k: rows[k] @ u + slack[k]}
        answer = minimize(
            lambda u, g=slope: g @ u + square * u @ u, np.zeros(2), constraints=limits
        )
        assert least[k] == pytest.approx(answer.fun, abs=1e-6)
    assert (least < -0.1).sum() > 10


def test_small_turns_take_the_root_of_their_angle() -> None:
    """Bang-bang acceleration over short ways, whose ends are less than a milliradian off."""
    start = math.degrees(shipped.tipping().start[2])
    angles = np.array([1e-4, 5e-4])
    problems = [shipped.tipping(start + math.degrees(angle)) for angle in angles]
    times = [solve(problem, time_intervals=10).value for problem in problems]
    assert times[1] / times[0] == pytest.approx(math.sqrt(angles[1] / angles[0]), rel=0.01)
