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

from plane import with_speed_limit
from shipped import HEPTAGON, IMPACTS, plan_of, problem_of
from toys import Toy, constant
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, JammingError, SolverError
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import inverse
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.lower_bound.rows import directions_of
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain import path_plan, task
from wholearm.planning.path_domain.impact_sequence import ImpactSequence, make_sequence
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_nlp import PathNLP, build_path_nlp
from wholearm.planning.path_domain.path_plan import plan_curves, plan_path
from wholearm.planning.path_domain.sequence_plan import plan_sequence
from wholearm.planning.path_domain.terms import LimitShape
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.solvers.statistics import open_ledger

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


def inner_times(chosen: PhasePlan[PathMotion], fractions: Array) -> Array:
    """Times at `fractions` of every interval that has a length."""
    times = chosen.motion.times
    spans = np.diff(times)
    k = np.flatnonzero(spans > 0)
    return np.asarray((times[k, None] + fractions * spans[k, None]).ravel())


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("phase", [4])
def test_limits_hold_at_random_instants(
    curves: tuple[Curve, ...], phase: int, objective: str
) -> None:
    chosen = plan(curves[phase], objective, 10)
    fractions = np.random.default_rng(phase).uniform(0, 1, 50)
    samples = chosen.motion.evaluate(inner_times(chosen, fractions))
    # What is asked of a plan.
    assert samples.c_n.min() >= EPSILON - 1e-6
    assert np.abs(samples.tau).max() <= LIMIT + 1e-6
    if objective == "margin":
        assert samples.c_n.min() >= chosen.value - 1e-6
        assert samples.c_n.min() == pytest.approx(chosen.value, abs=1e-2)
        assert chosen.motion.duration <= ALLOWED * (1 + 1e-6)


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


@pytest.fixture(scope="module")
def chain() -> ImpactSequence:
    """Three phases that impacts join."""
    problem = problem_of(IMPACTS)
    return make_sequence(problem.phases, trace_phases(problem)).split()[0]


@cache
def plan_joined(chain: ImpactSequence, objective: str) -> list[PhasePlan[PathMotion]]:
    options = PlanOptions(objective=objective, intervals=12)
    return plan_sequence(chain, EPSILON, options, 0.5 if objective == "margin" else None)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_limits_hold_along_a_chain(chain: ImpactSequence, objective: str) -> None:
    plans = plan_joined(chain, objective)
    fractions = np.random.default_rng(6).uniform(0, 1, 50)
    for chosen in plans:
        samples = chosen.motion.evaluate(inner_times(chosen, fractions))
        assert samples.c_n.min() >= EPSILON - 1e-6
        assert np.abs(samples.tau).max() <= LIMIT + 1e-6
        if objective == "margin":
            assert samples.c_n.min() >= chosen.value - 1e-6
    if objective == "margin":
        assert sum(chosen.motion.duration for chosen in plans) <= 0.5 * (1 + 1e-6)


def test_a_chain_is_one_problem(chain: ImpactSequence) -> None:
    plans = plan_joined(chain, "time")
    assert all(plan.value == plan.motion.duration for plan in plans)
    motions = [plan.motion for plan in plans]
    speeds = [np.sqrt(motion.profile.b[[0, -1]]) for motion in motions]
    assert speeds[0][0] == speeds[2][1] == 0.0
    for before, after in pairwise(speeds):
        assert before[1] == after[0] > 0.1
    for one, other in pairwise(motions):
        end, start = one.evaluate(np.array([one.duration])), other.evaluate(np.zeros(1))
        np.testing.assert_allclose(start.z, end.z, rtol=0, atol=1e-12)


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


def test_swings_are_counted() -> None:
    t = np.linspace(0, 10 * np.pi, 1001)
    assert count_swings(np.sin(t), 0.1) == 10 and count_swings(np.sin(t), 2.5) == 0
    assert count_swings(t, 0.1) == 0


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


def test_planning_twice_gives_the_same_plan(curves: tuple[Curve, ...]) -> None:
    objective = "margin"
    first = plan(curves[2], objective)
    # Another phase in between must leave no trace.
    options = PlanOptions(objective=objective, intervals=COARSE)
    plan_path(curves[0], EPSILON, options, 1, ALLOWED)
    again = plan_path(curves[2], EPSILON, options, 1, ALLOWED)
    # The solver's own tolerance is 1e-8; a plan that started from another one would differ more.
    for one, other in zip(first.motion.profile, again.motion.profile, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-7 * np.abs(one).max())
    assert again.value == pytest.approx(first.value, rel=1e-9)


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


@pytest.mark.parametrize("limits", [(1.0, np.inf), (2.0, 2.0)])
def test_joint_speed_limits_are_kept(
    curves: tuple[Curve, ...], limits: tuple[float, float]
) -> None:
    for curve in (curves[0], curves[4]):
        slow = plan_path(with_speed_limit(curve, limits), EPSILON, PlanOptions(intervals=COARSE), 1)
        samples = slow.motion.evaluate(inner_times(slow, np.linspace(0, 1, 21)))
        speeds = np.abs(samples.z_dot[:, 3:]).max(axis=0)
        # b is kept to 5e-7 relative.
        assert (speeds <= np.array(limits) * (1 + 1e-6)).all()
        assert (speeds / limits).max() == pytest.approx(1.0, rel=1e-3)
        assert slow.value > plan(curve).value
        assert samples.c_n.min() >= EPSILON - 1e-6


@pytest.mark.parametrize("phase, objective, intervals", [(1, "time", 160), (3, "margin", 160)])
def test_small_dips_between_slack_nodes_are_lifted(
    curves: tuple[Curve, ...], phase: int, objective: str, intervals: int
) -> None:
    """A force that dips below its limit between nodes at which it is above."""
    chosen = plan(curves[phase], objective, intervals)
    c_n = chosen.motion.evaluate(inner_times(chosen, np.linspace(0, 1, 41))).c_n
    least = chosen.value if objective == "margin" else EPSILON
    assert c_n.min() >= least - 1e-6
    # The lift itself costs next to nothing, as a few nodes need it.
    coarse = plan(curves[phase], objective, 80).value
    assert chosen.value == pytest.approx(coarse, rel=2e-3)


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
    c_n = np.column_stack([forces.Ca[0], forces.Cb[0], forces.Cl[0]])
    tau = np.column_stack([forces.Ta[0], forces.Tb[0], forces.Tl[0]])
    rows = np.vstack([c_n, tau, -tau])
    right = np.concatenate(
        [problem.epsilon - forces.C0[0], -limit - forces.T0[0], -limit + forces.T0[0]]
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

    def __call__(self, x0: Array, **_: Array) -> dict[str, Array]:
        return {"x": x0}

    def stats(self) -> dict[str, Any]:
        return {"success": False, "return_status": "Maximum_Iterations_Exceeded"}


def test_a_stuck_solver_does_not_blame_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(shape: LimitShape, intervals: int, goal: Objective) -> PathNLP:
        nlp = build_path_nlp(shape, intervals, goal)
        return replace(nlp, solver=Stopped()) if goal is Objective.TIME else nlp

    monkeypatch.setattr(task, "build_path_nlp", build)
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
