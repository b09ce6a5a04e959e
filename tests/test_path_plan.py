"""Plans along curves: the NLP, closed forms of lines, lower bounds, and refusals."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from plane import measure_slip, place_corners, unbalance, with_speed_limit
from refused import INTERVALS, OPTIONS, ask, edited, plan, read_advice
from scenes import box, tip
from shipped import HEPTAGON, IMPACTS, plan_of, problem_of
from toys import LIMIT, Toy, constant, find_time_growing, find_time_viscous, inertia
from wholearm import Formation, Friction, Problem, Scene
from wholearm.benchmark.scenes import draw_case
from wholearm.common.arrays import Array, Expression
from wholearm.common.errors import InfeasibleError, JammingError, SolverError, WholearmError
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics.dynamics import LAMBDA, ONE, A, B, Directions, V, inverse
from wholearm.mechanics.limits import make_limits
from wholearm.planning import lower_bound
from wholearm.planning.blocks import make_sequence
from wholearm.planning.lower_bound import (
    LowerBound,
    bound_least_time,
    find_least,
    find_limits,
    look_along,
)
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain import path_plan
from wholearm.planning.path_domain.path_data import prepare
from wholearm.planning.path_domain.path_mesh import make_grid
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_nlp import (
    LimitShape,
    PathNLP,
    Relaxation,
    build_path_nlp,
    guess,
    pack,
    parameters,
)
from wholearm.planning.path_domain.path_plan import plan_curves, plan_path
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem
from wholearm.results.trajectory import Samples
from wholearm.search.edges import BorderEdge, Edge, Terms, edge_along
from wholearm.search.places import make_place

EPSILON = 0.05


# Best motions in closed form: a point driven along a line of 1 m.


def check_accuracy(toy: Toy, exact: float, best: int, **options: Any) -> None:
    """Values are as accurate as asked, but for what choosing among equals costs, and say how much.

    `best` is the sign of errors that would be better than the best, which none may be.
    """
    for accuracy in (1e-4, 1e-6):
        plan = toy.plan(accuracy=accuracy, **options)
        error = -best * (plan.value / exact - 1)
        assert -1e-9 < error < accuracy + 3e-6
        assert error < 4 * plan.error + 3e-6


@pytest.mark.parametrize("length", [0.03, 1.0, 4.0])
def test_least_time_is_bang_bang(length: float) -> None:
    toy = Toy(constant(1.0), length=length)
    exact = 2 * math.sqrt(length / LIMIT)
    check_accuracy(toy, exact, -1)
    plan = toy.plan()
    t = np.linspace(0, plan.motion.duration, 2001)
    a = plan.motion.locate(t)[2].a
    assert (np.abs(np.abs(a) - LIMIT) < 1e-3 * LIMIT).mean() > 0.95
    assert (np.sign(a) == np.sign(exact / 2 - t))[np.abs(t - exact / 2) > 0.03 * exact].all()


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
    np.testing.assert_allclose(
        plan.motion.locate(t)[2].a, line, rtol=0, atol=0.01 * np.abs(line).max()
    )


@pytest.mark.parametrize("speed", [0.3, 0.7, 1.2])
def test_joint_speed_limit_makes_a_trapezoid(speed: float) -> None:
    toy = Toy(constant(1.0), speed_limit=(speed, np.inf))
    exact = 1 / speed + speed / LIMIT
    check_accuracy(toy, exact, -1)
    plan = toy.plan()
    t = np.linspace(0, plan.motion.duration, 4001)
    b = plan.motion.locate(t)[2].b
    assert np.sqrt(b.max()) <= speed * (1 + 5e-7)
    cruise = np.abs(t - exact / 2) < 0.4 * (1 / speed - speed / LIMIT)
    np.testing.assert_allclose(np.sqrt(b[cruise]), speed, rtol=2e-3)


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


def test_inertia_that_steps_at_a_reversal() -> None:
    """Inertia 1, then 2: the switch at 3/8, and the acceleration jumps at 1/2."""
    toy = Toy(inertia(lambda s, later: np.where(later, 2.0, 1.0)), breaks=(0.5,))
    top, at_break = math.sqrt(0.75 * LIMIT), math.sqrt(0.5 * LIMIT)
    exact = (top + (top - at_break)) / LIMIT + at_break / (LIMIT / 2)
    check_accuracy(toy, exact, -1)
    motion = toy.plan().motion
    (gap,) = np.flatnonzero(np.diff(motion.grid.segment))
    assert motion.grid.steps[gap] == 0.0
    np.testing.assert_allclose(motion.profile.a[[gap, gap + 1]], [-LIMIT, -LIMIT / 2], rtol=1e-3)


def test_inertia_that_grows_along_the_way() -> None:
    check_accuracy(Toy(inertia(lambda s, later: 1.0 + s)), find_time_growing(), -1)


@pytest.mark.parametrize("drag", [0.1, 0.5])
def test_viscous_joints(drag: float) -> None:
    check_accuracy(Toy(constant(1.0, 0.0, drag)), find_time_viscous(drag), -1)


PHASES = range(5)
OBJECTIVES = ["time", "effort", "margin"]
STRONG = 2.0
COARSE = 20
"""Intervals where only what a plan is for is looked at, not how good it is."""
ALLOWED = 0.2
"""Duration for the objective margin [s]: about twice the least time of each phase."""


@cache
def plan_line(
    curve: Curve, objective: str = "time", intervals: int = COARSE
) -> PhasePlan[PathMotion]:
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
    motion = plan_line(curves[phase], "time", 80).motion
    samples = motion.evaluate(np.linspace(0, motion.duration, 4001))
    near = np.hstack([samples.c_n - EPSILON, STRONG - np.abs(samples.tau)]) < 1e-3
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
            assert count_swings(tau, 0.01 * STRONG) <= 5
            assert np.abs(np.diff(tau)).sum() <= 3.2 * np.ptp(tau) + 0.1
        lam = motion.locate(t)[2].lam
        assert count_swings(lam, 0.01 * np.ptp(lam) + 0.05) <= 6


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
        stopped = Stopped(nlp.solver.function)
        return replace(nlp, solver=stopped, starter=stopped) if goal is Objective.TIME else nlp

    monkeypatch.setattr(path_plan, "build_path_nlp", build)
    with pytest.raises(SolverError, match=r"Ipopt stopped with Max.* although limits can be kept"):
        Toy(constant(1.0, 0.0, 3.0)).plan(intervals=20)


@pytest.mark.parametrize("goal", Objective)
def test_the_slope_of_b_is_twice_a_whatever_is_minimised(goal: Objective) -> None:
    curve = trace_phases(problem_of(HEPTAGON))[0]
    data = prepare(curve, EPSILON, make_grid(curve, np.zeros(0), 6), 1)
    nlp = build_path_nlp(LimitShape.of(data), len(data.grid.steps), goal)
    profile, units = guess(data)
    relaxed = Relaxation(data.limits.parameters[0], 1.0) if goal is Objective.RELAX else None
    given = parameters(nlp, data, units, 1.0, relaxed)
    g = nlp.solver.function.get_function("nlp_g")(pack(nlp, profile, units, 0.1), given)
    # The parabola of the guess is one of the polynomials of b.
    assert np.abs(g.full()[nlp.g["links"]]).max() < 1e-12


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


LIMITS = ("torque limit of finger 1", "torque limit of finger 2", "epsilon")


def is_feasible(limits: dict[str, float], phase: int, friction: float = 0.1) -> bool:
    try:
        plan(edited(limits, friction), phase, explained=False)
    except WholearmError:
        return False
    return True


def test_advised_values_are_feasible_and_hardly_larger_than_needed() -> None:
    """Checked by planning anew with the limit in the problem file changed."""
    name = "torque limit of finger 1"
    limits = {"epsilon": 0.6, name: 0.3}
    advised = read_advice(ask(3, **limits))
    assert list(advised) == [name, "epsilon"] and advised[name] > limits[name]
    assert is_feasible(limits | {name: advised[name]}, 3)
    assert not is_feasible(limits | {name: advised[name] / 1.03}, 3)


def test_where_nothing_is_advised_nothing_helps() -> None:
    """Not even a hundred times the torque, or no force at all."""
    limits = {"epsilon": 0.05}
    assert read_advice(ask(1, 0.3, **limits)) == {}
    for name in LIMITS:
        generous = 0.0 if name == "epsilon" else 300.0
        assert not is_feasible(limits | {name: generous}, 1, 0.3)


def relax_by_linear_program(curve: Curve, epsilon: float, name: str) -> float | None:
    """The value at which one limit lets all others be kept at the nodes, without viscous drag.

    Then everything is linear in a, b and the squeeze at the nodes.
    """
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), INTERVALS // 4), 1)
    nodes, n_c = len(data.grid.s), 4
    forces, steps = data.nodes.forces, data.grid.steps
    assert not forces.of_tau[..., V].any()
    last = 3 * nodes
    rows: list[Array] = []
    right: list[Array] = []
    tau_limit = data.torque_limit
    relaxed = np.zeros((nodes, last + 1))
    relaxed[:, last] = 1.0

    def write(of_a: Array, of_b: Array, of_squeeze: Array) -> Array:
        """Rows of one force or torque, one for each node."""
        parts = [np.diag(part) for part in (of_a, of_b, of_squeeze)]
        return np.hstack([*parts, np.zeros((nodes, 1))])

    for i in range(n_c):
        # c_n >= epsilon, or what epsilon is relaxed to.
        give = name == "epsilon"
        row = write(forces.of_c[:, i, A], forces.of_c[:, i, B], forces.of_c[:, i, LAMBDA])
        rows.append(give * relaxed - row)
        right.append(forces.of_c[:, i, ONE] - (not give) * epsilon)
    for i in range(2):
        give = name == f"torque limit of finger {i + 1}"
        row = write(forces.of_tau[:, i, A], forces.of_tau[:, i, B], forces.of_tau[:, i, LAMBDA])
        high = (not give) * tau_limit[i]
        rows += [row - give * relaxed, -row - give * relaxed]
        right += [high - forces.of_tau[:, i, ONE], high + forces.of_tau[:, i, ONE]]
    equal = np.zeros((nodes + 1, last + 1))
    for k, step in enumerate(steps):
        equal[k, [k, k + 1]] = -step
        equal[k, [nodes + k, nodes + k + 1]] = -1.0, 1.0
    equal[nodes - 1, [0, 1]] = -1.0, 1.0
    equal[nodes, [nodes - 2, nodes - 1]] = -1.0, 1.0
    free_range: Any = (None, None)
    rest: Any = (0.0, 0.0)
    b_range = [rest, *[(0.0, None)] * (nodes - 2), rest]
    sign = -1.0 if name == "epsilon" else 1.0
    result = linprog(
        sign * np.eye(last + 1)[last],
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(right),
        A_eq=equal,
        b_eq=np.zeros(nodes + 1),
        bounds=[free_range] * nodes + b_range + [free_range] * nodes + [(0.0, None)],
    )
    return float(result.x[last]) if result.success else None


@pytest.mark.parametrize(
    "phase, limits",
    [
        (1, {"epsilon": 1.0}),
        (4, {"torque limit of finger 1": 0.3}),
        (4, {"torque limit of finger 1": 0.7, "epsilon": 0.4}),
        (4, {"torque limit of finger 1": 0.3, "torque limit of finger 2": 0.05}),
    ],
)
def test_advice_is_that_of_a_linear_program(phase: int, limits: dict[str, float]) -> None:
    problem = edited(limits, viscous=0.0)
    advised = read_advice(ask(phase, viscous=0.0, **limits))
    curve = trace_phases(problem)[phase - 1]
    exact = {name: relax_by_linear_program(curve, problem.epsilon, name) for name in LIMITS}
    assert set(advised) == {name for name, value in exact.items() if value is not None}
    for name, value in advised.items():
        least = exact[name]
        assert least is not None
        # Rounded outwards, with some room for what is between nodes.
        if name == "epsilon":
            assert 0.97 * least <= value <= least
        else:
            assert least <= value <= 1.03 * least


def test_phases_that_impacts_join_are_advised_together() -> None:
    problem = problem_of(IMPACTS)
    chain = make_sequence(problem.phases, trace_phases(problem)).split()[0]
    with pytest.raises(InfeasibleError) as caught:
        chain.plan(1.0, OPTIONS)
    found = re.match(
        r"phases 1 to 3 are infeasible: c_n of (\S+) >= epsilon = 1 N is \S+ N short at "
        r"t = \d\.\d{4} s \(x = .*? mm, phi = .*? deg\), phase ([123])",
        str(caught.value),
    )
    assert found is not None, str(caught.value)
    assert found[1] in chain.phases[int(found[2]) - 1].formation.names
    (value,) = read_advice(str(caught.value)).values()
    assert all(plan.motion.duration > 0 for plan in chain.plan(value, OPTIONS))
    # Where only the fact counts, no time is spent on advice.
    with pytest.raises(SolverError, match=r"^phases 1 to 3: Ipopt stopped with "):
        chain.plan(1.03 * value, OPTIONS, explained=False)


def test_too_short_a_duration_is_named(curves: tuple[Curve, ...]) -> None:
    duration = 0.1
    options = PlanOptions("margin", intervals=INTERVALS)
    least = plan_path(curves[0], 0.05, OPTIONS, 1).value
    with pytest.raises(
        InfeasibleError, match=f"^phase 1 is infeasible: duration = {duration:g} s is"
    ) as caught:
        plan_path(curves[0], 0.05, options, 1, duration)
    advised = read_advice(str(caught.value))
    assert list(advised) == ["duration"]
    # Both solves are good to 1e-6.
    assert least * (1 - 1e-6) < advised["duration"] < 1.03 * least
    assert plan_path(curves[0], 0.05, options, 1, advised["duration"]).value > 0.05 * (1 - 1e-6)


def bound(toy: Toy) -> LowerBound:
    with toy.in_place():
        found = bound_least_time([toy.curve], toy.epsilon)
    assert found is not None
    return found


STEP = math.sqrt(0.75 * LIMIT), math.sqrt(0.5 * LIMIT)
CLOSED = [
    (Toy(constant(1.0)), math.sqrt(2.0)),
    (Toy(constant(1.0), length=0.03), 2 * math.sqrt(0.03 / LIMIT)),
    (Toy(constant(1.0, 1.0)), 2 / math.sqrt(LIMIT - EPSILON)),
    (Toy(constant(1.0), speed_limit=(0.3, np.inf)), 1 / 0.3 + 0.3 / LIMIT),
    (Toy(constant(1.0), speed_limit=(1.2, np.inf)), 1 / 1.2 + 1.2 / LIMIT),
    (Toy(constant(1.0), speed_limit=(1.6, np.inf)), math.sqrt(2.0)),
    (Toy(inertia(lambda s, later: 1.0 + s)), find_time_growing()),
    (
        Toy(inertia(lambda s, later: np.where(later, 2.0, 1.0)), breaks=(0.5,)),
        (2 * STEP[0] - STEP[1]) / LIMIT + STEP[1] / (LIMIT / 2),
    ),
    (Toy(constant(1.0, 0.0, 0.1)), find_time_viscous(0.1)),
    (Toy(constant(1.0, 0.0, 0.5)), find_time_viscous(0.5)),
    (Toy(constant(1.0, 0.0, 3.0)), find_time_viscous(3.0)),
]


@pytest.mark.parametrize("case", range(len(CLOSED)))
def test_closed_forms_are_bounded_closely(case: int) -> None:
    toy, exact = CLOSED[case]
    found = bound(toy)
    assert exact * (1 - 1e-6) < found.value <= exact * (1 + 1e-9)
    assert 0 <= found.error < 1e-7 * exact


def test_two_bounds_are_one() -> None:
    half = Toy(constant(1.0, 0.5, 0.2))
    with half.in_place():
        joined = bound_least_time((half.curve, half.curve), half.epsilon)
    assert joined is not None
    assert joined.value == pytest.approx(bound(Toy(half.law, length=2.0)).value, rel=1e-7)


def test_no_motion_has_no_bound() -> None:
    # The squeeze alone, 0.05 N at a lever of 50 m, takes more torque than there is.
    toy = Toy(constant(1.0, 50.0))
    with toy.in_place():
        assert bound_least_time([toy.curve], toy.epsilon) is None


@pytest.mark.parametrize("phase", [0, 2])
def test_any_costate_gives_a_lower_bound(curves: tuple[Curve, ...], phase: int) -> None:
    """Whatever p and p' are, no motion within the limits has less than H in the integrand."""
    curve, rng = curves[phase], np.random.default_rng(phase)
    count = 4000
    s = rng.uniform(0, curve.length, count)
    segment = np.searchsorted([part.stop for part in curve.segments[:-1]], s)
    point = curve.evaluate(s)
    signs = (np.array([getattr(p, name) for p in curve.segments]) for name in ("Xi", "sigma"))
    directions = Directions(*(sign[segment] for sign in signs))
    forces = inverse(curve.formation, *point[:3], directions)
    a, b = rng.uniform(-20, 20, count), 4 * rng.uniform(0, 1, count) ** 3
    squeeze = rng.uniform(-10, 10, count)
    rates = point.z_s[:, 3:] * np.sqrt(b)[:, None]
    y = np.hstack([forces.c(a, b, squeeze), forces.tau(a, b, squeeze), rates])
    limits = make_limits(curve.formation, EPSILON)
    kept = (limits.find_slack(y @ limits.rows.T) >= 0).all(axis=1)
    assert kept.sum() > 100
    rows = find_limits(curve, EPSILON, point, segment)
    p = rng.normal(0, 0.05, count) * (rng.uniform(0, 1, count) > 0.1)
    slope = rng.normal(0, 2, count)
    value = 1 / np.sqrt(b) - slope * b - 2 * p * a
    least = find_least(rows, p, slope)
    assert (value - least)[kept].min() >= -1e-9


