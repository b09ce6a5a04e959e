from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

from retelling import RETELLINGS, Answer, Retelling, answer, compare
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem

PROBLEMS = Path(__file__).parents[1] / "problems"
CASES = [("heptagon_impact", 2, 20), ("box_rolling", 1, 20)]
"""Problems, how many of their phases are planned, the last of them to rest, and intervals."""
TELLINGS = [("time", telling) for telling in (RETELLINGS[1], *RETELLINGS[3:])]
TELLINGS += [("effort", RETELLINGS[4]), ("margin", RETELLINGS[1])]
"""Of other costs, the effort mirrored, which swaps the torques, and the margin in small units."""


@pytest.fixture(scope="module", params=CASES, ids=[case[0] for case in CASES])
def case(request: pytest.FixtureRequest) -> tuple[str, int, int]:
    found: tuple[str, int, int] = request.param
    return found


@pytest.fixture(scope="module")
def problem(case: tuple[str, int, int]) -> Problem:
    name, phases, _ = case
    table = copy.deepcopy(dict(load(str(PROBLEMS / f"{name}.toml")).table))
    table["phases"] = table["phases"][:phases]
    table["phases"][-1]["end"] = "rest"
    return build_problem(table)


@pytest.fixture(scope="module")
def answers(case: tuple[str, int, int], problem: Problem) -> dict[str, Answer]:
    goals = ("time", "effort", "margin")
    return {goal: answer(problem, goal, intervals=case[2], replay=False) for goal in goals}


@pytest.mark.parametrize("objective, telling", TELLINGS, ids=lambda p: getattr(p, "name", p))
def test_answers_do_not_depend_on_how_a_problem_is_told(
    case: tuple[str, int, int],
    problem: Problem,
    answers: dict[str, Answer],
    telling: Retelling,
    objective: str,
) -> None:
    other = answer(telling.apply(problem), objective, telling, intervals=case[2], replay=False)
    difference = compare(answers[objective], other)
    assert difference.value < 1e-8 and difference.torques < 1e-7


@pytest.mark.parametrize("telling", RETELLINGS, ids=lambda telling: telling.name)
def test_a_retelling_changes_what_it_says(problem: Problem, telling: Retelling) -> None:
    """Configurations at the ends of phases are those of the first telling, in other words."""
    other = telling.apply(problem)
    scale = np.array([telling.units.length] * 2 + [1.0] * 3)
    for one, same in zip(trace_phases(problem), trace_phases(other), strict=True):
        z = scale * one.end
        if telling.mirrored:
            z = np.array([-z[0], z[1], -z[2], np.pi - z[4], np.pi - z[3]])
        turns = (same.end - z) / (2 * np.pi) * [0, 0, 0, 1, 1]
        np.testing.assert_allclose(same.end - 2 * np.pi * np.round(turns), z, atol=1e-11 * scale[0])
        assert same.length == pytest.approx(telling.units.length * one.length, rel=1e-11)
