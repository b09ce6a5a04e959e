"""Initial guesses of phases, and ends that are given in full."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from plane import make_formation, measure_gaps
from planned import plan_landing
from shipped import HEPTAGON, problem_of
from thrown import shove
from timed import landing
from wholearm.common.errors import InfeasibleError, InputError
from wholearm.common.shortfalls import LimitPlace, Shortfall
from wholearm.geometry.path_guess import find_end
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain import time_explain as explain
from wholearm.planning.time_domain import time_plan
from wholearm.planning.time_domain.attempts import GRADUAL, NEAREST, Attempt, Attempts
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.stages import guess_stages
from wholearm.planning.time_domain.time_plan import NEARER, ContinuedEnd, plan_phases, refuse_pinned
from wholearm.problem.definition import End, Problem
from wholearm.simulation.simulate import simulate
from wholearm.verification.verdict import Allowance, describe_ends

OPTIONS = PlanOptions(time_intervals=12, transcription="time")
PACE = "{}, {} times as long as a fall over that height"
AHEAD = [PACE.format("one to an end of the phases further on", falls) for falls in (2, 4, 1) * 2]


def test_an_end_that_is_known_is_first_looked_for_straight() -> None:
    """As on a route, which is given it: pinned in a file the first guess is the same."""
    problem = landing()
    start, index = trace_phases(problem)[-1].end, 4
    straight, nearest = "a straight path that keeps limits ", NEAREST
    phase = problem.phases[index]
    goal = find_end(phase, start, problem.phases[index + 1 :])
    pins = (("x", float(goal[0])),)
    pinned = replace(phase, until=replace(phase.until, pins=pins), end=End.REST)
    for own, given in ((replace(phase, end=End.REST), goal), (pinned, None)):
        search = TimeSearch.of(problem, OPTIONS)
        attempts = Attempts(problem, [own], start, search, None, True)
        names = [attempt.name for attempt in attempts.begin(given)]
        assert names[-1] == nearest and len(names) <= 2
        assert all(name.startswith(straight) for name in names[:-1])
        found = attempts.begin(given)[0].stages[-1].guess.nodes[-1, 0]
        np.testing.assert_allclose(found[:2] * problem.scene.scales.length, goal[:2], atol=1e-9)
    # Without one there is nothing to go straight to, nor are there straight ways of two phases.
    free = Attempts(problem, [phase], start, search, None, True)
    assert [attempt.name for attempt in free.begin()] == [nearest]


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> list[str]:
    """Names of attempts in the order in which they are made; one leads to a plan."""
    names, good = list[str](), request.param

    def pretend(search: TimeSearch, attempt: Attempt) -> TimeSolution:
        names.append(attempt.name)
        nlp, success = search.build(attempt.stages), attempt.name == good
        return TimeSolution(attempt.stages, 1.0, 0.0, "Ipopt stopped", success, nlp, {})

    monkeypatch.setattr(time_plan, "solve_attempt", pretend)
    monkeypatch.setattr(time_plan, "find_short", lambda *_: (None, []))
    monkeypatch.setattr(time_plan, "list_plans", lambda *given: [given[-1]])
    return names


@pytest.mark.parametrize(
    ("tried", "order"),
    [
        (NEAREST, [NEAREST]),
        (NEAREST + GRADUAL, [NEAREST, NEAREST + GRADUAL]),
        (AHEAD[1], [NEAREST, NEAREST + GRADUAL, *AHEAD[:2]]),
    ],
    indirect=["tried"],
)
def test_a_plan_names_the_attempt_that_led_to_it(tried: list[str], order: list[str]) -> None:
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


def test_where_no_plan_ends_it_is_said_what_motions_nearer_to_it_are_short_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All the way is asked for first, and then less of it: until a motion is found at all."""
    problem, options = pin(landing(), 5, ("x", 0.0145)), PlanOptions(time_intervals=6)
    start, phases = trace_phases(problem)[-1].end, problem.phases[4:]
    search = TimeSearch.of(problem, options, None, None, math.inf, True)
    stages = guess_stages(problem, phases, start, search.scheme, 6, 2.0)
    nearest = TimeSolution(stages, 1.0, 0.0, "", True, search.build(stages), {})
    free = guess_stages(landing(), landing().phases[4:], start, search.scheme, 6, 2.0)
    ends = {stage.phase: stage.guess.nodes[-1, 0] for stage in free}
    lack = Shortfall("torque", "finger 2", "torque limit", 1.0, "N m", LimitPlace(6, 0.1, ""), 0.5)
    asked = list[float]()

    def solve_elastic(_: TimeSearch, own: list[Stage]) -> list[Stage] | None:
        until = own[-1].until
        assert until is not None
        asked.append(until.pins[0][1] * problem.scene.scales.length)
        return own if len(asked) == 3 else None

    monkeypatch.setattr(explain, "solve_elastic", solve_elastic)
    monkeypatch.setattr(explain, "list_shortfalls", lambda _, own, __: [lack] if own else [])
    with pytest.raises(InfeasibleError, match=r"ends at x = .* mm, .* at the nearest") as caught:
        refuse_pinned(search, problem, phases, ContinuedEnd(None, nearest, ends, 0.2))
    assert caught.value.shortfalls == (lack,)
    begin = ends[5][0] * problem.scene.scales.length
    assert abs(begin - 0.0145) > 1e-3
    shares = [0.2 + 0.8 * part for part in (1.0, *NEARER)]
    assert asked == pytest.approx([begin + share * (0.0145 - begin) for share in shares])


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
