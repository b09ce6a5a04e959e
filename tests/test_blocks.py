"""Tests of what is said where limits of motors or held torques leave phases without a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, SolverError
from wholearm.planning.blocks import Planning, explain_motors
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.stops import Plans, plan_stops
from wholearm.problem.definition import Phase, Problem
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Samples

LEAST = (0.1, 0.4, 0.3)
"""Least times of phases; those that are passed in motion take a tenth less."""


class Shift:
    """A phase that moves x by its least time, in the duration that it is given."""

    contacts = ()

    def __init__(self, x: float, way: float, duration: float) -> None:
        self.x, self.way, self.duration = x, way, duration

    def evaluate(self, t: Array) -> Samples:
        z = np.zeros((len(t), 5))
        z[:, 0] = self.x + self.way * np.asarray(t) / self.duration
        return Samples(z, 0 * z, 0 * z, z[:, :2], z[:, :0], z[:, :0])


def plan_part(
    start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
) -> Plans:
    least = np.array(LEAST[start:stop]) * (1.0 if stop == start + 1 else 0.9)
    times = least if duration is None else least * duration / least.sum()
    torque = TorqueProfile(np.array([0.0, 1.0]), np.zeros((1, 2, 1)))
    starts = z[0] + np.cumsum([0.0, *LEAST[start:stop]])
    value = times if options.goal is Objective.TIME else times / least
    return [
        PhasePlan(Shift(*own), torque, cost)
        for *own, cost in zip(starts, LEAST[start:stop], times, value, strict=False)
    ]


def test_parts_share_a_duration_by_their_least_times() -> None:
    """Then every part has as much more than its least time as any other."""
    options = PlanOptions("margin")
    plans = plan_stops(plan_part, [0, 2, 3], np.zeros(5), options, 1.5)
    assert sum(plan.motion.duration for plan in plans) == pytest.approx(1.5)
    np.testing.assert_allclose([plan.value for plan in plans], 1.5 / (0.9 * 0.5 + 0.3))


def test_a_duration_shorter_than_the_stops_take() -> None:
    with pytest.raises(InfeasibleError, match=r"0\.7 s is not longer .* a stop, 0\.73 s"):
        plan_stops(plan_part, [0, 1, 3], np.zeros(5), PlanOptions("margin"), 0.7)


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
