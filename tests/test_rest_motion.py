from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from timed import landing
from wholearm.benchmark.stress.slow_motion import list_others, rest_margin
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.time_domain.resting import find_block
from wholearm.planning.time_domain.units import in_own_units, scale_state


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("phase", [0, 3])
def test_planner_and_linear_programme_agree_on_what_rests(phase: int, ends: bool) -> None:
    """As epsilon grows, both find that nothing moves from the same value on."""
    problem = landing()
    curve = trace_phases(problem)[phase]
    z = curve.end if ends else curve.evaluate(np.zeros(1)).z[0]
    cell, scene = problem.phases[phase], problem.scene
    low, high = 0.0, 200.0
    own, scaled = in_own_units(problem), scale_state(z, problem.scene.scales)
    while high - low > 1e-3:
        middle = (low + high) / 2
        held = find_block(own.phases[phase].formation, scaled, middle, ends)
        low, high = (middle, high) if held is None else (low, middle)
    force = scene.scales.force
    assert rest_margin(scene, cell, force * (high + 0.01), z, ends) < 0.0
    assert rest_margin(scene, cell, force * (low - 0.01), z, ends) > -1e-9


def test_what_touches_and_is_none_of_the_contacts_may_only_open() -> None:
    problem = landing()
    phase, z = problem.phases[0], problem.start
    assert list_others(problem.scene, phase, z) == []
    fewer = Formation(problem.scene, phase.formation.contacts[1:])
    lifted = replace(phase, formation=fewer)
    (other,) = list_others(problem.scene, lifted, z)
    assert abs(other.gap[0]) < 1e-9
    assert rest_margin(problem.scene, lifted, 1e3, z) < 0.0
