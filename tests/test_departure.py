from __future__ import annotations

import numpy as np
import pytest

from shipped import HEPTAGON, plan_of, problem_of
from wholearm.engines.departure import Departure, compare, find_pairs
from wholearm.engines.shapes import list_pairs
from wholearm.engines.stretch import EngineRun, list_stretches

ROWS = 201
PHASE = 1


def follow() -> EngineRun:
    """The second phase as planned, with the planned forces."""
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    motion, stretch = plan.motions[PHASE], list_stretches(plan, False)[PHASE]
    t = np.linspace(0.0, motion.duration, ROWS)
    planned, names = motion.evaluate(t), tuple(pair.name for pair in list_pairs(problem.scene))
    press = np.zeros((ROWS - 1, len(names)))
    for k, name in enumerate(motion.contacts):
        press[:, names.index(name)] = planned.c_n[1:, k]
    return EngineRun(stretch.start + t, planned.z, planned.z_dot, names, press)


def judge(run: EngineRun) -> Departure:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    return compare(problem, plan, list_stretches(plan, False)[PHASE], run, 1e-3)


def test_what_goes_as_planned_does_not_depart() -> None:
    found = judge(follow())
    assert (found.time, found.reason) == (None, "")
    assert found.position.max() < 1e-12 and found.angle.max() < 1e-12
    assert [force.contact for force in found.forces] == list(plan_of(HEPTAGON).motions[1].contacts)
    # Forces step within rows.
    assert max(abs(force.off) for force in found.forces) < 2e-2


def test_a_contact_that_opens_is_the_reason() -> None:
    run = follow()
    length, late = problem_of(HEPTAGON).scene.scales.length, np.arange(ROWS) > 100
    run.z[:, 1] += np.where(late, 2e-3 * length, 0.0)
    found = judge(run)
    assert found.time == pytest.approx(run.t[101])
    assert found.reason.startswith("v0-palm opens at t = ")


def test_a_contact_that_sticks_is_the_reason() -> None:
    run = follow()
    length, late = problem_of(HEPTAGON).scene.scales.length, np.arange(ROWS) > 120
    run.z_dot[80:] = 0.0
    run.z[:, 0] += np.where(late, 2e-3 * length, 0.0)
    found = judge(run)
    assert found.time == pytest.approx(run.t[121])
    assert "sticks at t = " in found.reason and f"{run.t[80]:.5g}" in found.reason


def test_a_contact_that_is_not_planned_is_the_reason() -> None:
    run = follow()
    run.z[121:], run.z_dot[121:] = run.z[118:-3].copy(), run.z_dot[118:-3].copy()
    assert judge(run).reason == "every contact is as planned"
    run.press[60, run.pairs.index("v6-finger2")] = 1.0
    assert judge(run).reason.startswith("v6-finger2 presses, which is not planned, at t = ")


def test_a_vertex_on_a_tip_ends_two_edges() -> None:
    assert find_pairs("v4-tip1", 6) == ("v4-finger1", "e3-tip1", "e4-tip1")
    assert find_pairs("v0-tip2", 6) == ("v0-finger2", "e5-tip2", "e0-tip2")
    assert find_pairs("e3-tip1", 6) == ("e3-tip1",)
