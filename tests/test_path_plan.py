from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from plane import measure_slip, place_corners, unbalance, with_speed_limit
from shipped import HEPTAGON, plan_of, problem_of
from tipping import box, tip
from toys import Toy, constant
from wholearm.common.arrays import Array, Expression
from wholearm.common.errors import InfeasibleError, JammingError, SolverError
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, B, inverse
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain import path_plan
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_nlp import PathNLP, build_path_nlp
from wholearm.planning.path_domain.path_plan import plan_curves, plan_path
from wholearm.planning.path_domain.terms import LimitShape
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.results.trajectory import Samples
from wholearm.scene.model import Friction, Scene
from wholearm.solvers.ipopt import open_ledger

PHASES = range(5)
OBJECTIVES = ["time", "effort", "margin"]
EPSILON = 0.05
LIMIT = 2.0
COARSE = 20
"""Intervals where only what a plan is for is looked at, not how good it is."""
ALLOWED = 0.2
"""Duration for the objective margin [s]: about twice the least time of each phase."""


@cache
def plan(curve: Curve, objective: str = "time", intervals: int = COARSE) -> PhasePlan[PathMotion]:
    options = PlanOptions(objective=objective, intervals=intervals)
    return plan_path(curve, EPSILON, options, 1, ALLOWED if objective == "margin" else None)


def test_a_phase_that_only_a_quick_motion_carries(curves: tuple[Curve, ...]) -> None:
    """Slow motions cannot press v1 on the palm so hard in phase 3."""
    epsilon = 0.8
    slow = with_speed_limit(curves[2], (0.3, 0.3))
    with pytest.raises(SolverError):
        plan_curves((slow,), epsilon, PlanOptions(intervals=20), (3,), explained=False)
    bound = bound_least_time([curves[2]], epsilon)
    chosen = plan_path(curves[2], epsilon, PlanOptions(intervals=160), 3)
    assert bound is not None and -1e-7 < chosen.value / bound.value - 1 < 2e-4


# Phases that are run through one after the other.


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_two_halves_are_one_whole(objective: str) -> None:
    half, whole = Toy(constant(1.0, 0.5, 0.2)), Toy(constant(1.0, 0.5, 0.2), length=2.0)
    options = PlanOptions(objective=objective, intervals=40)
    duration = 6.0 if objective == "margin" else None
    with half.in_place():
        parts = plan_curves((half.curve, half.curve), half.epsilon, options, (1, 2), duration)
    one = whole.plan(duration, objective=objective, intervals=80)
    values = [part.value for part in parts]
    value = values[0] if objective == "margin" else sum(values)
    assert value == pytest.approx(one.value, rel=1e-4)
    middle = float(np.sqrt(np.interp(1.0, one.motion.grid.s, one.motion.profile.b)))
    assert np.sqrt(parts[0].motion.profile.b[-1]) == pytest.approx(middle, rel=1e-2)


@pytest.mark.parametrize("phase", [0, 3])
def test_fastest_motion_is_at_a_limit(curves: tuple[Curve, ...], phase: int) -> None:
    motion = plan(curves[phase], "time", 80).motion
    samples = motion.evaluate(np.linspace(0, motion.duration, 4001))
    near = np.hstack([samples.c_n - EPSILON, LIMIT - np.abs(samples.tau)]) < 1e-3
    # All but the intervals in which it goes over from one limit to another; mostly two limits, of
    # which one fixes the internal force.
    assert (near.sum(axis=1) >= 1).mean() > 0.95
    assert (near.sum(axis=1) >= 2).mean() > 0.75


@pytest.mark.parametrize("phase, objective", [(0, "effort"), (4, "margin")])
def test_other_objectives_converge(curves: tuple[Curve, ...], phase: int, objective: str) -> None:
    duration = ALLOWED if objective == "margin" else None
    coarse, fine = (
        plan_path(curves[phase], EPSILON, PlanOptions(objective, accuracy=own), 1, duration)
        for own in (1e-4, 1e-5)
    )
    assert coarse.value == pytest.approx(fine.value, rel=3e-4 if objective == "effort" else 1e-3)
    better = fine.value / coarse.value - 1
    assert (better if objective == "margin" else -better) > -1e-5


