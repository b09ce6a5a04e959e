from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.geometry.cost_to_go import CostToGo
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics.metric import metric_weights
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain.first_guess import guess
from wholearm.planning.path_domain.path_data import PhaseData, prepare
from wholearm.planning.path_domain.path_mesh import Mesh
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_nlp import build_path_nlp, pack, parameters
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.path_domain.refine import start_at
from wholearm.planning.path_domain.speed_profile import Fastest, Narrow, find_fastest
from wholearm.planning.path_domain.terms import LimitShape
from wholearm.problem.definition import Problem

EPSILON = 0.05
ELEMENTS = 10


def prepare_on(curve: Curve, mesh: Mesh, phase: int = 1) -> PhaseData:
    return prepare(curve, EPSILON, mesh.make_grid(curve, ELEMENTS), phase)


def find(curve: Curve, duration: float | None = None) -> Fastest:
    found = find_fastest(prepare_on(curve, Mesh()), duration)
    assert isinstance(found, Fastest)
    return found


def measure(found: Fastest) -> float:
    """Duration of a motion with a constant s'' in each interval [s]."""
    speed = np.sqrt(found.b)
    return float((2 * np.diff(found.s) / (speed[1:] + speed[:-1])).sum())


@pytest.mark.parametrize("phase", range(2))
def test_a_sweep_takes_about_the_least_time(curves: tuple[Curve, ...], phase: int) -> None:
    bound = bound_least_time([curves[phase]], EPSILON)
    assert bound is not None
    assert measure(find(curves[phase])) == pytest.approx(bound.value, rel=2e-4)


def test_a_margin_takes_the_duration_that_is_allowed(curves: tuple[Curve, ...]) -> None:
    fastest = find(curves[0])
    allowed = 1.5 * measure(fastest)
    slower = find(curves[0], allowed)
    assert measure(slower) == pytest.approx(allowed, rel=1e-3)
    assert slower.margin > 0
    # With that margin no motion is faster.
    bound = bound_least_time([curves[0]], EPSILON + slower.margin)
    assert bound is not None
    assert bound.value == pytest.approx(allowed, rel=1e-3)
    assert find_fastest(prepare_on(curves[0], Mesh()), 0.9 * measure(fastest)) is None


def test_a_place_that_limits_the_margin_is_named(curves: tuple[Curve, ...]) -> None:
    """At the start of this phase no contact can press harder, however long a motion takes."""
    curve = curves[2]
    data, least = prepare_on(curve, Mesh()), measure(find(curve))
    found = find_fastest(data, 2 * least)
    assert isinstance(found, Narrow)
    assert 0 < max(place for place, _ in found.switches) < 0.02 * curve.length
    at_once, at_leisure = (
        plan_path(curve, EPSILON, PlanOptions(objective=Objective.MARGIN), 3, ratio * least).value
        for ratio in (2.0, 3.0)
    )
    assert at_leisure == pytest.approx(at_once, rel=5e-4)


@pytest.mark.parametrize("goal", [Objective.TIME, Objective.MARGIN])
def test_the_start_is_near_a_solution(curves: tuple[Curve, ...], goal: Objective) -> None:
    """The conditions of optimality of the NLP itself, derived by CasADi, almost hold."""
    curve = curves[0]
    coarse = prepare_on(curve, Mesh())
    least = measure(find(curve))
    duration = 1.5 * least if goal is Objective.MARGIN else None
    found = find_fastest(coarse, duration)
    assert isinstance(found, Fastest)
    data = prepare_on(curve, Mesh.of(curve, found.switches))
    nlp = build_path_nlp(LimitShape.of(data.limits), len(data.grid.steps), goal)
    units = guess(coarse)[1]
    start = start_at(nlp, data, units, found)[0]
    assert start.margin == found.margin
    # Limits are kept at the nodes, and so is the duration.
    slack = data.slack(data.nodes, start.profile, start.margin) / data.spans
    assert slack.min() > -1e-6
    motion = PathMotion(curve, data.grid, start.profile)
    assert motion.duration == pytest.approx(duration or least, rel=1e-3)
    oracle = nlp.solver.function.oracle()
    x, p = oracle.mx_in(0), oracle.mx_in(1)
    f, g = oracle(x, p)
    gradient = ca.Function("gradient", [x, p], [ca.gradient(f, x), ca.jacobian(g, x)])
    here = pack(nlp, start.profile, units, start.margin)
    of_f, of_g = (part.full() for part in gradient(here, parameters(nlp, data, units, 0.0)))
    multipliers = start.multipliers["lam_x0"] + of_g.T @ start.multipliers["lam_g0"]
    left = of_f[:, 0] + multipliers
    assert np.abs(left).max() < 0.03 * np.abs(of_f).max()


def test_the_gradient_of_a_linear_cost_is_its_part_along_the_curve(heptagon: Problem) -> None:
    phase = heptagon.phases[1]
    curve = trace_phases(heptagon)[1]
    slope = np.random.default_rng(4).normal(size=5)
    value, gradient = CostToGo(phase, lambda z: float(slope @ z)).expand(curve.start)
    tangent = curve.evaluate(np.zeros(1)).z_s[0]
    assert value == pytest.approx(slope @ curve.start)
    # A quotient of differences over a hundredth of a curve that bends.
    assert gradient @ tangent == pytest.approx(slope @ tangent, rel=0, abs=0.1)
    # In the metric of curves it has no part across.
    across = gradient / metric_weights(heptagon.scene) - (gradient @ tangent) * tangent
    np.testing.assert_allclose(across, 0.0, atol=1e-12 * np.abs(gradient).max())


def test_less_way_costs_less_time(heptagon: Problem) -> None:
    phase, curve = heptagon.phases[1], trace_phases(heptagon)[1]
    options = PlanOptions(intervals=40)

    def least_time(z: Array) -> float:
        return plan_path(trace_phase(phase, z), heptagon.epsilon, options, 1).value

    value, gradient = CostToGo(phase, least_time).expand(curve.start)
    tangent = curve.evaluate(np.zeros(1)).z_s[0]
    # Forwards, and with steps of another length: what is left is the bend of the time.
    ahead = 0.02 * curve.length
    slope = (least_time(curve.evaluate(np.array([ahead])).z[0]) - value) / ahead
    assert slope < 0
    assert gradient @ tangent == pytest.approx(slope, rel=0.05)
