from __future__ import annotations

import numpy as np
import pytest

from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.stops import Plans, plan_stops
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


def test_parts_start_where_those_before_end() -> None:
    plans = plan_stops(plan_part, [0, 1, 2, 3], np.ones(5), PlanOptions())
    starts = [float(plan.motion.evaluate(np.zeros(1)).z[0, 0]) for plan in plans]
    np.testing.assert_allclose(starts, [1.0, 1.1, 1.5])
    np.testing.assert_allclose([plan.value for plan in plans], LEAST)


def test_a_duration_shorter_than_the_stops_take() -> None:
    with pytest.raises(InfeasibleError, match=r"0\.7 s is not longer .* a stop, 0\.73 s"):
        plan_stops(plan_part, [0, 1, 3], np.zeros(5), PlanOptions("margin"), 0.7)