@pytest.mark.parametrize("phase", [0, 2, 4])
def test_plans_come_near_the_bound(curves: tuple[Curve, ...], phase: int) -> None:
    found = bound_least_time([curves[phase]], EPSILON)
    assert found is not None and found.error < 3e-8 * found.value
    plan = plan_path(curves[phase], EPSILON, PlanOptions(intervals=80), 1)
    # What is asked of the defaults: 5e-4. The bound is good to its error.
    assert -1e-7 < plan.value / found.value - 1 < 2e-4


def test_plans_of_a_chain_come_near_the_bound() -> None:
    problem = problem_of(IMPACTS)
    chain = make_sequence(problem.phases, trace_phases(problem)).split()[0]
    found = bound_least_time(chain.continuous_curves, EPSILON)
    assert found is not None
    plans = chain.plan(EPSILON, PlanOptions(intervals=80))
    assert -1e-7 < sum(plan.value for plan in plans) / found.value - 1 < 5e-4


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


OCTAGON = """
    v0-palm v1-palm e2-tip1 v7-finger2 > v0-finger2
    v0-palm e2-tip1 v0-finger2 v7-finger2 > v2-tip1
    v0-palm v2-tip1 v0-finger2 v7-finger2 > e1-tip1
    v0-palm e1-tip1 v0-finger2 v7-finger2 > v1-palm
"""
"""A slide on edge 0 until an edge is flush on finger 2, and the flip that follows."""


