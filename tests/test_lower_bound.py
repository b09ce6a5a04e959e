"""Least times of many ways at once, against closed forms."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import numpy as np
import pytest

from shipped import IMPACTS, problem_of
from toys import LIMIT, Toy, constant, find_time_growing, find_time_viscous, inertia
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics.dynamics import Directions, inverse
from wholearm.mechanics.limits import make_limits
from wholearm.planning.lower_bound import lower_bound
from wholearm.planning.lower_bound.lower_bound import (
    LowerBound,
    bound_least_time,
    find_least,
    look_along,
)
from wholearm.planning.lower_bound.rows import PathLimitRows, evaluate_rows
from wholearm.planning.lower_bound.speed_sweep import NoMotionError, find_fastest
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.impact_sequence import make_sequence
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.path_domain.sequence_plan import plan_sequence
from wholearm.problem.read import build_problem
from wholearm.search.travel_times import find_durations

EPSILON = 0.05


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


def test_two_halves_are_one_whole() -> None:
    half = Toy(constant(1.0, 0.5, 0.2))
    with half.in_place():
        joined = bound_least_time((half.curve, half.curve), half.epsilon)
    assert joined is not None
    assert joined.value == pytest.approx(bound(Toy(half.law, length=2.0)).value, rel=1e-7)


@pytest.mark.parametrize("largest", [True, False])
def test_rows_that_say_the_same_are_told_apart_by_their_order(largest: bool) -> None:
    """Not by rounding: where a limit has no squeeze, all its pairs are one."""
    rng, sign = np.random.default_rng(0), 1.0 if largest else -1.0
    a, b, v, one = (np.tile(rng.uniform(1, 2, (50, 1)), 3) for _ in range(4))
    noise = 1 + 1e-14 * rng.uniform(-1, 1, one.shape)
    # The last one is farther away by a millionth.
    farther = np.array([1.0, 1.0, 1.0 + 1e-6])
    rows = PathLimitRows(-sign * a, -b, v, one * noise + 5.0, np.full(50, np.inf))
    found = rows._replace(one=rows.one * farther).extreme(np.ones(50), largest)
    np.testing.assert_array_equal(found.row, 0)
    nearer = rows._replace(one=rows.one * (2 - farther)).extreme(np.ones(50), largest)
    np.testing.assert_array_equal(nearer.row, 2)


def test_no_motion_has_no_bound() -> None:
    # The squeeze alone, 0.05 N at a lever of 50 m, takes more torque than there is.
    toy = Toy(constant(1.0, 50.0))
    with toy.in_place():
        assert bound_least_time([toy.curve], toy.epsilon) is None


@pytest.mark.parametrize("cap", [3.0, 5.0])
def test_a_motion_has_to_be_as_fast_as_the_end_asks_for(cap: float) -> None:
    """At the end s'' is -2, so that rest is reached over 1 m from b = 4, which the cap forbids."""
    sides, none = np.tile([1.0, -1.0], (2, 1)), np.zeros((2, 2))
    rows = PathLimitRows(sides, none, none, np.array([[10.0, 10.0], [2.0, -2.0]]), np.full(2, cap))
    given = rows, np.ones(2), np.full(2, 0.5), np.array([np.inf, cap, np.inf]), None
    if cap < 4.0:
        with pytest.raises(NoMotionError):
            find_fastest(*given)
    else:
        assert find_fastest(*given).b == pytest.approx([0.0, 4.0, 0.0], abs=1e-12)


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
    rows = evaluate_rows(curve, EPSILON, s, segment)
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
    plans = plan_sequence(chain, EPSILON, PlanOptions(intervals=80))
    assert -1e-7 < sum(plan.value for plan in plans) / found.value - 1 < 5e-4


def test_the_bound_shares_nothing_with_the_nlp() -> None:
    folder = Path(__file__).parents[1] / "src/wholearm/planning/lower_bound"
    files = list(folder.glob("*.py"))
    assert len(files) > 3
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                first = (node.module or "").split(".")[0]
                own = ("common", "geometry", "mechanics")
                assert node.level < 2 or first in own
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


LENGTH, COUNT = 2.0, 64


def push() -> tuple[PathLimitRows, tuple[np.ndarray, np.ndarray]]:
    """|s''| <= 1 along a way."""
    shape = (1, COUNT, 2)
    a = np.broadcast_to([1.0, -1.0], shape).copy()
    rows = PathLimitRows(
        a, np.zeros(shape), np.zeros(shape), np.ones(shape), np.full((1, COUNT), np.inf)
    )
    return rows, (np.full(COUNT, LENGTH / COUNT), np.full(COUNT, 0.5))


def test_half_the_way_is_for_speeding_up_and_half_for_braking() -> None:
    rows, grid = push()
    # With s'' the same in each interval this motion is on the grid, where intervals are even.
    assert find_durations(rows, *grid)[0] == pytest.approx(2 * np.sqrt(LENGTH), rel=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_closed_place_lets_no_viscous_motion_pass() -> None:
    rows, grid = push()
    closed = slice(0, COUNT // 4)
    rows.a[0, closed], rows.one[0, closed] = 0.0, -1.0
    rows.v[:] = -0.1
    assert find_durations(rows, *grid)[0] == np.inf