def count_swings(values: Array, size: float) -> int:
    """How often values turn round by more than `size`."""
    swings, low, high, way = 0, values[0], values[0], 0
    for value in values:
        low, high = min(low, value), max(high, value)
        if way >= 0 and value < high - size:
            swings += way > 0
            way, low, high = -1, value, value
        elif way <= 0 and value > low + size:
            swings += way < 0
            way, low, high = 1, value, value
    return swings


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("phase", PHASES)
def test_torques_do_not_jitter(phase: int, objective: str) -> None:
    motion = plan_of(HEPTAGON, objective).motions[phase]
    assert isinstance(motion, PathMotion)
    steps = np.flatnonzero(motion.grid.steps == 0)
    ends = [0.0, *motion.times[steps], motion.duration]
    hair = 1e-9 * motion.duration
    for start, stop in pairwise(ends):
        t = np.linspace(start + hair, stop - hair, 401)
        for tau in motion.evaluate(t).tau.T:
            # A swing is one of 1 % of the limit. A plan has a few switches, not dozens.
            assert count_swings(tau, 0.01 * LIMIT) <= 5
            assert np.abs(np.diff(tau)).sum() <= 3.2 * np.ptp(tau) + 0.1
        lam = motion.locate(t)[2].lam
        assert count_swings(lam, 0.01 * np.ptp(lam) + 0.05) <= 6


def test_one_build_serves_all_phases(curves: tuple[Curve, ...]) -> None:
    before = build_path_nlp.cache_info().misses
    options = PlanOptions(intervals=47)
    costs = []
    for curve in curves:
        with open_ledger() as ledger:
            plan_path(curve, EPSILON, options, 1)
        costs.append(ledger.of(0))
    assert build_path_nlp.cache_info().misses == before + 1
    assert [cost.build_time > 0 for cost in costs] == [True, False, False, False, False]
    assert all(cost.solves >= 1 and cost.iterations >= 1 for cost in costs)


# No plan: why, where and by how much.


def least_shortfall(problem: Problem, phase: int, s: float, row: int) -> float:
    """Least shortfall of one limit when all others hold, by a linear program at one place.

    At the start b is 0 and a >= 0; elsewhere both are free. Rows are c_n, then tau.
    """
    curve = trace_phases(problem)[phase]
    segment: NDArray[np.int64] = np.array(
        [next(i for i, part in enumerate(curve.segments) if s <= part.stop)]
    )
    forces = inverse(
        curve.formation, *curve.evaluate(np.array([s]))[:3], directions_of(curve, segment)
    )
    limit = curve.formation.scene.torque_limit
    c_n, tau = forces.of_c[0][:, [A, B, LAMBDA]], forces.of_tau[0][:, [A, B, LAMBDA]]
    rows = np.vstack([c_n, tau, -tau])
    right = np.concatenate(
        [
            problem.epsilon - forces.of_c[0, :, ONE],
            -limit - forces.of_tau[0, :, ONE],
            -limit + forces.of_tau[0, :, ONE],
        ]
    )
    soft = np.zeros(8)
    soft[[row] if row < 4 else [row, row + 2]] = 1.0
    result = linprog(
        [0, 0, 0, 1],
        A_ub=-np.column_stack([rows, soft]),
        b_ub=-right,
        bounds=[(0 if s == 0 else None, None), (0, 0 if s == 0 else None), (None, None), (0, None)],
    )
    assert result.success
    return float(result.fun)


