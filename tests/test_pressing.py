from __future__ import annotations

import numpy as np
import pytest

from shipped import LANDING, plan_of, problem_of
from wholearm.contacts.formation import Formation, find_touching
from wholearm.engines.pressing import LOOSE, press_in
from wholearm.engines.stretch import list_stretches

STIFFNESS = 1e8


@pytest.mark.parametrize("phase", [0, 5])
def test_contacts_press_and_what_was_let_go_is_loose(phase: int) -> None:
    problem, plan = problem_of(LANDING), plan_of(LANDING)
    stretch, length = list_stretches(plan, False)[phase], problem.scene.scales.length
    names = problem.phases[phase].formation.names
    z = press_in(problem, stretch, dict.fromkeys(names, STIFFNESS))
    touching = Formation(problem.scene, find_touching(problem.scene, stretch.z))
    before, after = (touching.evaluate(at[None], np.zeros((1, 5))).C[0] for at in (stretch.z, z))
    gaps = dict(zip(touching.names, after - before, strict=True))
    for name in names:
        assert -gaps.pop(name) == pytest.approx(stretch.c_n[name] / STIFFNESS, rel=1e-4)
    # The landing begins where the plan lets v3 go from the finger.
    assert list(gaps) == ([] if phase == 0 else ["v3-finger1"])
    assert all(gap == pytest.approx(LOOSE * length, rel=1e-4) for gap in gaps.values())
