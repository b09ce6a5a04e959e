from __future__ import annotations

import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.geometry.cost_to_go import CostToGo
from wholearm.geometry.tracing import trace_phase, trace_phases
from wholearm.mechanics.metric import metric_weights
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.problem.definition import Problem


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
