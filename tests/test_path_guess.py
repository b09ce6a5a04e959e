from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from plane import make_formation, measure_gaps, measure_slip, rotate
from scenes import roll, tilting
from wholearm import End, Formation, InputError, Phase, PlanOptions, Problem, Until
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.geometry.curve import Curve
from wholearm.geometry.explore import close_all, close_contacts
from wholearm.geometry.path_guess import (
    POINTS,
    PathGuess,
    guess_curve,
    guess_phase,
    load,
)
from wholearm.geometry.tracing import trace_phases, until_distance
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.time_domain.time_plan import plan_phases

HEPTAGON = Path(__file__).parents[1] / "problems" / "heptagon.toml"
LANDING = "v1-palm v4-finger1 v6-finger2"
CLOSED = 1e-9
"""Gap [m] that counts as closed: what a trajectory file promises."""


@pytest.fixture(scope="module")
def flipping() -> Problem:
    return load(str(HEPTAGON))


@pytest.fixture(scope="module")
def outlines(flipping: Problem) -> list[list[PathGuess]]:
    parts, z = [], flipping.start
    for phase in flipping.phases:
        parts.append(guess_phase(phase, z, flipping.phases[phase.index + 1 :]))
        z = parts[-1][-1].z[-1]
    return parts


@pytest.fixture(scope="module")
def released(outlines: list[list[PathGuess]]) -> Array:
    """Where the landing is guessed to start."""
    return np.asarray(outlines[-1][0].z[0])


def test_outlines_are_closed_at_every_point(outlines: list[list[PathGuess]]) -> None:
    for part in (part for phase in outlines for part in phase):
        assert len(part.z) == POINTS
        assert max(np.abs(measure_gaps(part.formation, z)).max() for z in part.z) < CLOSED
        assert part.formation.evaluate_limits(part.z).min() > -CLOSED


def test_outlines_end_where_their_phase_does(
    flipping: Problem, outlines: list[list[PathGuess]]
) -> None:
    for phase, parts in zip(flipping.phases, outlines, strict=True):
        if not phase.until.is_release:
            end = parts[-1].z[-1:]
            assert abs(until_distance(phase.formation, phase.until, end)[0]) < CLOSED


@pytest.mark.parametrize("phase", range(6))
def test_directions_are_those_of_travel(outlines: list[list[PathGuess]], phase: int) -> None:
    for part in outlines[phase]:
        middle = len(part.z) // 2
        speed = part.z[middle + 1] - part.z[middle - 1]
        slip = measure_slip(part.formation, part.z[middle], speed)
        np.testing.assert_array_equal(np.sign(slip), part.directions.Xi)
        np.testing.assert_array_equal(np.sign(speed[3:]), part.directions.sigma)


def test_curves_are_split_where_something_turns(curves: tuple[Curve, ...]) -> None:
    for curve in curves:
        parts = guess_curve(curve)
        assert len(parts) == len(curve.segments)
        # Chords are shorter than the arc by the square of a 24th of it.
        assert sum(part.length for part in parts) == pytest.approx(curve.length, rel=1e-3)
        assert parts[-1].turns == ()
        for part, following in pairwise(parts):
            before, after = (np.concatenate(p.directions) for p in (part, following))
            assert part.turns == tuple(np.flatnonzero(before != after)) != ()
            speed = curve.evaluate(np.array([curve.segments[1].start])).z_s[0]
            rates = [*measure_slip(part.formation, part.z[-1], speed), *speed[3:]]
            # Rates per metre are about one; reversals are found to rounding.
            assert np.abs([rates[row] for row in part.turns]).max() < 1e-8


@pytest.mark.parametrize("row, value", [(0, 0.02), (2, -0.9)])
def test_a_coordinate_can_be_what_ends_a_phase(
    flipping: Problem, released: Array, row: int, value: float
) -> None:
    until = Until(None, "x" if row == 0 else "phi", value)
    phase = Phase(5, flipping.phases[5].formation, until)
    part = guess_phase(phase, released)[-1]
    assert part.z[-1, row] == pytest.approx(value, abs=1e-12)
    assert max(np.abs(measure_gaps(part.formation, z)).max() for z in part.z) < CLOSED


