from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shipped import BOX, HEPTAGON, IMPACTS, plan_of, problem_of
from wholearm import verify
from wholearm.common.arrays import Array
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.wedging import find_static_torques
from wholearm.simulation.statics import balances


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


def test_a_wedged_start_is_told() -> None:
    """The last phase of the margin's plan begins with a grip that friction alone can hold."""
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON, "margin")
    report = verify(problem, plan)
    phase = report.phases[-1]
    wedged = phase.wedged
    assert wedged is not None and wedged == pytest.approx(plan.meta["wedged"][-1], rel=1e-3)
    contacts, start = (
        problem.phases[-1].formation.contacts,
        plan.motions[-1].evaluate(np.zeros(1)).z[0],
    )

    def held(share: float) -> bool:
        tau: Array = plan.torque.at(np.array([phase.start + share * wedged]))[0]
        return balances(problem.scene, contacts, start, tau)

    if wedged:
        assert held(0.5) and held(0.98) and not held(1.02)
        assert any("may stay wedged" in text for text in report.warnings)
    else:
        assert not held(0.0)
