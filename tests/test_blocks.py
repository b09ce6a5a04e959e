from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from shipped import HEPTAGON, TWICE, problem_of
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import blocks
from wholearm.planning.blocks import Planning, plan_alone
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.time_domain import impacts


def planning_of(problem: Any) -> Planning:
    none: list[float | None] = [None] * len(problem.phases)
    return Planning(problem, (), PlanOptions(), (), none, none)


def test_blocks_are_planned_alone_only_where_that_is_another_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Planning] = []

    def plan_each(planning: Planning, finer: list[int], report: object) -> Planning:
        given.append(planning)
        return planning

    monkeypatch.setattr(blocks, "plan_each", plan_each)
    curves, landing = (planning_of(problem_of(path)) for path in (HEPTAGON, TWICE))
    assert plan_alone(curves, print) is None
    assert plan_alone(replace(landing, ahead=False), print) is None
    assert plan_alone(landing, print) == given[0]
    assert not given[0].ahead and not given[0].blocks


def test_no_phase_has_to_press_much_more_than_those_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Plans along curves stand for those over time, which are told what is ample."""
    whole, given = problem_of(HEPTAGON), list[tuple[float, float]]()
    problem = replace(whole, phases=whole.phases[:3])
    curves, options = trace_phases(problem), PlanOptions("margin", intervals=20)
    known = blocks.plan_blocks(problem, curves, options, lambda _: None).plans

    def plan_with_impacts(*of: Any, **_: Any) -> Any:
        plan = known[of[1][0].index]
        if of[3].goal is Objective.MARGIN:
            given.append((of[6], plan.value))
        return [plan]

    monkeypatch.setattr(impacts, "plan_with_impacts", plan_with_impacts)
    over_time = replace(options, transcription="time")
    blocks.plan_blocks(problem, curves, over_time, lambda _: None)
    assert len(given) == len(problem.phases) and given[0][0] == math.inf
    for index in range(1, len(given)):
        before = min(value for _, value in given[:index])
        assert given[index][0] == pytest.approx(blocks.AMPLE * before)
