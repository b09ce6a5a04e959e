"""Initial guesses of phases, friction homotopy, and ends that are given in full."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Chebyshev, Polynomial

from plane import make_formation, measure_gaps
from planned import plan_landing
from shipped import FOLDER, HEPTAGON, problem_of, tipping
from thrown import shove
from timed import landing
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.geometry.curve import find_tied, tangent_basis
from wholearm.geometry.explore import close_contacts
from wholearm.geometry.path_guess import find_end, list_ends
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import metric_weights
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.time_domain import time_plan
from wholearm.planning.time_domain.guesses import (
    GRADUAL,
    LONGER,
    MOST,
    NEAREST,
    ONSETS,
    OTHER,
    STRAIGHT,
    Guess,
    Guesses,
    find_modes,
    split_by_signs,
)
from wholearm.planning.time_domain.mode_search import mode_of
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import Stage, bisect_intervals
from wholearm.planning.time_domain.stage_kernels import goal_kernel
from wholearm.planning.time_domain.time_plan import plan_phases, try_phases
from wholearm.problem.definition import End, Phase, Problem
from wholearm.problem.read import build_problem, read_problem
from wholearm.simulation.simulate import simulate
from wholearm.verification.verdict import Allowance, describe_ends
from wholearm.verification.verify import verify

OPTIONS = PlanOptions(time_intervals=12, transcription="time")


def test_an_end_that_is_known_is_first_looked_for_straight() -> None:
    """As on a route, which is given it: pinned in a file the first guess is the same."""
    problem = tipping()
    (phase,), start = problem.phases, problem.start
    goal = find_end(phase, start)
    pinned = replace(phase, until=replace(phase.until, pins=(("x", float(goal[0])),)))
    search = TimeSearch.of(problem, OPTIONS)
    for own, given in ((phase, goal), (pinned, None)):
        first, second, *_ = Guesses(problem, [own], start, search).every(given)
        assert [first.name, second.name] == [STRAIGHT, NEAREST]
        found = first.stages[-1].guess.nodes[-1, 0]
        np.testing.assert_allclose(found[:2] * problem.scene.scales.length, goal[:2], atol=1e-9)

    names = [guess.name for guess in Guesses(problem, [phase], start, search).every()]
    assert names[:3] == [NEAREST, NEAREST + GRADUAL, OTHER]


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> list[str]:
    """Names of guesses in the order in which they are tried; one leads to a plan."""
    names, good = list[str](), request.param

    def pretend(search: TimeSearch, guess: Guess, most: int = 0) -> TimeSolution:
        names.append(guess.name)
        nlp, success = search.build(guess.stages), guess.name == good
        return TimeSolution(guess.stages, 1.0, 0.0, "Ipopt stopped", success, nlp, {})

    monkeypatch.setattr(time_plan, "solve_coarse", pretend)
    monkeypatch.setattr(time_plan, "may_gain", lambda *_: False)
    monkeypatch.setattr(time_plan, "finish", lambda _, solution: solution)
    monkeypatch.setattr(time_plan, "list_plans", lambda *given: [given[-1]])
    return names


@pytest.mark.parametrize("tried", [NEAREST], indirect=True)
def test_a_single_guess_straight_to_a_place_is_no_other(
    tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where limits exclude the straight path there is none; goal 15 of the corpus."""
    problem = landing()
    start, phase = trace_phases(problem)[-1].end, replace(problem.phases[4], end=End.REST)
    goal = find_end(phase, start, problem.phases[5:])
    monkeypatch.setattr(Guesses, "straight", lambda *_: None)
    assert try_phases(problem, [phase], start, OPTIONS, goal, single_guess=True) is None
    assert tried == []


LATER = LONGER.format(NEAREST, 4.0)


@pytest.mark.parametrize(
    ("tried", "order"),
    [
        (NEAREST, [NEAREST]),
        (NEAREST + GRADUAL, [NEAREST, NEAREST + GRADUAL]),
        (LATER, [NEAREST, NEAREST + GRADUAL, LATER]),
    ],
    indirect=["tried"],
)
def test_a_plan_names_the_guess_that_led_to_it(tried: list[str], order: list[str]) -> None:
    problem, _ = shove()
    plans: list[Any] = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    assert plans == [order[-1]]
    assert tried == order


LANDS = 0.016
"""Where `plan_landing` ends [m]."""


def pin(problem: Problem, index: int, *pins: tuple[str, float]) -> Problem:
    phases = list(problem.phases)
    until = dataclasses.replace(phases[index].until, pins=pins)
    phases[index] = dataclasses.replace(phases[index], until=until)
    return dataclasses.replace(problem, phases=tuple(phases))


