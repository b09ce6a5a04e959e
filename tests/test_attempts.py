from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from thrown import shove
from timed import landing
from wholearm.common.errors import InfeasibleError, SolverError
from wholearm.geometry.path_guess import find_end
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain import attempts as attempts_module
from wholearm.planning.time_domain import time_plan
from wholearm.planning.time_domain.attempts import GRADUAL, NEAREST, Attempt, Attempts
from wholearm.planning.time_domain.initial_path import PacedWay
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.stages import guess_stages
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import End, Problem

OPTIONS = PlanOptions(time_intervals=12, transcription="time")
PACE = "{}, {} times as long as a fall over that height"
AHEAD = [PACE.format("one to an end of the phases further on", falls) for falls in (2, 4, 1) * 2]


def list_attempts(problem: Problem, count: int, patient: bool = True) -> Attempts:
    search = TimeSearch.of(problem, OPTIONS)
    return Attempts(problem, problem.phases[:count], problem.start, search, None, patient)


def along(margin: float, homotopy: bool = False) -> str:
    return f"a straight path that keeps limits with {margin:g} to spare{GRADUAL * homotopy}"


@pytest.mark.parametrize(
    ("margins", "ways"),
    [
        # Paths that keep limits come first, those near that next, and what is far is left out.
        ((0.4, -0.1, -0.5), [along(0.4), along(0.4, True), along(-0.1, True), along(-0.1)]),
        # Of paths that are all far from it the best one shows what is short.
        ((-0.5, -0.6), [along(-0.5)]),
        ((), []),
    ],
)
def test_a_single_phase_is_tried_along_paths_and_at_several_paces(
    monkeypatch: pytest.MonkeyPatch, margins: tuple[float, ...], ways: list[str]
) -> None:
    guessed = list[tuple[int, float, bool, float | None]]()

    def guess(*given: Any, way: PacedWay | None) -> list[Stage]:
        guessed.append((*given[4:7], way and way.margin))
        return guess_stages(*given)

    paced = [PacedWay([], margin, None, None) for margin in margins]  # type: ignore[arg-type]
    monkeypatch.setattr(attempts_module, "list_ways", lambda *_: paced)
    monkeypatch.setattr(attempts_module, "guess_stages", guess)
    attempts = list_attempts(problem_of(HEPTAGON), 1)
    found = list(attempts)
    paces = [PACE.format(NEAREST, falls) for falls in (4, 1, 2, 4, 1)]
    assert [own.name for own in found] == [NEAREST + GRADUAL, *ways, NEAREST, *paces]
    assert [own.homotopy for own in found] == [own.name.endswith(GRADUAL) for own in found]
    # The first one is guessed once: its modes are found before they are given.
    assert found[0].stages is attempts.first.stages
    # Half the intervals, as 12 are more than a phase starts with; then the same on all of them.
    near = [margin for margin in margins if along(margin) in ways]
    assert guessed[:-5] == [(6, 2.0, False, own) for own in (None, *near)]
    assert [own[:2] for own in guessed[-5:]] == [(6, 4), (6, 1), (12, 2), (12, 4), (12, 1)]
    assert [own.halvings for own in found[-6:]] == [1, 1, 1, 0, 0, 0]


def test_phases_in_motion_are_tried_ahead() -> None:
    attempts = list_attempts(shove()[0], 2)
    assert attempts.ways == [] and not attempts.are_far
    assert [own.name for own in attempts] == [NEAREST + GRADUAL, NEAREST, *AHEAD]
    # Where the first one has led nowhere, it is not among those that are made after it.
    assert [own.name for own in attempts.list_further(3)] == [NEAREST + GRADUAL, AHEAD[0]]


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


def test_where_patience_is_not_asked_for_there_is_one_attempt() -> None:
    attempts = list_attempts(problem_of(HEPTAGON), 1, patient=False)
    assert list(attempts) == [attempts.first]


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


@pytest.mark.parametrize("tried", ["none"], indirect=True)
def test_attempts_end_where_motions_of_two_are_short_of_limits(
    tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before that all are made; what is like what is short is first asked what it is short of."""
    problem, _ = shove()
    with pytest.raises(SolverError, match="from 5 guesses"):
        plan_phases(problem, problem.phases, problem.start, OPTIONS, explained=False)
    assert tried == [NEAREST, NEAREST + GRADUAL, *AHEAD]
    asked = list[object]()

    def find_short(*given: Any) -> tuple[list[Stage], list[Stage]]:
        asked.append(given)
        return given[2], given[2]

    tried.clear()
    monkeypatch.setattr(time_plan, "find_short", find_short)
    monkeypatch.setattr(time_plan, "explain_lost", lambda *_: InfeasibleError("short"))
    with pytest.raises(InfeasibleError, match="short"):
        plan_phases(problem, problem.phases, problem.start, OPTIONS, explained=False)
    assert tried == [NEAREST, NEAREST + GRADUAL] and len(asked) == time_plan.CONVINCING == 2
