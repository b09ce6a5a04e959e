"""Torques held over control periods, chosen as such by the planner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm import InputError, Problem, load_plan, solve, verify
from wholearm.problem.read import read_own_problem

PERIOD = 0.011


@pytest.fixture(scope="module")
def slide() -> Problem:
    problem = problem_of(HEPTAGON)
    return replace(problem, phases=problem.phases[:1])


@pytest.mark.parametrize("hold", ["constant", "linear"])
def test_torques_are_held_from_period_to_period(slide: Problem, hold: str, tmp_path: Path) -> None:
    problem = slide.with_(control_period=PERIOD, control_hold=hold)
    plan = solve(problem, accuracy=1e-2, mode_search=False, replay=False)
    assert verify(problem, plan).ok
    torque, spans = plan.trajectory.torque, np.arange(0.0, plan.duration, PERIOD)
    inside = np.linspace(0.01, 0.99, 8)
    for start in spans:
        span = min(PERIOD, plan.duration - start)
        tau = torque.at(start + span * inside)
        order = 2 if hold == "linear" else 1
        assert np.abs(np.diff(tau, order, axis=0)).max() < 1e-5
    before, after = torque.at(spans[1:] - 1e-9), torque.at(spans[1:] + 1e-9)
    steps = np.abs(after - before).max()
    assert steps < 1e-3 if hold == "linear" else steps > 0.1
    (free,) = [phase.unheld for phase in plan.phases]
    assert free is not None and free < plan.value < 1.05 * free
    path = str(tmp_path / "held.npz")
    plan.save(path)
    known = load_plan(path)
    assert known.phases[0].unheld == free
    scene = read_own_problem(known.trajectory.meta, path).scene
    assert scene.control_period == pytest.approx(PERIOD) and scene.control_hold == hold


def test_keys_are_checked(slide: Problem) -> None:
    with pytest.raises(InputError, match="control_period"):
        slide.with_(control_period=-1.0)
    with pytest.raises(InputError, match="'constant' and 'linear'"):
        slide.with_(control_period=PERIOD, control_hold="cubic")
    with pytest.raises(InputError, match=r"control_period: 0.011 given; .*hold them linear"):
        solve(slide.with_(control_period=PERIOD, torque_rate_limit=100.0))
