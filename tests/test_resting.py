from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shipped import FOLDER
from timed import landing, plan_landing
from wholearm.benchmark.stress.slow_motion import list_others, rest_margin
from wholearm.common.errors import InfeasibleError
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.resting import find_block, list_ways, pushes_one_way
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.planning.time_domain.units import in_own_units, scale_state
from wholearm.problem.read import build_problem, read_problem

COARSE = PlanOptions(time_intervals=4)


@pytest.mark.parametrize("freedoms, count", [(1, 2), (2, 20)])
def test_every_way_to_set_things_in_motion_is_listed_once(freedoms: int, count: int) -> None:
    rng = np.random.default_rng(2)
    rates = rng.normal(size=(5, freedoms))
    ways = np.array(list_ways(rates))
    signs = np.sign(np.round(ways @ rates.T, 9))
    assert len(ways) == count == len(np.unique(signs, axis=0))
    # Any acceleration is of one of these ways.
    for way in rng.normal(size=(50, freedoms)):
        assert (np.sign(rates @ way) == signs).all(axis=1).sum() == 1


def test_what_limits_forbid_at_rest_is_refused_at_once() -> None:
    problem = landing()
    z = scale_state(problem.start, problem.scene.scales)
    formation = in_own_units(problem).phases[0].formation
    # Torques of 2 N m press a heptagon of 2 N with less than 100 N.
    blocked = find_block(formation, z, 50.0)
    assert blocked is not None and blocked.contact in formation.names and blocked.short > 1.0


def test_a_finger_that_would_have_to_pull_is_named() -> None:
    """All contacts of the flip would have to press with twenty times the weight."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    feeble = problem.with_(epsilon=40.0)
    with pytest.raises(InfeasibleError, match="no motion begins in any contact mode: c_n of v"):
        plan_phases(feeble, feeble.phases[4:], start, COARSE, explained=False)
    assert plan_landing(time_intervals=6)


def test_one_contact_pushes_one_way_unless_the_centroid_passes_above_it() -> None:
    """About the vertex that touches it is weight alone that turns, whatever friction does."""
    table = dict(read_problem(str(FOLDER / "square.toml")).table)
    phase = {"contacts": ["v0-palm"], "until": {"phi_deg": 5.0}}
    problem = build_problem({**table, "phases": [phase]})
    vertex = problem.scene.polygon.vertices[0]
    upright = -np.pi / 2 - np.arctan2(vertex[1], vertex[0])
    for turns, one_way in (([0.1, 0.11], True), ([0.1, 0.0], False), ([0.1, -0.1], False)):
        z = np.repeat(problem.start[None], len(turns), axis=0)
        z[:, 2] = upright + np.array(turns)
        for friction in (0.1, 1.0):
            formation = problem.with_(friction=friction).phases[0].formation
            assert pushes_one_way(formation, z) == one_way
    with pytest.raises(InfeasibleError, match="v0-palm can only push the object one way"):
        plan_phases(problem, problem.phases, problem.start, COARSE, explained=False)
    assert not pushes_one_way(landing().phases[0].formation, landing().start[None])


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
