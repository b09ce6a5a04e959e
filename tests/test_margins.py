from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from planned import plan_landing
from wholearm.simulation.simulate import simulate
from wholearm.verification.margins import find_lowest, list_normal_forces


def test_least_of_a_parabola_is_exact() -> None:
    t = np.array([0.0, 0.4, 1.0])
    least, time = find_lowest(t, (t - 0.55) ** 2 + 0.2, t[[0, -1]])
    assert least == pytest.approx(0.2, abs=1e-13)
    assert time == pytest.approx(0.55, abs=1e-13)


def test_no_parabola_crosses_a_kink_or_a_jump() -> None:
    flat_then_steep = np.array([0.05, 0.05, 0.05, 1.0, 2.0])
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    assert find_lowest(t, flat_then_steep, np.array([0.0, 0.2, 0.4]))[0] == 0.05
    t = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    values = np.array([1.0, 1.0, 0.2, 0.3, 0.5])
    # Inside the second stretch the parabola through its three points has its least at its start.
    assert find_lowest(t, values, np.array([0.0, 0.3]))[0] == pytest.approx(0.2, abs=0.01)
    assert all(math.isnan(x) for x in find_lowest(t, np.full(5, np.nan), t))


def test_a_contact_let_go_softly_counts_until_it_passes_epsilon() -> None:
    problem, trajectory = plan_landing()
    simulation, low = simulate(problem, trajectory), problem.epsilon / 2
    rows, column = np.flatnonzero(simulation.phase == 0), simulation.contacts.index("v3-finger1")
    c_n = simulation.c_n.copy()
    c_n[rows, column] = 2 * problem.epsilon
    c_n[rows[[3, -2, -1]], column] = low, low, 0.0
    given = replace(simulation, c_n=c_n)
    forces = list_normal_forces(problem, given, problem.phases[0], rows)["v3-finger1"]
    assert np.isnan(forces[-2:]).all() and np.nanmin(forces) == forces[3] == low
