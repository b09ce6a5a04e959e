"""What opens a way that is blocked: changes of one number, each of which a search tries."""

from __future__ import annotations

import pytest

from shipped import HEPTAGON, problem_of
from wholearm.common.errors import InfeasibleError
from wholearm.common.shortfalls import Change, Parameter
from wholearm.planning.options import PlanOptions
from wholearm.problem.definition import Problem
from wholearm.problem.goal import Goal
from wholearm.search import opening
from wholearm.search.chart import Chart
from wholearm.search.find import Search
from wholearm.search.opening import explain_cut, find_opening, list_cut
from wholearm.search.places import make_place
from wholearm.search.result import describe_block

TORQUE = Parameter("torque limit of finger 1", 2.0, "N m", 1, "fingers.1.torque_limit")
EPSILON = Parameter("epsilon", 0.05, "N", -1, "epsilon")


@pytest.mark.parametrize("needed, opens", [(2.5, True), (2.9, True), (9.0, False)])
def test_a_number_is_changed_as_far_as_the_next_border_asks_for(needed: float, opens: bool) -> None:
    tried = list[float]()

    def find(problem: Problem) -> float:
        limit = problem.scene.fingers[0].torque_limit
        tried.append(limit)
        if limit < needed:
            raise InfeasibleError("short", changes=[Change(TORQUE, round(limit + 0.2, 3))])
        return 0.5

    problem = problem_of(HEPTAGON)
    text = find_opening(problem, [Change(EPSILON, 0.04), Change(TORQUE, 2.5)], find)
    assert tried[0] == 2.0 and tried[1] == 2.5
    if opens:
        assert (
            text
            == f"with torque limit of finger 1 = {tried[-1]:g} N m instead of 2 the goal is "
            "reached, in 0.5 s"
            and tried[-1] >= needed
        )
    else:
        assert text.startswith(
            "the goal is not reached with epsilon = 0.04 N instead of 0.05, nor "
        )


def test_what_is_advised_opens_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a rough palm the slide cannot begin; with the friction that is named it can."""
    goal = Goal(flush=0, x=0.03)
    monkeypatch.setattr(opening, "EXPLAINED", 1)

    def search(problem: Problem) -> Search:
        return Search(Chart(problem, 0.1), make_place(problem.scene, problem.start), goal)

    rough = problem_of(HEPTAGON).with_(friction_palm=1.5)
    own = search(rough)
    assert not list(own.run())
    # All that leads on from what is reached is in the cut, and nothing that ends where it was.
    assert all(blocked.stop.key not in own.reached for blocked in list_cut(own))
    text, (change, *_) = explain_cut(own, rough, PlanOptions())
    assert change.parameter.key == "friction.palm" and change.value < 1.5
    assert f"feasible with {change}" in text
    assert next(search(rough.with_({change.parameter.key: change.value})).run()).duration > 0
    said = describe_block(own, [], text, "with less it is reached")
    assert "all blocked; with less it is reached; v0-palm" in said
