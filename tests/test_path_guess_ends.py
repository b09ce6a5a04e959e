from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plane import make_formation, measure_gaps, measure_slip
from timed import landing
from tipping import roll, tilting
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.geometry.explore import close_contacts
from wholearm.geometry.path_guess import guess_curve, guess_onwards, guess_phase, load
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import End, Phase, Problem, Until

CLOSED = 1e-9
"""Gap [m] that counts as closed: what a trajectory file promises."""


FOLDER = Path(__file__).parents[1] / "problems"


@pytest.fixture(scope="module")
def hexagon() -> Problem:
    return load(str(FOLDER / "hexagon.toml"))


@pytest.fixture(scope="module")
def square() -> Problem:
    return load(str(FOLDER / "square.toml"))


def test_an_end_is_found_where_the_nearest_one_breaks_a_limit(hexagon: Problem) -> None:
    """v0 is lifted until edge 0 is flush on finger 2, while v1 stays on the link's side."""
    start = trace_phases(hexagon)[4].end
    formation = make_formation(hexagon.scene, "v1-palm v3-finger1 v0-finger2")
    until = parse_contact("v1-finger2", hexagon.scene)
    ending = Formation(hexagon.scene, (*formation.contacts, until))
    nearest = close_contacts(ending, start, np.zeros(0))
    assert nearest is not None and ending.evaluate_limits(nearest[None]).min() < -CLOSED
    (part,) = guess_phase(Phase(5, formation, Until(until)), start)
    assert np.abs(measure_gaps(ending, part.z[-1])).max() < CLOSED
    assert formation.evaluate_limits(part.z).min() > -CLOSED
    # Edge 0 leaves the palm by the angle between finger 2 and the left end of the palm.
    np.testing.assert_allclose(part.z[-1, 2], part.z[-1, 4] - np.pi, atol=1e-9)


def test_an_end_that_is_nowhere_is_named(hexagon: Problem) -> None:
    start = trace_phases(hexagon)[4].end
    formation = make_formation(hexagon.scene, "v1-palm v3-finger1 v0-finger2")
    until = Until(parse_contact("v5-finger1", hexagon.scene))
    with pytest.raises(InputError, match="v5-finger1 cannot be reached") as caught:
        guess_phase(Phase(5, formation, until), start)
    assert caught.value.key == "phases[6].until"


def test_ends_ahead_lie_where_the_motion_goes(square: Problem) -> None:
    before = guess_curve(trace_phases(square)[2])[-1]
    landing, start = square.phases[3], before.z[-1]
    (nearest,) = guess_phase(landing, start)
    onwards = guess_onwards(landing, before)
    assert onwards
    heading = (start - before.z[-2])[0]
    for part in onwards:
        np.testing.assert_array_equal(part.z[0], start)
        assert max(np.abs(measure_gaps(part.formation, z)).max() for z in part.z) < CLOSED
        assert part.formation.evaluate_limits(part.z).min() > -CLOSED
        # Edge 1 is down, farther the way that the object goes.
        assert part.z[-1, 2] == pytest.approx(-np.pi / 2, abs=CLOSED)
        assert (part.z[-1, 0] - nearest.z[-1, 0]) * heading > 0
    assert guess_onwards(square.phases[2], before) == []


def test_contacts_of_a_flush_edge_turn_as_one(square: Problem) -> None:
    formation, rng = square.phases[2].formation, np.random.default_rng(7)
    assert [formation.turn_with(row) for row in range(6)] == [
        (0,),
        (1, 2),
        (1, 2),
        (3,),
        (4,),
        (5,),
    ]
    z = trace_phases(square)[2].end
    free = np.linalg.svd(formation.evaluate(z[None], np.zeros((1, 5))).P[0])[2][4]
    slip = measure_slip(formation, z, rng.normal() * free)
    assert slip[1] == pytest.approx(slip[2], rel=1e-9)
    assert np.abs(slip[[0, 3]] - slip[1]).min() > 1e-3 * np.abs(slip).max()


def test_a_flush_edge_that_turns_is_planned_in_the_time_domain_too(square: Problem) -> None:
    curves, options = trace_phases(square), PlanOptions(time_intervals=6)
    curve = curves[2]
    turning = [part.Xi for part in curve.segments]
    assert len(turning) == 2 and (turning[0] != turning[1]).tolist() == [False, True, True, False]
    exact = plan_path(curve, square.epsilon, options, 3, None).motion.duration
    (plan,) = plan_phases(square, square.phases[2:3], curves[1].end, options)
    # Torques that are linear in each interval come a little behind the true least time.
    assert exact * (1 - 1e-4) < plan.motion.duration < 1.02 * exact


def test_phases_without_ends_of_their_own_go_towards_the_next_end() -> None:
    """However many of them there are: each is guessed to go half of the way that is left."""
    sliding = tilting()
    (phase,) = sliding.phases
    rolling = roll(phase.formation, "v1-palm")
    first, second = (
        replace(phase, index=k, formation=formation, until=Until(), end=End.SMOOTH)
        for k, formation in enumerate((phase.formation, rolling))
    )
    ways = []
    for phases in ((first, second), (first,)):
        problem = replace(sliding, phases=(*phases, replace(phase, index=len(phases))))
        z = problem.start
        for own in problem.phases:
            ways.append(guess_phase(own, z, problem.phases[own.index + 1 :])[-1].z)
            z = ways[-1][-1]
    np.testing.assert_allclose(ways[0], ways[3], atol=1e-12)
    gaps = [evaluate_gap(sliding, way[-1]) for way in ways]
    start = evaluate_gap(sliding, sliding.start)
    assert start > gaps[0] > gaps[1] > 0.1 * start
    np.testing.assert_allclose([gaps[2], gaps[4]], 0.0, atol=1e-9)


def test_a_phase_that_rolls_between_others_does_not_go_back() -> None:
    """Though the way back is longer; only a contact that is let go may take that."""
    problem = landing()
    *before, last = problem.phases
    rolling = roll(last.formation, "v1-palm")
    opened = [
        replace(last, index=last.index + k, formation=one, until=Until(), end=End.SMOOTH)
        for k, one in enumerate((last.formation, rolling))
    ]
    parts = replace(problem, phases=(*before, *opened, replace(last, index=last.index + 2)))
    z = guess_phase(parts.phases[4], trace_phases(parts)[-1].end)[-1].z[-1]
    gaps = [evaluate_gap(problem, z)]
    for phase in parts.phases[5:]:
        z = guess_phase(phase, z, parts.phases[phase.index + 1 :])[-1].z[-1]
        gaps.append(evaluate_gap(problem, z))
    assert (np.diff(gaps) < 0).all() and gaps[-1] == pytest.approx(0.0, abs=CLOSED)


def evaluate_gap(problem: Problem, z: Array) -> float:
    """Gap of what ends the last phase of a problem [m]."""
    contact = problem.phases[-1].until.contact
    assert contact is not None
    return float(measure_gaps(make_formation(problem.scene, contact.name), z)[0])