@pytest.mark.parametrize(
    "changes, row, limit",
    [
        ({"epsilon": 1.0}, 1, "c_n of v1-palm >= epsilon = 1 N"),
        ({"friction": 0.3}, 1, "c_n of v1-palm >= epsilon = 0.05 N"),
        ({"torque_limit2": 0.05}, 5, "torque limit of finger 2 = 0.05 N m"),
    ],
)
@pytest.mark.usefixtures("unadvised")
def test_shortfall_is_that_of_a_linear_program(
    changes: dict[str, Any], row: int, limit: str
) -> None:
    problem = problem_of(HEPTAGON).with_(changes)
    with pytest.raises(InfeasibleError) as caught:
        solve(problem, intervals=20)
    message = str(caught.value)
    found = re.match(
        r"phase (\d) is infeasible: (.*?) is (\S+) N( m)? short at t = 0\.0000 s \(x = ", message
    )
    assert found is not None, message
    assert found[2] == limit
    # The planner also weighs time, a little, and rounds to three digits.
    exact = least_shortfall(problem, int(found[1]) - 1, 0.0, row)
    assert exact > 0.01 and float(found[3]) == pytest.approx(exact, rel=0.03)


@pytest.mark.usefixtures("unadvised")
def test_jamming_friction_is_named() -> None:
    with pytest.raises(JammingError, match=r"phase 1: v0-palm .* jams at x = 16\.68 mm") as caught:
        solve(problem_of(HEPTAGON).with_(friction=1.0), intervals=20)
    assert caught.value.exit_status == 1


class Stopped:
    """A solver that gives up where it starts."""

    def __init__(self, function: Expression) -> None:
        self.function = function  # has the derivatives

    def __call__(self, x0: Array, **_: Array) -> dict[str, Array]:
        return {"x": x0}

    def stats(self) -> dict[str, Any]:
        return {"success": False, "return_status": "Maximum_Iterations_Exceeded"}


def test_a_stuck_solver_does_not_blame_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(shape: LimitShape, intervals: int, goal: Objective) -> PathNLP:
        nlp = build_path_nlp(shape, intervals, goal)
        return replace(nlp, solver=Stopped(nlp.solver.function)) if goal is Objective.TIME else nlp

    monkeypatch.setattr(path_plan, "build_path_nlp", build)
    with pytest.raises(SolverError, match=r"Ipopt stopped with Max.* although limits can be kept"):
        Toy(constant(1.0, 0.0, 3.0)).plan(intervals=20)


def test_a_stuck_solver_within_ranges_says_that_there_is_a_plan_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stuck = path_plan.Stuck([], "phase 1: Ipopt stopped", False)
    monkeypatch.setattr(path_plan, "plan_within", lambda _: (stuck, (object(),)))
    monkeypatch.setattr(path_plan, "explain_stuck", lambda *_: SolverError("unclear"))
    with pytest.raises(SolverError, match=r"stopped within the ranges .* try --robust 0\.5, or"):
        Toy(constant(1.0)).plan(robust=1.0)


BOX_LIMIT = float(box().scene.torque_limit.max())
ANY = -1.0
"""Least uniqueness margin that cones are looked at with, unique or not."""


@cache
def tip_on(mu: float) -> Curve:
    """The box tipping over vertex 1 on a palm of friction `mu`; the curve does not depend on it."""
    curve = tip()
    scene, old = curve.formation.scene, curve.formation
    friction = Friction(mu, scene.friction.finger1, scene.friction.finger2)
    other = Scene(scene.polygon, scene.fingers, friction, scene.gravity)
    return replace(curve, formation=Formation(other, old.contacts, old.rolling))


@cache
def plan_tip(
    objective: str = "time", mu: float = 0.5, intervals: int = 40
) -> PhasePlan[PathMotion]:
    options = PlanOptions(objective=objective, intervals=intervals, uniqueness_margin=ANY)
    return plan_path(tip_on(mu), EPSILON, options, 2, 0.4 if objective == "margin" else None)


def sample(chosen: PhasePlan[PathMotion], count: int) -> Samples:
    rng = np.random.default_rng(count)
    return chosen.motion.evaluate(np.sort(rng.uniform(0, chosen.motion.duration, count)))