def trace_octagon() -> tuple[list[Curve], float]:
    """The curves of the flip, which is slowest by far where a joint turns back, and epsilon."""
    finger = {"length": 0.2, "radius": 0.015, "inertia": 0.004, "viscous": 0.01, "dry": 0.01}
    finger["torque_limit"] = 5.0
    near, far = 0.02296, 0.05543
    corners = [(-near, -far), (near, -far), (far, -near), (far, near)]
    phases = [own.split(" > ") for own in OCTAGON.split("\n") if own.strip()]
    problem = build_problem(
        {
            "object": {"vertices": [*corners, *((-x, -y) for x, y in corners)], "mass": 0.5},
            "fingers": {
                "1": {"base": [0.14, -0.02], **finger},
                "2": {"base": [-0.14, -0.02], **finger},
            },
            "friction": {"palm": 0.29, "finger1": 0.2, "finger2": 0.2},
            "epsilon": 0.05,
            "start": {"flush": 0, "x": -0.11},
            "phases": [{"contacts": own.split(), "until": until} for own, until in phases],
        }
    )
    z, curves = problem.start, []
    for phase in problem.phases:
        curves.append(trace_phase(phase, z, problem.phases[phase.index + 1 :]))
        z = curves[-1].end
    return curves[1:], problem.epsilon


