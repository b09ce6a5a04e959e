"""Plans along curves: the NLP, closed forms of lines, lower bounds, and refusals."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.optimize import linprog

from plane import measure_slip, place_corners, unbalance, with_speed_limit
from refused import INTERVALS, OPTIONS, ask, edited, plan, read_advice
from scenes import box, fading, read_lines, tip
from shipped import HEPTAGON, IMPACTS, plan_of, problem_of
from toys import LIMIT, Toy, constant, find_time_growing, find_time_viscous, inertia, plan_path
from wholearm import Problem
from wholearm.common.arrays import Array, Expression
from wholearm.common.errors import InfeasibleError, JammingError, SolverError, WholearmError
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, inverse
from wholearm.mechanics.speed_sweep import NoMotionError
from wholearm.planning.blocks import ImpactSequence
from wholearm.planning.lower_bound import LowerBound, bound_least_time, sweep_time
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain import path_plan
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_plan import LimitShape, PathNLP, Task, plan_curves
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.problem.definition import Until
from wholearm.results.trajectory import Samples
from wholearm.search.edges import BorderEdge, Chain, Edge
from wholearm.search.places import make_place

EPSILON = 0.05


# Best motions in closed form: a point driven along a line of 1 m.


def check_accuracy(toy: Toy, exact: float, best: int, **options: Any) -> None:
    """Values are as accurate as asked, but for a choice among equals, and say how much."""
    # `best` is the sign of errors that would be better than the best, which none may be.
    for accuracy in (1e-4, 1e-6):
        plan = toy.plan(accuracy=accuracy, **options)
        error = -best * (plan.value / exact - 1)
        assert -1e-9 < error < accuracy + 3e-6
        assert error < 4 * plan.error + 3e-6


def bound(toy: Toy) -> LowerBound:
    with toy.in_place():
        found = bound_least_time([toy.curve], toy.epsilon)
    assert found is not None
    return found


STEPPING = Toy(inertia(lambda s, later: np.where(later, 2.0, 1.0)), breaks=(0.5,))
TOP, AT_BREAK = math.sqrt(0.75 * LIMIT), math.sqrt(0.5 * LIMIT)
CLOSED = [
    (Toy(constant(1.0)), math.sqrt(2.0)),
    *((Toy(constant(1.0), length=own), 2 * math.sqrt(own / LIMIT)) for own in (0.03, 4.0)),
    (Toy(constant(1.0, 1.0)), 2 / math.sqrt(LIMIT - EPSILON)),
    *((Toy(constant(1.0), speed_limit=(v, np.inf)), 1 / v + v / LIMIT) for v in (0.3, 0.7, 1.2)),
    (Toy(constant(1.0), speed_limit=(1.6, np.inf)), math.sqrt(2.0)),
    (Toy(inertia(lambda s, later: 1.0 + s)), find_time_growing()),
    (STEPPING, (2 * TOP - AT_BREAK) / LIMIT + AT_BREAK / (LIMIT / 2)),
    *((Toy(constant(1.0, 0.0, drag)), find_time_viscous(drag)) for drag in (0.1, 0.5, 3.0)),
]


@pytest.mark.parametrize("toy, exact", CLOSED)
def test_least_times_are_planned_and_bounded_as_in_closed_form(toy: Toy, exact: float) -> None:
    check_accuracy(toy, exact, -1)
    found = bound(toy)
    assert exact * (1 - 1e-6) < found.value <= exact * (1 + 1e-9)
    assert 0 <= found.error < 1e-7 * exact


def test_motions_integrate_their_acceleration() -> None:
    """S' is the integral of s'' over time, and s that of s'; a coarse grid, and a jump of s''."""
    motion, (nodes, weights) = STEPPING.plan(intervals=10).motion, legendre.leggauss(20)
    speed, place = 0.0, 0.0
    for k in motion.grid.nonempty.tolist():
        start, stop = motion.times[k : k + 2]
        _, _, here = motion.locate(start + (1 + nodes) / 2 * (stop - start))
        place += (stop - start) / 2 * float(weights @ np.sqrt(here.b))
        speed += (stop - start) / 2 * float(weights @ here.a)
        assert place == pytest.approx(motion.grid.s[k + 1], abs=1e-10)
        assert speed == pytest.approx(math.sqrt(motion.profile.b[k + 1]), abs=1e-8)


@pytest.mark.parametrize("weight", [0.1, 3.0, 50.0])
def test_least_effort_of_a_free_run(weight: float) -> None:
    """In a fixed time it takes 12 L^2 / T^3; with w T this is least at T^4 = 36 L^2 / w."""
    toy = Toy(inertia(lambda s, later: np.ones_like(s)), limit=(1e3, 1e3))
    duration = (36 / weight) ** 0.25
    exact = 4 / 3 * weight * duration
    check_accuracy(toy, exact, -1, objective="effort", time_weight=weight)
    plan = toy.plan(objective="effort", time_weight=weight)
    assert plan.motion.duration == pytest.approx(duration, rel=3e-4)
    t = np.linspace(0.1, 0.9, 50) * duration
    line = 6 / duration**2 * (1 - 2 * t / duration)
    a, off = plan.motion.locate(t)[2].a, 0.01 * np.abs(line).max()
    np.testing.assert_allclose(a, line, rtol=0, atol=off)


@pytest.mark.parametrize("duration", [2.5, 3.0, 8.0])
def test_largest_margin_within_a_duration(duration: float) -> None:
    """With |a| + c_n <= F, the least largest |a| is 4 L / T^2."""
    toy = Toy(constant(1.0, 1.0))
    exact = LIMIT - 4 / duration**2
    check_accuracy(toy, exact, 1, objective="margin", duration=duration)
    plan = toy.plan(objective="margin", duration=duration)
    assert plan.motion.duration <= duration * (1 + 5e-7)
    t = np.linspace(0, plan.motion.duration, 1001)
    assert plan.motion.locate(t)[2].lam.min() == pytest.approx(plan.value, abs=1e-6)


OBJECTIVES = ["time", "effort", "margin"]


def test_a_phase_that_only_a_quick_motion_carries(curves: tuple[Curve, ...]) -> None:
    """Slow motions cannot press v1 on the palm so hard in phase 3."""
    slow = with_speed_limit(curves[2], (0.3, 0.3))
    with pytest.raises(SolverError):
        plan_curves(Task((slow,), 0.8, PlanOptions(intervals=20), (3,)), explained=False)
    check_bound((curves[2],), 0.8, 160, 2e-4)


def check_bound(curves: Sequence[Curve], epsilon: float, intervals: int, excess: float) -> None:
    """Least times are above their lower bounds, which are good to their errors, by little."""
    found = bound_least_time(curves, epsilon)
    assert found is not None and found.error < 3e-8 * found.value
    options = PlanOptions(intervals=intervals, uniqueness_margin=ANY)
    numbers = range(1, len(curves) + 1)
    plans = plan_curves(Task(curves, epsilon, options, tuple(numbers)), explained=False)
    assert -1e-7 < sum(plan.value for plan in plans) / found.value - 1 < excess


def test_plans_come_near_the_bound(curves: tuple[Curve, ...]) -> None:
    """Along curves, where a vertex rolls, and through impacts."""
    for curve in (curves[0], curves[2], curves[3], curves[4], tip_on(0.5)):
        check_bound((curve,), EPSILON, 80, 2e-4)
    problem = problem_of(IMPACTS)
    chain = ImpactSequence(problem.phases, trace_phases(problem)).split()[0]
    check_bound(chain.continuous_curves, EPSILON, 80, 5e-4)


# Phases that are run through one after the other.


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_two_halves_are_one_whole(objective: str) -> None:
    half, whole = Toy(constant(1.0, 0.5, 0.2)), Toy(constant(1.0, 0.5, 0.2), length=2.0)
    options = PlanOptions(objective=objective, intervals=40)
    duration = 6.0 if objective == "margin" else None
    with half.in_place():
        parts = plan_curves(Task((half.curve,) * 2, half.epsilon, options, (1, 2), duration))
        joined = bound_least_time((half.curve, half.curve), half.epsilon)
    assert joined is not None
    assert joined.value == pytest.approx(bound(whole).value, rel=1e-7)
    one = whole.plan(duration, objective=objective, intervals=80)
    values = [part.value for part in parts]
    value = values[0] if objective == "margin" else sum(values)
    assert value == pytest.approx(one.value, rel=1e-4)
    middle = float(np.sqrt(np.interp(1.0, one.motion.grid.s, one.motion.profile.b)))
    assert np.sqrt(parts[0].motion.profile.b[-1]) == pytest.approx(middle, rel=1e-2)


@pytest.mark.parametrize("phase, objective", [(0, "effort"), (4, "margin")])
def test_other_objectives_converge(curves: tuple[Curve, ...], phase: int, objective: str) -> None:
    duration = 0.2 if objective == "margin" else None
    coarse, fine = (
        plan_path(curves[phase], EPSILON, PlanOptions(objective, accuracy=own), 1, duration)
        for own in (1e-4, 1e-5)
    )
    assert coarse.value == pytest.approx(fine.value, rel=3e-4 if objective == "effort" else 1e-3)
    better = fine.value / coarse.value - 1
    assert (better if objective == "margin" else -better) > -1e-5


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("phase", range(5))
def test_torques_do_not_jitter(phase: int, objective: str) -> None:
    motion = plan_of(HEPTAGON, objective).motions[phase]
    assert isinstance(motion, PathMotion)
    steps = np.flatnonzero(motion.grid.steps == 0)
    ends = [0.0, *motion.times[steps], motion.duration]
    hair = 1e-9 * motion.duration
    for start, stop in pairwise(ends):
        t = np.linspace(start + hair, stop - hair, 401)
        # A plan has a few switches, not dozens: torques go to and fro little more than once.
        for tau in motion.evaluate(t).tau.T:
            assert np.abs(np.diff(tau)).sum() <= 3.2 * np.ptp(tau) + 0.1


# No plan: why, where and by how much.


def least_shortfall(problem: Problem, phase: int, row: int) -> float:
    """Least shortfall of one limit when all others hold, by a linear program at the start."""
    # There b is 0 and a >= 0. Rows are c_n, then tau.
    curve = trace_phases(problem)[phase]
    point, directions = curve.evaluate(np.zeros(1)), directions_of(curve, np.zeros(1, dtype=int))
    forces, limit = inverse(curve.formation, point, directions), problem.scene.torque_limit
    c_n, tau = forces.of_c[0], forces.of_tau[0]
    rows = np.vstack([c_n, tau, -tau])
    right = np.concatenate([np.full(len(c_n), problem.epsilon), -limit, -limit]) - rows[:, ONE]
    soft = np.zeros((8, 1))
    soft[[row] if row < 4 else [row, row + 2]] = 1.0
    table = np.hstack([rows[:, [A, LAMBDA]], soft])
    bounds = [(0, None), (None, None), (0, None)]
    result = linprog([0, 0, 1], A_ub=-table, b_ub=-right, bounds=bounds)
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
    exact = least_shortfall(problem, int(found[1]) - 1, row)
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

    def __call__(self, x0: Array, **_: Array) -> dict[str, Any]:
        return {"x": x0, "success": False, "status": "Maximum_Iterations_Exceeded"}


def test_a_stuck_solver_does_not_blame_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    original = path_plan.build_path_nlp

    def build(shape: LimitShape, intervals: int, goal: Objective) -> PathNLP:
        nlp = original(shape, intervals, goal)
        stopped = Stopped(nlp.solver.function)
        return replace(nlp, solver=stopped, start_solver=stopped) if goal is Objective.TIME else nlp

    monkeypatch.setattr(path_plan, "build_path_nlp", build)
    with pytest.raises(SolverError, match=r"Ipopt stopped with Max.* although limits can be kept"):
        Toy(constant(1.0, 0.0, 3.0)).plan(intervals=20)


ANY = -1.0
"""Least uniqueness margin that cones are looked at with, unique or not."""


@cache
def tip_on(mu: float) -> Curve:
    """The box tipping over vertex 1 on a palm of friction `mu`; the curve does not depend on it."""
    curve, scene = tip(), tip().formation.scene
    rough = replace(scene, friction=replace(scene.friction, palm=mu))
    return replace(curve, formation=replace(curve.formation, scene=rough))


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
    assert np.abs(samples.tau).max() <= box().scene.torque_limit.max() + 1e-6
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
        plan_curves(Task((tip_on(mu),), 1.03 * value, options, (2,)), explained=False)


LIMITS = ("torque limit of finger 1", "torque limit of finger 2", "epsilon")


def is_feasible(limits: dict[str, float], phase: int, friction: float = 0.1) -> bool:
    try:
        plan(edited(limits, friction), phase, explained=False)
    except WholearmError:
        return False
    return True


@pytest.mark.parametrize(
    "phase, limits, names",
    [
        (3, {"epsilon": 0.6, "torque limit of finger 1": 0.3}, [LIMITS[0], "epsilon"]),
        (1, {"epsilon": 1.0}, ["epsilon"]),
    ],
)
def test_advised_values_are_feasible_and_hardly_larger_than_needed(
    phase: int, limits: dict[str, float], names: list[str]
) -> None:
    """Checked by planning anew with the limit in the problem file changed."""
    advised = read_advice(ask(phase, **limits))
    assert list(advised) == names
    for name, value in advised.items():
        short = 1.04 if name == "epsilon" else 1 / 1.04
        assert is_feasible(limits | {name: value}, phase)
        assert not is_feasible(limits | {name: short * value}, phase)


def test_where_nothing_is_advised_nothing_helps() -> None:
    """Not even a hundred times the torque, or no force at all."""
    limits = {"epsilon": 0.05}
    assert read_advice(ask(1, 0.3, **limits)) == {}
    for name in LIMITS:
        generous = 0.0 if name == "epsilon" else 300.0
        assert not is_feasible(limits | {name: generous}, 1, 0.3)


def test_phases_that_impacts_join_are_advised_together() -> None:
    problem = problem_of(IMPACTS)
    chain = ImpactSequence(problem.phases, trace_phases(problem)).split()[0]
    with pytest.raises(InfeasibleError) as caught:
        plan_curves(chain.make_task(1.0, OPTIONS))
    found = re.match(
        r"phases 1 to 3 are infeasible: c_n of (\S+) >= epsilon = 1 N is \S+ N short at "
        r"t = \d\.\d{4} s \(x = .*? mm, phi = .*? deg\), phase ([123])",
        str(caught.value),
    )
    assert found is not None, str(caught.value)
    assert found[1] in chain.phases[int(found[2]) - 1].formation.names
    (value,) = read_advice(str(caught.value)).values()
    assert all(plan.motion.duration > 0 for plan in plan_curves(chain.make_task(value, OPTIONS)))
    # Where only the fact counts, no time is spent on advice.
    with pytest.raises(SolverError, match=r"^phases 1 to 3: Ipopt stopped with "):
        plan_curves(chain.make_task(1.03 * value, OPTIONS), explained=False)


def test_too_short_a_duration_is_named(curves: tuple[Curve, ...]) -> None:
    duration = 0.1
    options = PlanOptions("margin", intervals=INTERVALS)
    least = plan_path(curves[0], 0.05, OPTIONS, 1).value
    refusal = f"^phase 1 is infeasible: duration = {duration:g} s is"
    with pytest.raises(InfeasibleError, match=refusal) as caught:
        plan_path(curves[0], 0.05, options, 1, duration)
    advised = read_advice(str(caught.value))
    assert list(advised) == ["duration"]
    # Both solves are good to 1e-6.
    assert least * (1 - 1e-6) < advised["duration"] < 1.03 * least
    assert plan_path(curves[0], 0.05, options, 1, advised["duration"]).value > 0.05 * (1 - 1e-6)


def test_no_motion_has_no_bound() -> None:
    # The squeeze alone, 0.05 N at a lever of 50 m, takes more torque than there is.
    toy = Toy(constant(1.0, 50.0))
    with toy.in_place():
        assert bound_least_time([toy.curve], toy.epsilon) is None


def test_the_bound_shares_nothing_with_the_nlp() -> None:
    path = Path(__file__).parents[1] / "src/wholearm/planning/lower_bound.py"
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            first = (node.module or "").split(".")[0]
            assert node.level in (0, 2)
            assert node.level == 0 or first in ("common", "geometry", "mechanics")
            assert node.level or first not in ("casadi", "wholearm")
        elif isinstance(node, ast.Import):
            assert [alias.name for alias in node.names] == ["numpy"]


def test_a_place_that_motions_hardly_pass_is_found_on_any_first_grid() -> None:
    """A flip after a slide, until an edge is flush on finger 2, is slowest where a joint turns."""
    # Some of the grids are too coarse there for any motion, others for more than a crawl.
    text = """
        epsilon = 0.05
        object.mass = 0.5
        object.vertices = [[-0.02296, -0.05543], [0.02296, -0.05543], [0.05543, -0.02296],
            [0.05543, 0.02296], [0.02296, 0.05543], [-0.02296, 0.05543], [-0.05543, 0.02296],
            [-0.05543, -0.02296]]
        fingers.1 = {base = [0.14, -0.02], length = 0.2, radius = 0.015,
            inertia = 0.004, viscous = 0.01, dry = 0.01, torque_limit = 5.0}
        fingers.2 = {base = [-0.14, -0.02], length = 0.2, radius = 0.015,
            inertia = 0.004, viscous = 0.01, dry = 0.01, torque_limit = 5.0}
        friction = {palm = 0.29, finger1 = 0.2, finger2 = 0.2}
        start = {flush = 0, x = -0.11}
        phases = [
            {contacts = ["v0-palm", "v1-palm", "e2-tip1", "v7-finger2"], until = "v0-finger2"},
            {contacts = ["v0-palm", "e2-tip1", "v0-finger2", "v7-finger2"], until = "v2-tip1"},
            {contacts = ["v0-palm", "v2-tip1", "v0-finger2", "v7-finger2"], until = "e1-tip1"},
            {contacts = ["v0-palm", "e1-tip1", "v0-finger2", "v7-finger2"], until = "v1-palm"}]
    """
    problem, least = read_lines(text), []
    curves, epsilon = trace_phases(problem)[1:], problem.epsilon
    for intervals in (50, 100):
        found = bound_least_time(curves, epsilon, intervals)
        assert found is not None
        least.append(found.value)
    assert least == pytest.approx([least[-1]] * len(least), rel=1e-5)
    assert sweep_time(curves, epsilon, 1000) == pytest.approx(least[-1], rel=1e-3)
    # Nor does the search for routes give up the border on which it lies.
    slow = curves[1]
    place = make_place(slow.formation.scene, slow.start)
    edge = Chain((BorderEdge(place, slow, epsilon, 0.1),)).stop_at(Until())
    # A crawl through that place on the first grid is a tenth too slow; 1 would be no estimate.
    assert isinstance(edge, Edge) and edge.estimate == pytest.approx(
        sweep_time([slow], epsilon, 1000), rel=0.2
    )


@pytest.mark.parametrize(("lever", "passes"), [(50.0, True), (90.0, False)])
def test_a_place_narrower_than_the_grid_may_need_more_speed(lever: float, passes: bool) -> None:
    """Behind the break 2.5 + a - v <= 2 and 0.05 lever - a <= 2: there v is at least 1, or 3."""

    def law(s: Array, later: NDArray[np.bool_]) -> tuple[Array, ...]:
        there = (later & (s < 0.501))[:, None]
        return np.tile([1.0, -1.0], (len(s), 1)), there * [50.0, lever], there * [-1.0, 0.0]

    toy = Toy(law, breaks=(0.5,))
    with toy.in_place():
        if passes:
            # The largest speed there, sqrt(2), is that without the place.
            assert sweep_time([toy.curve], toy.epsilon, 24) == pytest.approx(math.sqrt(2), rel=0.01)
        else:
            with pytest.raises(NoMotionError):
                sweep_time([toy.curve], toy.epsilon, 24)


def test_torques_follow_a_motion_that_fades() -> None:
    """Half of the last interval's time passes on a hundredth of its way."""
    problem = fading()
    trajectory = solve(problem, "margin", replay=False).trajectory
    (motion,), torque = trajectory.motions, trajectory.torque
    t = np.linspace(0.0, motion.duration, 2001)
    t = t[np.abs(t[:, None] - torque.breaks).min(axis=1) > 1e-9 * motion.duration]
    misfit = (torque.at(t) - motion.evaluate(t).tau) / problem.scene.torque_limit
    assert np.abs(misfit).max() < 1e-5