def margin(samples: Samples, mu: float) -> Array:
    """Of vertex 1 to slipping [N]."""
    return np.asarray(mu * samples.c_n[:, 0] - np.abs(samples.c_t[:, 0]))


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_forces_stay_inside_the_friction_cone(objective: str) -> None:
    chosen = plan_tip(objective, 0.5, 10)
    samples = sample(chosen, 4000)
    assert margin(samples, 0.5).min() >= 0.5 * EPSILON - 1e-6
    assert samples.c_n.min() >= EPSILON - 1e-6
    assert np.abs(samples.tau).max() <= BOX_LIMIT + 1e-6
    # The margin that is planned for is that of the normal forces alone.
    if objective == "margin":
        assert samples.c_n.min() >= chosen.value - 1e-6 > EPSILON
        assert samples.c_n.min() == pytest.approx(chosen.value, abs=1e-2)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_planned_forces_balance_every_body(objective: str) -> None:
    """Newton and Euler at random instants, with the vertex where it was."""
    samples = sample(plan_tip(objective), 200)
    formation = tip_on(0.5).formation
    place = place_corners(formation.scene, tip().start)[1]
    missing, size = unbalance(formation, samples, np.sign(samples.z_dot[:, 3:]))
    assert (np.abs(missing).max(axis=1) < 1e-10 * size.max(axis=1)).all()
    assert np.abs(place_corners(formation.scene, samples.z)[:, 1] - place).max() < 1e-14
    slip = measure_slip(formation, samples.z, samples.z_dot)
    assert np.abs(slip[:, 0]).max() < 1e-13
    # The other two slide, and friction opposes that.
    law = -formation.friction[1:] * np.sign(slip[:, 1:]) * samples.c_n[:, 1:]
    np.testing.assert_allclose(samples.c_t[:, 1:], law, rtol=1e-12)


def test_least_time_comes_near_its_lower_bound() -> None:
    bound = bound_least_time([tip_on(0.5)], EPSILON)
    assert bound is not None
    assert -1e-7 < plan_tip("time", 0.5, 80).value / bound.value - 1 < 2e-4


def test_the_cone_is_what_holds_the_fastest_motion_back() -> None:
    """It is touched on both sides; on a rougher palm the box tips faster."""
    samples = sample(plan_tip(), 4000)
    near = margin(samples, 0.5) < 0.5 * EPSILON + 1e-3
    assert (near & (samples.c_t[:, 0] > 0)).any() and (near & (samples.c_t[:, 0] < 0)).any()
    times = [plan_tip("time", mu, 20).value for mu in (0.45, 0.5, 0.8)]
    assert (np.diff(times) < -1e-3).all()
    assert (margin(sample(plan_tip("time", 0.8, 20), 4000), 0.5) < 0).any()


@pytest.mark.usefixtures("unadvised")
def test_a_slippery_palm_is_named() -> None:
    with pytest.raises(InfeasibleError, match="friction cone of v1-palm") as caught:
        plan_tip("time", 0.1, 20)
    text = str(caught.value)
    assert text.startswith("phase 2 is infeasible: ") and "|c_t| <= 0.1 (c_n - 0.05 N), is " in text
    assert " N short at t = " in text


def test_an_epsilon_that_cones_allow_is_advised() -> None:
    """Rolling contacts need c_n >= epsilon and a cone that is narrower by mu epsilon."""
    options, mu, epsilon = PlanOptions(intervals=15, uniqueness_margin=ANY), 0.8, 0.7
    with pytest.raises(InfeasibleError) as caught:
        plan_path(tip_on(mu), epsilon, options, 2)
    _, found, advised = str(caught.value).rpartition("epsilon = ")
    assert found and advised.endswith(f" N instead of {epsilon:g}")
    value = float(advised.split()[0])
    assert plan_path(tip_on(mu), value, options, 2).value > plan_tip("time", mu, 20).value
    with pytest.raises(SolverError):
        plan_curves((tip_on(mu),), 1.03 * value, options, (2,), explained=False)
