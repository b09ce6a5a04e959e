from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from toys import LIMIT, Toy, constant, find_time_growing, find_time_viscous, inertia
from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve
from wholearm.planning.options import CHOICES, Objective
from wholearm.planning.path_domain.elements import (
    DEGREE,
    FROM_REST,
    INSIDE,
    TO_REST,
    Profile,
    find_basis,
)
from wholearm.planning.path_domain.path_data import PhaseData, prepare
from wholearm.planning.path_domain.path_mesh import Mesh
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_nlp import (
    PathNLP,
    Tightening,
    Units,
    build_path_nlp,
    make_bounds,
    pack,
    parameters,
    unpack,
)
from wholearm.planning.path_domain.terms import LimitShape

EPSILON = 0.05
ELEMENTS = 6
INTERVALS = ELEMENTS * (DEGREE + 1) - 1
UNITS = Units(0.04, 0.03, 7.0, np.array([1.7, 0.6]), 1.3, 9.0)
SIDES = (*((row, 1.0) for row in range(6)), (4, -1.0), (5, -1.0))
SHAPE = LimitShape(6, SIDES, (0, 1, 2, 3), (4, 5), (4, 5))
"""Four sliding contacts and two torques."""


@pytest.fixture(scope="module")
def data(curves: tuple[Curve, ...]) -> PhaseData:
    """Phase 1 of the heptagon, which has a reversal."""
    data = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], ELEMENTS), 1)
    assert len(data.nonempty) == ELEMENTS * DEGREE
    return data


@pytest.fixture(scope="module")
def profile(data: PhaseData) -> Profile:
    """From rest to rest, with jumps of a and lambda at the reversal."""
    rng = np.random.default_rng(1)
    x = data.grid.s / data.curve.length
    a = 3 * (1 - 2 * x) + 0.2 * rng.uniform(-1, 1, len(x))
    a -= data.grid.integrate(a)[-1] / (2 * data.curve.length)
    b = data.grid.integrate(a)
    b[-1] = 0.0
    assert (b[1:-1] > 0).all()
    return Profile(a, b, rng.uniform(1, 6, len(x)))


def evaluate(nlp: PathNLP, data: PhaseData, x: Array, time_weight: float = 1.0) -> tuple[Any, ...]:
    """Objective and constraints of the NLP that the solver holds."""
    oracle = nlp.solver.function.oracle()
    f, g = oracle(x, parameters(nlp, data, UNITS, time_weight))
    return float(f), g.full()[:, 0]


def test_unpack_restores_the_integral_of_a(data: PhaseData, profile: Profile) -> None:
    """What Ipopt leaves of b' = 2 a is taken out, down to rounding."""
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.TIME)
    rng = np.random.default_rng(2)
    x = pack(nlp, profile, UNITS, 0.0)
    found, _ = unpack(nlp, data.grid, x + 1e-9 * rng.uniform(-1, 1, len(x)), UNITS)
    # An independent integral of 2 a over each element, from its polynomial through the nodes.
    for (start, stop), kind, a, b in zip(
        data.grid.edges,
        data.grid.kinds,
        found.a.reshape(-1, DEGREE + 1),
        found.b.reshape(-1, DEGREE + 1),
        strict=True,
    ):
        y = find_basis().y[kind]
        curve = np.polyfit(y, a, DEGREE)
        weight = {INSIDE: [1.0], FROM_REST: [2.0, 0.0], TO_REST: [-2.0, 0.0]}[int(kind)]
        rise = np.polyint(np.polymul(curve, weight)) * 2 * (stop - start)
        risen = np.polyval(rise, y) - np.polyval(rise, y[0])
        np.testing.assert_allclose(b - b[0], risen, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.b, profile.b, rtol=0, atol=1e-7)


@pytest.mark.parametrize("objective", [Objective(choice) for choice in CHOICES])
def test_constraints_are_the_limits(
    data: PhaseData, profile: Profile, objective: Objective
) -> None:
    """Distances of the constraints from their bounds are the slacks of the phase."""
    nlp = build_path_nlp(SHAPE, INTERVALS, objective)
    margin = 0.3 if objective is Objective.MARGIN else 0.0
    _, g = evaluate(nlp, data, pack(nlp, profile, UNITS, margin))
    rng = np.random.default_rng(3)
    tight = rng.uniform(0, 0.1, (len(data.grid.s), 8))
    count = len(data.grid.s)
    tightening = Tightening(tight, np.ones(count), 0.5, tight, np.ones((count, 2, 2)))
    bounds = make_bounds(nlp, data, UNITS, tightening)
    assert len(bounds["lbx"]) == len(bounds["ubx"]) == nlp.solver.function.size1_in("x0")
    assert len(bounds["lbg"]) == len(bounds["ubg"]) == len(g)

    first = nlp.columns.g["limits"].start
    np.testing.assert_allclose(g[:first], 0.0, atol=1e-13)
    np.testing.assert_array_equal(bounds["lbg"][:first], bounds["ubg"][:first])
    rows = slice(first, first + 6 * (INTERVALS + 1))
    low = (g - bounds["lbg"])[rows].reshape(-1, 6)
    high = (bounds["ubg"] - g)[rows].reshape(-1, 6)
    slack = data.slack(data.nodes, profile, margin) - tight
    np.testing.assert_allclose(low[:, :4] * UNITS.force, slack[:, :4], rtol=0, atol=1e-11)
    assert np.isposinf(high[:, :4]).all()
    np.testing.assert_allclose(low[:, 4:] * UNITS.torque, slack[:, 4:6], rtol=0, atol=1e-12)
    np.testing.assert_allclose(high[:, 4:] * UNITS.torque, slack[:, 6:], rtol=0, atol=1e-12)
    if objective is Objective.MARGIN:
        # The quadrature of the constraint is not that of the motion.
        late = (bounds["ubg"][-1] - g[-1]) * UNITS.time
        motion = PathMotion(data.curve, data.grid, profile)
        assert late == pytest.approx(0.5 - motion.duration, rel=0.02)


