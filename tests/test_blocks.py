from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from shipped import HEPTAGON, TWICE, problem_of
from wholearm.common.errors import InfeasibleError
from wholearm.common.shortfalls import LimitPlace, Shortfall
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import blocks
from wholearm.planning.block_plan import Planning
from wholearm.planning.blocks import plan_alone
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.stops import Plans
from wholearm.planning.time_domain import time_impacts as impacts


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

    def plan_with_impacts(*of: Any, **others: Any) -> Any:
        plan = known[of[1][0].index]
        if of[3].goal is Objective.MARGIN:
            given.append((others["ample"], plan.value))
        return [plan]

    monkeypatch.setattr(impacts, "plan_with_impacts", plan_with_impacts)
    over_time = replace(options, transcription="time")
    blocks.plan_blocks(problem, curves, over_time, lambda _: None)
    assert len(given) == len(problem.phases) and given[0][0] == math.inf
    for index in range(1, len(given)):
        before = min(value for _, value in given[:index])
        assert given[index][0] == pytest.approx(blocks.AMPLE * before)


@cache
def plan_along() -> Plans:
    problem = problem_of(HEPTAGON)
    given = problem, trace_phases(problem), PlanOptions(intervals=20)
    return blocks.plan_blocks(*given, lambda _: None).plans


@pytest.mark.parametrize("share", [2.0, 0.1])
def test_what_is_far_from_possible_later_stops_planning_before(
    monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """What is near to being possible may be so from where a better plan ends."""
    problem, begun = problem_of(HEPTAGON), list[tuple[int, bool, bool]]()
    curves, options = trace_phases(problem), PlanOptions(intervals=20)
    known = plan_along()
    place = LimitPlace(3, 0.0, "there")
    short = Shortfall("press", "v1-palm", "c_n", 1.0, "N", place, share * blocks.CLEAR)

    def plan_with_impacts(*of: Any, **others: Any) -> Any:
        number = of[1][0].number
        begun.append((number, others["only_begin"], bool(others["begun"])))
        if number == 3 and others["only_begin"]:
            raise InfeasibleError("phase 3 is infeasible", [short])
        return [known[number - 1]]

    monkeypatch.setattr(impacts, "plan_with_impacts", plan_with_impacts)
    over_time = replace(options, transcription="time")
    if share > 1:
        with pytest.raises(InfeasibleError, match="phase 3"):
            blocks.plan_blocks(problem, curves, over_time, lambda _: None)
    else:
        blocks.plan_blocks(problem, curves, over_time, lambda _: None)
    whole = [(number, False, number < 3) for number in range(1, len(known) + 1)]
    first = [(number, True, False) for number in (1, 2, 3)]
    assert begun == (first if share > 1 else [*first, *whole])