def test_a_landing_comes_to_rest_where_it_is_pinned() -> None:
    """Also beside the end that is the fastest, and far from the nearest."""
    problem = pin(landing(), 5, ("x", 0.0195))
    start = trace_phases(problem)[-1].end
    # All guesses: what a single one leads to depends on the last bits.
    options = PlanOptions(time_intervals=6)
    plans = plan_phases(problem, problem.phases[4:], start, options)
    motion = plans[-1].motion
    end = motion.evaluate(np.array([motion.duration]))
    size, speed = problem.scene.scales.length, problem.scene.scales.speed
    assert end.z[0, 0] == pytest.approx(0.0195, abs=1e-7 * size)
    assert np.abs(end.z_dot[0, :2]).max() < 1e-6 * speed
    formation = make_formation(
        problem.scene, " ".join([*problem.phases[5].formation.names, "v2-palm"])
    )
    assert np.abs(measure_gaps(formation, end.z)).max() < 1e-6 * size


def test_with_one_freedom_pins_have_to_agree_with_the_curve() -> None:
    problem = problem_of(HEPTAGON)
    x, phi = trace_phases(problem)[0].end[[0, 2]].tolist()
    same = pin(problem, 0, ("x", x), ("phi", phi))
    assert trace_phases(same)[0].end.tolist() == trace_phases(problem)[0].end.tolist()
    with pytest.raises(InputError, match=r"v3-finger1 at x = .* is never reached") as caught:
        trace_phases(pin(problem, 0, ("x", x + 1e-3)))
    assert caught.value.key == "phases[1].until"
    assert caught.value.problem.endswith("; one freedom leaves no choice")


def test_another_place_than_the_one_pinned_fails() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    allowance, length = Allowance(), problem.scene.scales.length
    for off, missed in ((0.0, False), (0.9, False), (1.1, True)):
        x = LANDS + off * allowance.departure * length
        failures = describe_ends(pin(problem, 1, ("x", x)), simulation, allowance)
        assert bool(failures) == missed
        for failure in failures:
            assert failure.text.startswith("phase 2 ends at x = 16 mm, phi = ")
            assert failure.text.endswith(f"and not with v2-palm at x = {x:g} m")


def with_phase(name: str, contacts: str, until: object) -> tuple[Problem, Phase]:
    """A shipped problem with another last phase."""
    table = dict(read_problem(str(FOLDER / f"{name}.toml")).table)
    phases = [table["phases"][0], {"contacts": contacts.split(), "until": until}]
    problem = build_problem({**table, "phases": phases})
    return problem, problem.phases[1]


@cache
def corner() -> tuple[Problem, Phase, Array]:
    """The triangle turns about its vertex in the corner of palm and link, which first goes back."""
    problem, phase = with_phase("triangle", "v1-palm v1-finger1 v0-finger2", "v2-finger1")
    near = np.array([0.030153, 0.02887, -1e-9, 1.032, 2.713])
    z = close_contacts(phase.formation, near, np.zeros(0), ((2, 0.0),))
    assert z is not None
    return problem, phase, z


SMALL = 0.005
"""How much the link turns back and forth, so little that all that is not tied to it goes on."""


def turned(rates: Polynomial | Chebyshev) -> tuple[TimeSearch, Stage]:
    """The triangle turns on and on; the link, and its vertex, goes at such rates back and forth.

    No forces are looked for: every motion of two freedoms is one of the contacts.
    """
    problem, phase, z = corner()
    search = TimeSearch.of(problem, PlanOptions())
    (stage, *_) = Guesses(problem, [phase], z, search).nearest.stages
    (stage,) = bisect_intervals([stage], search.scheme, [np.full(stage.intervals, 2)])
    part, formation = stage.guess, stage.formation
    scale = np.abs(rates(np.linspace(0, 1, 99))).max()
    link, start = SMALL / scale * rates.integ(), part.nodes[0, 0]

    def state(share: float) -> tuple[Array, Array]:
        fixed = ((2, start[2] - 0.05 * share), (3, start[3] + link(share)))
        z = close_contacts(formation, start, np.zeros(0), fixed)
        assert z is not None
        A = formation.evaluate(z[None], np.zeros((1, 5))).A[0]
        moving = np.append(np.zeros(3), [-0.05, SMALL / scale * rates(share)])
        return z, np.linalg.solve(np.vstack([A, np.eye(5)[2:4]]), moving) / part.duration

    states = [[state(share) for share in own] for own in part.places(search.scheme.points)]
    nodes = np.array([state(share) for share in part.breaks])
    z, v = np.moveaxis(np.array(states), 2, 0)
    return search, replace(stage, guess=part._replace(nodes=nodes, z=z, v=v))