def test_a_slow_start_is_within_bounds_on_any_grid(curves: tuple[Curve, ...]) -> None:
    """However near to rest the first nodes are: along it b = 2 a s grows from nothing."""
    for elements in (ELEMENTS, 5 * ELEMENTS):
        fine = prepare(curves[0], EPSILON, Mesh().make_grid(curves[0], elements), 1)
        intervals, s = elements * (DEGREE + 1) - 1, fine.grid.s
        nlp = build_path_nlp(SHAPE, intervals, Objective.MARGIN)
        units = UNITS._replace(length=s[-1])
        slow = 1e-8 * units.profile[1] * np.ones_like(s)
        b = 2 * slow * np.minimum(s, s[-1] - s)
        rest = Profile(np.where(s < s[-1] / 2, slow, -slow), b, 0 * s)
        bounds = make_bounds(nlp, fine, units, Tightening.none(fine, 1.0))
        assert (pack(nlp, rest, units, 0.0) >= bounds["lbx"]).all()


def test_elastic_constraints_give_way(data: PhaseData, profile: Profile) -> None:
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.ELASTIC)
    short = np.random.default_rng(4).uniform(0, 1, (len(data.grid.s), 6))
    _, hard = evaluate(nlp, data, pack(nlp, profile, UNITS, 0.0))
    _, soft = evaluate(nlp, data, pack(nlp, profile, UNITS, short / UNITS.of(data.limits)))
    change = (soft - hard)[INTERVALS:].reshape(-1, 8)
    np.testing.assert_allclose(change[:, :4] * UNITS.force, short[:, :4], atol=1e-12)
    np.testing.assert_allclose(change[:, 4:6] * UNITS.torque, short[:, 4:], atol=1e-12)
    np.testing.assert_allclose(change[:, 6:] * UNITS.torque, -short[:, 4:], atol=1e-12)


def test_objectives_measure_the_motion(data: PhaseData, profile: Profile) -> None:
    """Up to the rule of each interval and the small weights that choose among equals."""
    motion = PathMotion(data.curve, data.grid, profile)
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.TIME)
    time, _ = evaluate(nlp, data, pack(nlp, profile, UNITS, 0.0))
    assert time * UNITS.time == pytest.approx(motion.duration, rel=0.02)
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.EFFORT)
    x = pack(nlp, profile, UNITS, 0.0)
    light, heavy = (evaluate(nlp, data, x, weight)[0] for weight in (1.0, 3.0))
    unit = UNITS.power * UNITS.time
    assert (heavy - light) / 2 * unit == pytest.approx(motion.duration, rel=0.02)
    t = np.linspace(0, motion.duration, 4001)
    squares = trapezoid((motion.evaluate(t).tau ** 2).sum(axis=1), t)
    assert (light - (heavy - light) / 2) * unit == pytest.approx(squares, rel=0.03)
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.MARGIN)
    low, high = (evaluate(nlp, data, pack(nlp, profile, UNITS, m))[0] for m in (0.0, 1.4))
    assert low - high == pytest.approx(1.4 / UNITS.force, rel=1e-12)


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


def test_no_speed_comes_out_imaginary(data: PhaseData, profile: Profile) -> None:
    """Where a motion all but stops, b integrated again from a may fall below zero by rounding."""
    nlp = build_path_nlp(SHAPE, INTERVALS, Objective.TIME)
    s, steps = data.grid.s, data.grid.steps
    middle = len(s) // 2

    def integrate(a: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(steps * (a[1:] + a[:-1]))])

    # Twice up and down from rest to rest, less a hair in the middle.
    shapes = np.array([np.sin(4 * np.pi * s / s[-1]), np.ones_like(s), s / s[-1]])
    reached = np.array([integrate(shape)[[middle, -1]] for shape in shapes])
    shares = np.linalg.solve(reached[1:].T, [-1e-9, 0.0] - reached[0])
    a = shapes[0] + shares @ shapes[1:]
    assert integrate(a)[middle] == pytest.approx(-1e-9, abs=1e-12)
    found, _ = unpack(nlp, data.grid, pack(nlp, profile._replace(a=a), UNITS, 0.0), UNITS)
    assert found.b[middle] == 0.0 and found.b.min() == 0.0
