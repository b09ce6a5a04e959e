from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from shipped import HEPTAGON, TWICE, problem_of
from wholearm.planning import blocks
from wholearm.planning.blocks import Planning, plan_alone
from wholearm.planning.options import PlanOptions


def planning_of(problem: Any) -> Planning:
    none: list[float | None] = [None] * len(problem.phases)
    return Planning(problem, PlanOptions(), (), none, none)


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
