"""Tests of torques that change in the least time that motors allow."""

from __future__ import annotations

import numpy as np
import pytest

from wholearm.problem.definition import Problem
from wholearm.results.torque_change import change_torques, find_change_times


@pytest.mark.parametrize("seed", range(8))
def test_one_motor_is_at_its_rate_or_its_command_throughout(heptagon: Problem, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rates, lags = 10 ** rng.uniform(1, 4, 2), 10 ** rng.uniform(-4, -1, 2) * [seed > 2, seed > 5]
    scene = heptagon.with_(
        torque_rate_limit1=rates[0],
        torque_rate_limit2=rates[1],
        actuator_lag1=lags[0],
        actuator_lag2=lags[1],
    ).scene
    before, after = rng.uniform(-0.98, 0.98, (2, 2)) * scene.torque_limit
    change = change_torques(scene, before, after)
    t = np.linspace(0.0, change.duration, 4001)
    tau = change.torque.at(t)
    np.testing.assert_allclose(tau[[0, -1]], [before, after], atol=1e-6)
    rate = np.gradient(tau, t, axis=0)
    command = np.abs(tau + lags * rate) / scene.torque_limit * (lags > 0)
    load = np.maximum(np.abs(rate) / rates, command).max(axis=1)[5:-5]
    assert load.max() < 1 + 1e-4
    assert load.min() > 1 - 1e-2
    assert find_change_times(scene, before, after) == pytest.approx(change.duration, rel=1e-12)


def test_a_torque_at_its_limit_is_reached_in_a_finite_time(heptagon: Problem) -> None:
    scene = heptagon.with_(torque_rate_limit=200.0, actuator_lag=0.002).scene
    limit = scene.torque_limit
    times = find_change_times(scene, 0.1 * limit, np.stack([0.1 * limit, 0.9 * limit, limit]))
    assert times[0] == 0
    assert times[1] < times[2] < 10 * 0.002 + 2 * limit.max() / 200.0