def test_a_place_that_motions_hardly_pass_is_found_on_any_first_grid(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Some of the grids are too coarse there for any motion, others for more than a crawl."""
    curves, epsilon = trace_octagon()
    least = []
    for intervals in (50, 100):
        monkeypatch.setattr(lower_bound, "GRID_INTERVALS", intervals)
        found = bound_least_time(curves, epsilon)
        assert found is not None
        least.append(found.value)
    assert least == pytest.approx([least[-1]] * len(least), rel=1e-5)
    assert look_along(curves, epsilon, 1000) == pytest.approx(least[-1], rel=1e-3)
    # Nor does the search for routes give up the border on which it lies.
    slow = curves[1]
    place = make_place(slow.formation.scene, slow.start)
    border = BorderEdge(place, slow, None, Terms(epsilon, 0.1))
    edge = edge_along((border,), (1.0,), (), border.stop)
    # A crawl through that place on the first grid is a tenth too slow; 1 would be no estimate.
    assert isinstance(edge, Edge) and edge.estimate == pytest.approx(
        look_along([slow], epsilon, 1000), rel=0.2
    )


def test_torques_follow_a_motion_that_fades() -> None:
    """Half of the last interval's time passes on a hundredth of its way."""
    problem = build_problem(draw_case(1128, 462).table)
    trajectory = solve(problem, "margin", replay=False).trajectory
    (motion,), torque = trajectory.motions, trajectory.torque
    t = np.linspace(0.0, motion.duration, 2001)
    t = t[np.abs(t[:, None] - torque.breaks).min(axis=1) > 1e-9 * motion.duration]
    misfit = (torque.at(t) - motion.evaluate(t).tau) / problem.scene.torque_limit
    assert np.abs(misfit).max() < 1e-5
