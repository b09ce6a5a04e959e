"""Tests of what is said where limits of motors or held torques leave phases without a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from wholearm.common.errors import InfeasibleError, SolverError
from wholearm.planning.block_plan import Planning
from wholearm.planning.options import PlanOptions
from wholearm.planning.rate_limits import explain_motors
from wholearm.planning.stops import Plans
from wholearm.problem.definition import Phase, Problem


@pytest.mark.parametrize(
    ("changes", "keys"),
    [
        ({"torque_rate_limit": 500.0}, "torque_rate_limit = 500 N m/s"),
        (
            {"torque_rate_limit1": 80.0, "actuator_lag": 0.002},
            "torque_rate_limit = 80 and inf N m/s and actuator_lag = 0.002 s",
        ),
        ({"control_period": 0.005}, "control_period = 0.005 s (constant)"),
    ],
)
@pytest.mark.parametrize("kind", [SolverError, InfeasibleError])
def test_the_keys_that_keep_a_phase_from_a_plan_are_named(
    heptagon: Problem,
    changes: dict[str, float],
    keys: str,
    kind: type[SolverError] | type[InfeasibleError],
) -> None:
    problem, error = heptagon.with_(changes), kind("no plan for phase 1 (...): none was found")

    none = [None] * len(problem.phases)
    planning = Planning(problem, (), PlanOptions(), (), [*none], [*none])
    own = planning, problem.phases[:1], planning.options, error

    def replan(other: Planning, phases: Sequence[Phase], options: PlanOptions) -> Any:
        scene = phases[0].formation.scene
        assert not scene.has_slow_motors and not scene.control_period and options
        assert scene is other.problem.scene
        return [SimpleNamespace(motion=SimpleNamespace(duration=0.125))]

    def fail(*_: object) -> Plans:
        raise InfeasibleError("phase 1 is infeasible")

    one = explain_motors(*own, replan)
    assert type(one) is kind
    assert f"without {keys} there is a plan of 0.125 s for phase 1" in str(one)
    neither = explain_motors(*own, fail)
    assert f"without {keys} none was found either: phase 1 is infeasible" in str(neither)
    quick = replace(planning, problem=heptagon)
    assert explain_motors(quick, *own[1:], fail) is error