def test_closing_moves_as_little_as_possible(flipping: Problem, released: Array) -> None:
    formation = flipping.phases[5].formation
    rng = np.random.default_rng(4)
    for _ in range(5):
        away = released + 1e-4 * rng.normal(size=5)
        z = close_contacts(formation, away, np.zeros(0))
        assert z is not None and np.abs(measure_gaps(formation, z)).max() < 1e-12
        kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        scale = formation.scene.polygon.gyration_radius ** np.array([0, 0, 1, 1, 1])
        free = np.linalg.svd(kinematics.A[0] / scale)[2][3:]
        # The step is normal to what the contacts leave free, but for curvature.
        moved = (z - away) * scale
        assert np.abs(free @ moved).max() < 1e-2 * np.linalg.norm(moved)


def test_configurations_are_closed_side_by_side(flipping: Problem, released: Array) -> None:
    formation, phi = flipping.phases[5].formation, released[2] - 0.02
    away = released + np.array([[0.0], [0.1], [1e3]]) * released[0] * np.eye(5)[0]
    for z, start in zip(close_all(formation, away, np.zeros(0), ((2, phi),)), away, strict=True):
        alone = close_contacts(formation, start, np.zeros(0), ((2, phi),))
        assert alone is not None and np.abs(z - alone).max() < 1e-12 * (1 + np.abs(z).max())
        assert z[2] == pytest.approx(phi, abs=1e-12)
    assert np.isnan(close_all(formation, away, np.zeros(0), ((1, 1.0),))).all()


def test_closing_keeps_what_has_rolled_by(flipping: Problem, released: Array) -> None:
    formation = roll(flipping.phases[5].formation, "v1-palm")
    vertex = formation.scene.polygon.vertices[1]

    def place(z: Array) -> float:
        return float(z[0] + rotate(z[2], vertex)[0])

    slip = formation.evaluate_slip(released[None])[0]
    tipped = released - 0.1 * np.eye(5)[2]
    z = close_contacts(formation, tipped, slip)
    assert z is not None and np.abs(measure_gaps(formation, z)).max() < 1e-12
    # The vertex on the palm stays where it was, and the object turns about it.
    assert place(z) == pytest.approx(place(released), abs=1e-12)
    assert z[2] < released[2] - 0.01
    part = guess_phase(Phase(5, formation, flipping.phases[5].until), released)[-1]
    assert max(abs(place(z) - place(released)) for z in part.z) < 1e-12


@pytest.mark.parametrize(
    "names, until, key, reason",
    [
        (LANDING, Until(None, "x", 2.0), "until", "x = 2 m cannot be reached with these contacts"),
        (LANDING, Until(None, "phi", 2.0), "until", "cannot be reached"),
        (LANDING, "v5-palm", "until", "v5-palm cannot be reached .* v. touches the palm first"),
        (LANDING, Until(), "until", "is missing"),
        ("v1-palm v4-finger1 v5-finger2", "v2-palm", "contacts", "v5-finger2 does not touch"),
        ("v1-palm v4-finger1", "v2-palm", "contacts", None),
    ],
)
def test_phases_that_cannot_be_are_named(
    flipping: Problem, released: Array, names: str, until: Until | str, key: str, reason: str | None
) -> None:
    if isinstance(until, str):
        until = Until(parse_contact(until, flipping.scene))
    phase = Phase(5, make_formation(flipping.scene, names), until)
    if reason is None:
        assert guess_phase(phase, released)
        return
    with pytest.raises(InputError, match=reason) as caught:
        guess_phase(phase, released)
    assert caught.value.key == f"phases[6].{key}" and caught.value.exit_status == 2


def test_five_contacts_leave_nothing_to_plan(flipping: Problem, curves: tuple[Curve, ...]) -> None:
    first = flipping.phases[0]
    assert first.until.contact is not None
    held = Formation(flipping.scene, (*first.formation.contacts, first.until.contact))
    with pytest.raises(InputError, match="leave no freedom") as caught:
        guess_phase(Phase(1, held, flipping.phases[1].until), curves[0].end)
    assert caught.value.key == "phases[2].contacts"


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


def evaluate_gap(problem: Problem, z: Array) -> float:
    """Gap of what ends the last phase of a problem [m]."""
    contact = problem.phases[-1].until.contact
    assert contact is not None
    return float(measure_gaps(make_formation(problem.scene, contact.name), z)[0])
