from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shipped import BOX, HEPTAGON, IMPACTS, plan_of, problem_of
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.wedging import find_static_torques
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.sticking import balances
from wholearm.verification.force_uniqueness import find_wedged


@pytest.mark.parametrize("path", [BOX, IMPACTS], ids=lambda path: path.stem)
def test_torques_that_friction_can_hold_are_those_of_the_linear_programme(path: Path) -> None:
    problem = problem_of(path)
    rng, scene = np.random.default_rng(5), problem.scene
    for curve in trace_phases(problem)[::2]:
        contacts = curve.formation.contacts
        static = find_static_torques([curve.formation], curve.start)
        tau = rng.uniform(-1.0, 1.0, (12, 2)) * scene.torque_limit
        for own, beyond in zip(tau, static.measure(tau), strict=True):
            if abs(beyond) > 1e-4 * scene.scales.torque:
                assert balances(scene, contacts, curve.start, own) == (beyond < 0)
                if beyond < 0:
                    assert not static.is_empty(np.abs(own))
        if abs(beyond := static.measure(np.zeros((1, 2)))[0]) > 1e-4 * scene.scales.torque:
            assert static.is_empty(np.zeros(2)) == (beyond > 0)


def test_a_wedged_start_lasts_until_nothing_balances_the_torques() -> None:
    """From torques that the linear programme balances straight to four times as much."""
    problem, plan = problem_of(BOX), plan_of(BOX)
    phase = problem.phases[-1]
    rows = np.flatnonzero(plan.phase == phase.index)
    first = last = plan.tau[rows[0]]
    duration = plan.t[rows[-1]] - plan.t[rows[0]]
    z, contacts = plan.z[rows[0]], phase.formation.contacts
    while not balances(problem.scene, contacts, z, first):
        first, last = first / 2, first
    first = first / 2
    halves = (first + last) / 2, (last - first) / 2
    torque = TorqueProfile(plan.t[rows[[0, -1]]], np.stack(halves, axis=-1)[None])
    wedged = find_wedged(problem, phase, replace(plan, torque=torque), rows, 1e-9)
    assert wedged is not None and 0 < wedged < duration
    for share, held in ((0.0, True), (0.97, True), (1.03, False)):
        tau = first + share * wedged / duration * (last - first)
        assert balances(problem.scene, contacts, z, tau) == held


def test_plans_leave_rest_surely() -> None:
    """Where the largest margin of a phase is that of its start, too, friction could hold it."""
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON, "margin")
    assert plan.meta["wedged"] == [0.0] * 5
    for phase in problem.phases:
        row = int(np.flatnonzero(plan.phase == phase.index)[0])
        contacts = phase.formation.contacts
        assert not balances(problem.scene, contacts, plan.z[row], plan.tau[row])
