from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shipped import HEPTAGON, plan_of, problem_of
from wholearm.engines.stretch import apply_friction, find_between, list_steps, list_stretches
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory_file import load_trajectory


def test_phases_are_stretches_or_the_whole_plan_is() -> None:
    plan = plan_of(HEPTAGON)
    (whole,) = list_stretches(plan, True)
    assert (whole.phases, whole.start, whole.stop) == (tuple(range(5)), 0.0, plan.duration)
    third = list_stretches(plan, False)[2]
    assert third.phases == (2,)
    np.testing.assert_allclose([third.start, third.stop], plan.phase_starts[2:4])
    assert tuple(third.c_n) == plan.motions[2].contacts


def test_steps_of_a_constant_force_are_exact() -> None:
    # Velocity by the force, then position by the velocity: half a step's start makes it exact.
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    stretch = list_stretches(plan, False)[0]._replace(z_dot=np.full(5, 0.3), z_ddot=np.full(5, 2.0))
    torque = TorqueProfile(np.array([0.0, 1.0]), np.full((1, 2, 1), 0.7))
    steps = list_steps(problem, stretch, torque, 0.01)
    assert steps.h <= 0.01 * problem.scene.scales.time and steps.ends[-1] == len(steps.tau)
    assert steps.h * len(steps.tau) == pytest.approx(stretch.stop - stretch.start)
    z, v = stretch.z.copy(), steps.v.copy()
    for _ in range(7):
        v += steps.h * 2.0
        z += steps.h * v
    t = 7 * steps.h
    np.testing.assert_allclose(z, stretch.z + 0.3 * t + t**2, rtol=1e-13)
    np.testing.assert_allclose(steps.tau, 0.7)


def test_torques_are_averages_around_positions() -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    stretch = list_stretches(plan, False)[0]
    ramp = TorqueProfile(np.array([0.0, 2.0]), np.array([[[1.0, 1.0], [2.0, 2.0]]]))
    steps = list_steps(problem, stretch, ramp, 0.01)
    t = steps.h * np.arange(1, len(steps.tau))
    np.testing.assert_allclose(steps.tau[1:], np.column_stack([t, 2 * t]), rtol=1e-9)


def test_dry_friction_has_the_planned_sign() -> None:
    plan, scene = plan_of(HEPTAGON), problem_of(HEPTAGON).scene
    t = np.linspace(1e-4, plan.duration - 1e-4, 997)
    speeds = plan.at(t).z_dot[:, 3:]
    taken = plan.torque.at(t) - apply_friction(scene, plan).at(t)
    clear = np.abs(speeds) > 1e-3 * scene.scales.rate
    assert clear.mean() > 0.95 and {*np.sign(speeds[clear])} == {-1.0, 1.0}
    np.testing.assert_allclose(taken[clear], 0.01 * np.sign(speeds[clear]), atol=1e-9)


def test_a_plan_is_known_between_the_rows_of_its_file(tmp_path: Path) -> None:
    plan = plan_of(HEPTAGON)
    plan.save(tmp_path / "plan.npz")
    loaded = load_trajectory(tmp_path / "plan.npz")
    found, t = find_between(loaded), np.linspace(0.0, plan.duration - 1e-9, 2001)
    off = [np.nanmean(np.abs(own.at(t).c_n - plan.at(t).c_n)) for own in (found, loaded)]
    assert off[0] < 0.1 * off[1]
    # What does not replay as planned is taken as it is.
    weaker = replace(loaded.torque, coefficients=0.9 * loaded.torque.coefficients)
    wrong = replace(loaded, torque=weaker)
    assert find_between(wrong) is wrong
