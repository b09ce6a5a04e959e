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
from wholearm.planning.path_domain.sequence_plan import plan_sequence


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
    problem, given = problem_of(HEPTAGON), list[tuple[PlanOptions, float]]()

    def record(*of: Any) -> Any:
        plans = plan_sequence(*of)
        given.append((of[2], min(plan.value for plan in plans)))
        return plans

    monkeypatch.setattr(blocks, "plan_sequence", record)
    options = PlanOptions("margin", intervals=20)
    blocks.plan_blocks(problem, trace_phases(problem), options, lambda _: None)
    pressed = [(own.enough, value) for own, value in given if own.goal is Objective.MARGIN]
    assert len(pressed) == len(problem.phases) and pressed[0][0] == math.inf
    for index in range(1, len(pressed)):
        before = min(value for _, value in pressed[:index])
        assert pressed[index][0] == pytest.approx(blocks.AMPLE * before)