def test_what_is_in_the_corner_turns_with_the_link() -> None:
    problem, phase, z = corner()
    formation = phase.formation
    N = tangent_basis(formation, z) / metric_weights(problem.scene)[:, None]
    A_t = formation.evaluate(z[None], np.zeros((1, 5))).A_t[0]
    rates = np.vstack([A_t / problem.scene.scales.length, np.eye(5)[3:]]) @ N
    for row in range(5):
        # What moves the others while the row stands still.
        still = np.array([-rates[row, 1], rates[row, 0]])
        moving = np.abs(rates @ still) > 1e-6 * np.abs(rates).max() ** 2
        assert set(find_tied(formation, z, row)) == set(np.flatnonzero(~moving).tolist())
    assert set(find_tied(formation, z, 0)) == {0, 1, 3}


TIED = {0, 1, 3}
"""Rows of (contacts, joints) that turn together in the corner."""


def test_pieces_move_one_way_and_make_up_the_stage() -> None:
    for places in (), (0.3,), (0.2, 0.7):
        search, stage = turned(Polynomial.fromroots(places) if places else Polynomial([1.0]))
        pieces = split_by_signs(stage, search.scheme)
        shares = np.diff([0.0, *places, 1.0])
        # Turns are found by straight lines between points.
        lasts = [own.guess.duration / stage.guess.duration for own in pieces]
        np.testing.assert_allclose(lasts, shares, atol=0.01)
        for one, other in pairwise(pieces):
            assert one.guess.nodes[-1] == pytest.approx(other.guess.nodes[0], abs=1e-9)
            signs = np.array([mode_of(one).signs, mode_of(other).signs])
            assert {0, 3} <= set(np.flatnonzero(signs[0] != signs[1]).tolist()) <= TIED
        for own in pieces:
            senses = own.measure_senses(
                own.guess.z[1:-1].reshape(-1, 5), own.guess.v[1:-1].reshape(-1, 5)
            )
            assert senses.min() > -1e-4 * np.abs(senses).max()
        assert pieces[-1].until is not None and all(own.until is None for own in pieces[:-1])


class Given(TimeSearch):
    """A search whose solutions are all one motion."""

    motion: Stage
    onsets: list[float]

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 0,
        raised: Any = None,
    ) -> TimeSolution:
        (stage,) = stages
        self.onsets.append(stage.onset)
        found = [replace(stage, guess=self.motion.guess)]
        return TimeSolution(found, 1.0, 0.0, "", True, None, {})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "rates",
    [Polynomial([1.0]), Polynomial.fromroots([0.3]), Chebyshev.basis(15, domain=[0.0, 1.0])],
    ids=["on", "turning back", "trembling"],
)
def test_modes_are_those_of_the_motion_with_friction_that_sets_in_gradually(
    rates: Polynomial | Chebyshev,
) -> None:
    plain, stage = turned(rates)
    search = Given(**vars(plain))
    search.motion, search.onsets = stage, []
    found = find_modes(search, [stage])
    assert search.onsets == list(ONSETS)
    assert found.success == (rates.degree() < MOST)
    if found.success:
        assert len(found.stages) == rates.degree() + 1
        assert all(own.onset == 0 for own in found.stages)
        assert (
            {0, 3} <= set(found.stages[0].turns) <= TIED
            if rates.degree()
            else not found.stages[0].turns
        )


def test_a_motion_that_slides_while_it_tips_is_planned() -> None:
    problem = tipping()
    options = PlanOptions(time_intervals=4, accuracy=1e-2)
    (plan,) = plan_phases(problem, problem.phases, problem.start, options, explained=False)
    samples = plan.motion.evaluate(np.linspace(0.0, plan.motion.duration, 50))
    assert np.degrees(samples.z[-1, 2]) == pytest.approx(9.5, abs=1e-5)
    assert samples.c_n.min() > problem.epsilon - 1e-6


def test_a_vertex_in_a_corner_may_go_back_first() -> None:
    """The modes of its outline lead nowhere."""
    problem, phase, z = corner()
    own = replace(problem, start=z, phases=(replace(phase, index=0),))
    plan = solve(own, time_intervals=10, replay=False).trajectory
    report = verify(own, plan)
    assert report.ok, report.to_text()


def test_an_end_where_a_contact_changes_its_name_has_a_slope() -> None:
    """The distance to the tip has none there: it would leave open where the phase ends."""
    problem, phase = with_phase("hexagon", "v1-palm v1-finger1 v4-finger2", "v4-tip2")
    z = np.array([0.06, 0.045, -0.05, 1.3, 2.2])
    end = list_ends(phase)[0]
    goal = close_contacts(phase.formation, z, np.zeros(0), (), end.active)
    assert goal is not None
    kernel = goal_kernel(phase.formation, phase.until, (), None)
    assert kernel is not None
    x = np.append(goal, np.zeros(5))
    assert np.abs(kernel.function(x, []).full()).max() < 1e-9 * problem.scene.scales.length
    slope = np.abs(kernel.jacobian(x, []).full()).max()
    assert slope > 0.1 * problem.scene.scales.length
