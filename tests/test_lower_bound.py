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
from wholearm.planning.lower_bound.path_terms import find_limits
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.impact_sequence import make_sequence, plan_sequence
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.problem.read import build_problem

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
