"""What opens a way that is blocked: changes of one number, each of which a search tries."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from shipped import HEPTAGON, HEXAGON, problem_of
from wholearm.common.shortfalls import Change, Parameter
from wholearm.common.signals import OutOfTime
from wholearm.contacts.closing import close_fingers
from wholearm.planning.options import PlanOptions
from wholearm.problem.goal import Goal
from wholearm.problem.read import build_problem
from wholearm.search.astar import RouteSearch
from wholearm.search.cuts import Opening, link_changed, list_cut, list_cut_borders, list_openings
from wholearm.search.edges import Link
from wholearm.search.find_route import choose_opening, explain, find_hand, find_opening, list_hands
from wholearm.search.places import make_place
from wholearm.search.result import describe_block
from wholearm.search.roadmap import Roadmap

TORQUE = Parameter("torque limit of finger 1", 2.0, "N m", 1, "fingers.1.torque_limit")
EPSILON = Parameter("epsilon", 0.05, "N", -1, "epsilon")
NEVER = math.nan


@pytest.mark.parametrize("needed, least", [(2.5, 2.5), (2.9, 3.0), (9.0, None)])
def test_a_number_is_changed_no_further_than_its_way_needs(
    needed: float, least: float | None
) -> None:
    """All that a number opens is looked through first, then the way that was found, alone."""
    openings = [Opening(EPSILON, (0.04, NEVER, 0.03)), Opening(TORQUE, (NEVER, 2.5, 3.0))]
    tried = list[tuple[Change, list[int], bool]]()

    def find(change: Change, beyond: Sequence[int], plan: bool) -> tuple[float, list[int]] | None:
        tried.append((change, list(beyond), plan))
        seen = change.parameter is TORQUE and (not plan or change.value >= needed)
        return (0.5, [1]) if seen else None

    text, changes = choose_opening(openings, find)
    assert tried[:3] == [
        (Change(EPSILON, 0.03), [0, 2], False),
        (Change(TORQUE, 3.0), [1, 2], False),
        (Change(TORQUE, 2.5), [1], True),
    ]
    assert tried[3:] == ([] if needed <= 2.5 else [(Change(TORQUE, 3.0), [1, 2], True)])
    if least is None:
        assert changes == () and text == (
            "the goal is not reached with epsilon = 0.03 N instead of 0.05, "
            "nor with torque limit of finger 1 = 3 N m instead of 2"
        )
        return
    assert changes == (Change(TORQUE, least),)
    assert text == f"with {changes[0]} the goal is reached, in about 0.5 s"


def test_what_is_advised_opens_the_way() -> None:
    """On a rough palm the slide cannot begin; with the friction that is named it can."""
    goal, rough = Goal(flush=0, x=0.03), problem_of(HEPTAGON).with_(friction_palm=1.5)
    own = RouteSearch(Roadmap(rough, 0.1), make_place(rough.scene, rough.start), goal)
    assert not list(own.run())
    # All that leads on from what is reached is in the cut, and nothing that ends where it was.
    assert all(blocked.stop.key not in own.reached for blocked in list_cut(own))
    cuts = list_cut_borders(own)
    assert [cut.blocked for cut in cuts] == list_cut(own)
    for opening in list_openings(cuts):
        for cut, value in zip(cuts, opening.values, strict=True):
            if not math.isnan(value):
                change = Change(opening.parameter, value)
                assert isinstance(link_changed(cut, change), Link)
    text, (change,) = find_opening(own, rough, PlanOptions(), 0.0, lambda _: None)
    assert change.parameter.key == "friction.palm" and change.value < 1.5
    assert text.startswith(f"with {change} the goal is reached, in about ")
    eased = rough.with_({"friction.palm": change.value})
    assert next(
        RouteSearch(Roadmap(eased, 0.1), make_place(eased.scene, eased.start), goal).run()
    ).duration == pytest.approx(float(text.split()[-2]), rel=0.05)
    said = describe_block(own, [], text, lambda blocked: explain(rough, PlanOptions(), blocked))
    assert "blocked; v0-palm" in said and said.endswith(text) and " N short; " in said


def test_hands_are_changed_alike_where_they_are_alike() -> None:
    """And each change is one that a problem takes, by its data."""
    alike = problem_of(HEPTAGON)
    changes = list_hands(alike.scene)
    assert {own.parameter.key for own in changes} == {"length", "fingers.1.base[1]"}
    sizes = [abs(own.value / own.parameter.value - 1) for own in changes]
    assert sizes == pytest.approx(sorted(sizes), abs=5e-3) and max(sizes) < 0.21
    for own in changes:
        right, left = alike.with_(own.values, phases=[]).scene.fingers
        bases = np.array([right.base, left.base])
        assert right.length == pytest.approx(left.length, rel=1e-12)
        assert bases[0] == pytest.approx([-bases[1, 0], bases[1, 1]], rel=1e-12)
    uneven = alike.with_(length1=0.9 * alike.scene.fingers[0].length, base2=[-0.085, -0.01])
    keys = [f"fingers.{k}.{what}" for what in ("base[1]", "length") for k in (1, 2)]
    assert [own.parameter.key for own in list_hands(uneven.scene)[:4]] == keys


def test_fingers_that_cross_on_the_way_are_mounted_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With links of 0.18 m the fingers touch halfway through the slide; none closes at x = 0."""
    table = {key: own for key, own in problem_of(HEXAGON).table.items() if key != "phases"}
    crossing = build_problem({**table, "goal": {"flush": 0, "x": -0.01}}).with_(length=0.18)
    (goal,), place = crossing.goals, make_place(crossing.scene, crossing.start)
    own, told = RouteSearch(Roadmap(crossing, 0.1), place, goal), list[str]()
    monkeypatch.setattr("wholearm.search.find_route.HANDS", (0.95,))
    text, (change,) = find_hand(own, crossing, PlanOptions(), 0.0, told.append)
    assert text.startswith(f"with {change} the goal is reached") and f"{change}" in told[0]
    assert change.values == {"fingers.1.base[1]": 0.076, "fingers.2.base[1]": -0.076}
    changed = crossing.with_(change.values)
    closed = [close_fingers(p.scene, np.zeros(1), p.start[2:3]) for p in (crossing, changed)]
    assert [bool(c.obstacle.any()) for c in closed] == [True, False]

    def end(_: str) -> None:
        raise OutOfTime

    text, changes = find_hand(own, crossing, PlanOptions(), 0.0, end)
    assert changes == () and "not reached with 0 other" in text
