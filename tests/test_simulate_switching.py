"""Phases that end where a contact begins to slip, or comes to rest, at no other event."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from planned import plan_landing
from pushing import Roll
from test_simulate_rolling import fall
from tipping import constant, falling, roll
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import End, Phase, Problem, Until
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import EventKind, OutcomeKind
from wholearm.simulation.simulate import simulate
from wholearm.verification.verify import verify


def divide(problem: Problem, formations: Sequence[Formation]) -> Problem:
    """The problem's last phase in several, of which all but the last have no end of their own."""
    last = problem.phases[-1]
    first = [Phase(k, one, Until(), End.SMOOTH) for k, one in enumerate(formations[:-1])]
    final = dataclasses.replace(last, index=len(first), formation=formations[-1])
    return dataclasses.replace(problem, phases=(*first, final))


@pytest.mark.parametrize("mu", [0.25, 0.36, 0.6])
def test_a_falling_box_rolls_until_it_slips_in_closed_form(mu: float) -> None:
    """The phase ends when the cone is left; then it is as if there had been one sliding phase."""
    problem = falling(mu, 0.2)
    rolling = problem.phases[0].formation
    sliding = dataclasses.replace(rolling, rolling=())
    torque, times = constant((-0.01, 0.01), 1.0), np.linspace(0.0, 0.2, 21)
    both, alone = (
        simulate(divide(problem, formations), torque, tolerance=1e-12, times=times)
        for formations in ([rolling, sliding], [sliding])
    )
    time = fall(mu, 0.2)[0]
    (end,) = both.find(EventKind.ARRIVAL)
    assert (end.phase, end.contact) == (0, "v1-palm")
    assert end.time == pytest.approx(time, abs=1e-9)
    assert end.text == f"v1-palm slips at t = {time:.5g} s, phase 1"
    assert both.outcome.kind is alone.outcome.kind is OutcomeKind.LIMIT_REACHED
    for t in times:
        np.testing.assert_allclose(both.at(t), alone.at(t), rtol=0, atol=1e-10)
    # It slides, and friction takes energy, from there on only.
    assert not both.energies.contact[both.phase == 0].any() and both.energies.contact[-1] > 0


@pytest.mark.parametrize("share, late", [(0.3, -3e-10), (-0.8, 3e-10)])
def test_phases_end_where_a_vertex_comes_to_rest_and_slips_by_plan(
    share: float, late: float
) -> None:
    """By inverse dynamics it rests from 0.06 to 0.1 s, though the torques step by a hair off."""
    problem, trajectory = plan_landing()
    last = problem.phases[1]
    start = trajectory.motions[1].evaluate(np.array([0.1])).z[0]
    plan, sliding = Roll(last.formation, start, share), last.formation
    rolling = roll(sliding, "v1-palm")
    problem = divide(dataclasses.replace(problem, start=start), [sliding, rolling, sliding])
    exact = plan.fit()
    inner = np.where((exact.breaks > 0) & (exact.breaks < 0.15), late, 0.0)
    torque = TorqueProfile(exact.breaks + inner, exact.coefficients)
    simulation = simulate(problem, torque, tolerance=1e-11)
    ends = simulation.find(EventKind.ARRIVAL)
    assert [e.text.split(" at ")[0] for e in ends] == ["v1-palm comes to rest", "v1-palm slips"]
    assert [e.phase for e in ends] == [0, 1]
    np.testing.assert_allclose([e.time for e in ends], [0.06, 0.1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(simulation.z[-1], plan.move(0.15, 2)[0], rtol=0, atol=1e-5)
    report = verify(problem, torque)
    assert [phase.until for phase in report.phases] == ["change of v1-palm"] * 2 + ["v2-palm"]
    sticks = [change for change in report.changes if change.time < 0.14]
    assert [(change.what, change.kind, change.phase) for change in sticks] == [
        ("v1-palm", "sticks", 1)
    ]
    line = ["1", "v1-palm", "sticks", f"{sticks[0].time:.5f}"]
    assert line in [text.split() for text in report.to_text().splitlines()]
    assert report.to_dict()["changes"][0]["what"] == "v1-palm"


def test_torques_may_end_before_anything_slips_or_comes_to_rest() -> None:
    problem = falling(0.36, 0.2)
    rolling = problem.phases[0].formation
    sliding = dataclasses.replace(rolling, rolling=())
    time = fall(0.36, 0.2)[0]
    torque = constant((-0.01, 0.01), 0.9 * time)
    for order, missing in (([rolling, sliding], "slips"), ([sliding, rolling], "comes to rest")):
        simulation = simulate(divide(problem, order), torque)
        assert simulation.outcome.kind is OutcomeKind.GOAL_MISSED
        assert simulation.outcome.text.endswith(f", phase 1, before v1-palm {missing}")


def test_what_sticks_as_it_slips_again_and_rests_ends_one_phase_each() -> None:
    """Between two slips the box sticks; what is stuck from the start has not come to rest."""
    problem = falling(0.36, 0.2)
    rolling = problem.phases[0].formation
    sliding = dataclasses.replace(rolling, rolling=())
    torque = constant((-0.01, 0.01), 1.0)
    alone = simulate(divide(problem, [sliding]), torque, tolerance=1e-12)
    changes = [e for e in alone.events if e.contact == "v1-palm"]
    assert [e.kind for e in changes] == [EventKind.SLIP, EventKind.STICK, EventKind.SLIP]
    parts = simulate(divide(problem, [sliding, rolling, sliding]), torque, tolerance=1e-12)
    ends = [e.time for e in parts.find(EventKind.ARRIVAL)]
    np.testing.assert_allclose(ends, [e.time for e in changes[1:]], rtol=0, atol=1e-9)
