from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from thrown import shove
from timed import landing
from wholearm.geometry.path_guess import find_end
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.time_domain import plan as time_plan
from wholearm.planning.time_domain.attempts import (
    FALLS,
    GRADUAL,
    NEAREST,
    Attempt,
    Attempts,
    solve_attempt,
)
from wholearm.planning.time_domain.plan import plan_phases
from wholearm.planning.time_domain.search import Search, Solution
from wholearm.problem.definition import End, Problem

OPTIONS = PlanOptions(time_intervals=12, transcription="time")


def list_attempts(problem: Problem, count: int, patient: bool = True) -> Attempts:
    search = Search.of(problem, OPTIONS)
    return Attempts(problem, problem.phases[:count], problem.start, search, None, patient)


def test_a_single_phase_is_tried_along_ways_and_at_several_paces() -> None:
    attempts = list_attempts(problem_of(HEPTAGON), 1)
    found = list(attempts)
    names = [attempt.name for attempt in found]
    assert len(set(names)) < len(names) and found.count(attempts.first) == 1
    at = found.index(attempts.first)
    # Modes are found before they are given, from the same guesses.
    gradual = [attempt for attempt in found if attempt.gradual]
    assert gradual[0].stages is attempts.first.stages and found[0] == gradual[0]
    plain = [name for name, attempt in zip(names, found, strict=True) if not attempt.gradual]
    plain = plain[: plain.index(NEAREST)]
    assert all(name.startswith("a straight path that keeps limits ") for name in plain)
    assert len(plain) <= len(attempts.ways)
    sure = [way.margin for way in attempts.ways if way.margin > 0]
    assert [attempt.gradual for attempt in found[1 : 1 + len(sure)]] == [False] * len(sure)
    assert {attempt.name for attempt in gradual[1:]} <= {f"{name}{GRADUAL}" for name in plain}
    # The same guess again on finer intervals counts as another, and the first one is not repeated.
    paces = [name for name in names[at + 1 :] if name.startswith(f"{NEAREST}, ")]
    assert len(paces) == len(names) - at - 1 == 2 * len(FALLS) - 1
    for attempt in found:
        halved = 12 / 2**attempt.halvings
        assert all(stage.intervals <= halved + 1e-9 for stage in attempt.stages)


def test_phases_in_motion_are_tried_ahead() -> None:
    problem, _ = shove()
    attempts = list_attempts(problem, 2)
    assert attempts.ways == [] and not attempts.are_far
    names = [attempt.name for attempt in attempts]
    assert names[:2] == [f"{NEAREST}{GRADUAL}", NEAREST]
    assert all(name.startswith("one to an end of the phases further on, ") for name in names[2:])
    # Where the first one has led nowhere, it is not among those that are made after it.
    assert [attempt.name for attempt in attempts.list_further(3)] == [names[0], names[2]]


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
        search = Search.of(problem, OPTIONS)
        attempts = Attempts(problem, [own], start, search, None, True)
        names = [attempt.name for attempt in attempts.begin(given)]
        assert names[-1] == nearest and len(names) <= 2
        assert all(name.startswith(straight) for name in names[:-1])
        found = attempts.begin(given)[0].stages[-1].guess.nodes[-1, 0]
        np.testing.assert_allclose(found[:2] * problem.scene.scales.length, goal[:2], atol=1e-9)
    # Without one there is nothing to go straight to, nor are there straight ways of two phases.
    free = Attempts(problem, [phase], start, search, None, True)
    assert [attempt.name for attempt in free.begin()] == [nearest]


def test_where_patience_is_not_asked_for_there_is_one_attempt() -> None:
    attempts = list_attempts(problem_of(HEPTAGON), 1, patient=False)
    assert list(attempts) == [attempts.first]


def test_a_plan_names_the_attempt_that_led_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the first one is lost, the next one that leads to a plan."""
    problem, _ = shove()
    plan = solve(problem, time_intervals=4, replay=False)
    assert {phase.attempt for phase in plan.phases} == {NEAREST}
    assert plan.meta["attempts"] == [NEAREST] * len(problem.phases)
    tried: list[str] = []
    run = solve_attempt

    def lose_first(search: Search, attempt: Attempt) -> Solution:
        tried.append(attempt.name)
        if len(tried) > 1 and not attempt.gradual:
            return run(search, attempt)
        nlp = search.build(attempt.stages)
        return Solution(attempt.stages, 0.0, 0.0, "lost", False, nlp, {})

    monkeypatch.setattr(time_plan, "solve_attempt", lose_first)
    options = replace(OPTIONS, time_intervals=4)
    (first, *_) = plan_phases(problem, problem.phases, problem.start, options)
    assert tried[0] == NEAREST and first.attempt == tried[-1] != NEAREST
