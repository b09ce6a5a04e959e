"""Searches of routes, and changes of one number that open a way that is blocked."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shipped import HEPTAGON, HEXAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import Change, InfeasibleError, InputError, Parameter, SolverError
from wholearm.common.signals import OutOfTime
from wholearm.contacts.closing import close_fingers
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phase
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.options import PlanOptions
from wholearm.planning.result import load_plan
from wholearm.problem.definition import Phase, Problem
from wholearm.problem.goal import Goal
from wholearm.problem.read import build_problem
from wholearm.search.astar import RoadmapRoute, RouteSearch
from wholearm.search.cuts import Opening, link_changed, list_cut, list_cut_borders, list_openings
from wholearm.search.edges import Link
from wholearm.search.find_route import (
    choose_opening,
    explain,
    find_hand,
    find_opening,
    find_route,
    load_roadmap,
    require_folder,
    require_reach,
    store_roadmap,
)
from wholearm.search.places import list_formations_at, make_place
from wholearm.search.result import bound_borders, describe_block
from wholearm.search.roadmap import Roadmap, cross, go_to
from wholearm.verification.verify import verify

TABLE = {k: v for k, v in tomllib.loads(HEPTAGON.read_text()).items() if k != "phases"}


def read(goal: dict[str, Any], **changes: Any) -> Problem:
    return build_problem({**TABLE, "goal": goal}).with_(**changes)


@cache
def chart() -> Roadmap:
    return Roadmap(problem_of(HEPTAGON), 0.1)


def search(goal: Goal) -> RouteSearch:
    problem = problem_of(HEPTAGON)
    return RouteSearch(chart(), make_place(problem.scene, problem.start), goal)


@cache
def to_edge_6() -> tuple[RouteSearch, RoadmapRoute]:
    own = search(Goal(flush=6))
    return own, next(own.run())


def test_the_first_route_is_about_as_fast_as_its_certified_bounds() -> None:
    _, route = to_edge_6()
    z, total = problem_of(HEPTAGON).start, 0.0
    for link in route.links:
        for step in link.steps:
            formation = Formation(chart().scene, step.contacts)
            curve = trace_phase(Phase(0, formation, step.until, step.end), z)
            bound = bound_least_time((curve,), chart().epsilon)
            assert bound is not None
            total, z = total + bound.value, curve.end
        assert np.allclose(z, link.stop.z, atol=1e-9)
    assert route.bound <= total * (1 + 1e-6)
    assert route.duration == pytest.approx(total, rel=5e-3)
    assert {c.name for c in route.links[-1].stop.contacts} >= {"v6-palm", "v0-palm"}


def test_no_route_along_borders_is_faster() -> None:
    own, route = to_edge_6()
    bound = bound_borders(own, 1.0)
    least = sum(link.fine_bound for link in route.links)
    assert bound.complete and 0.99 * route.duration < bound.value <= least * (1 + 1e-9)
    assert bound_borders(own, 0.05).value == 0.05
    # A bound up to more says what one up to less does.
    assert bound.up_to(0.05) == bound_borders(own, 0.05) and bound.up_to(1.0) == bound


def test_a_place_along_a_border_is_a_goal() -> None:
    route = next(search(Goal(flush=0, x=0.03)).run())
    (link,) = route.links
    assert abs(link.stop.z[0] - 0.03) < 1e-9 and link.steps[0].until.value == 0.03


def test_straight_ways_keep_their_limits_and_end_where_a_contact_is_gained() -> None:
    scene, epsilon = chart().scene, chart().epsilon
    _, route = to_edge_6()
    start = route.links[1].stop
    ways = cross((start,), epsilon)
    assert ways
    for way in ways:
        assert way.gained is not None
        ending = Formation(scene, (*way.contacts, way.gained))
        gaps = ending.evaluate(way.z[None], way.z[None]).C
        assert np.abs(gaps).max() < 0.02 * scene.scales.length
        (formation,) = (f for f in list_formations_at(start, 3) if f.contacts == way.contacts)
        pose = way.z[None, [0, 2]]
        again = go_to(start, formation, pose, epsilon)
        assert again is not None and again.duration == pytest.approx(way.duration)
        np.testing.assert_allclose(again.z, way.z, atol=1e-12)
        # With more to press no way is faster.
        harder = go_to(start, formation, pose, 4 * epsilon)
        assert harder is None or harder.duration >= way.duration


def test_a_problem_with_a_goal_is_planned() -> None:
    problem = read({"flush": 0, "x": 0.03})
    answer = find_route(problem)
    assert answer.bound is not None and answer.gap is not None and answer.gap < 0.02
    assert [phase.formation.names for phase in answer.problem.phases] == [
        ("v0-palm", "v1-palm", "v2-finger1", "v5-finger2")
    ]
    assert verify(answer.problem, answer.plan).exit_status == 0
    phases = tomllib.loads(answer.to_text())["phases"]
    again = build_problem({**TABLE, "phases": phases})
    assert again.phases[0].until == answer.problem.phases[0].until


def test_charts_are_kept_in_files(tmp_path: Path) -> None:
    _, route = to_edge_6()
    folder = tmp_path / "new"
    require_folder(folder)
    store_roadmap(folder, "one", chart())
    known = load_roadmap(folder, "one")
    assert known is not None and load_roadmap(folder, "other") is None
    problem = problem_of(HEPTAGON)
    own = RouteSearch(known, make_place(problem.scene, problem.start), Goal(flush=6))
    again = next(own.run())
    assert again.signature == route.signature and again.duration == route.duration
    (file,) = folder.iterdir()
    written = file.read_bytes()
    for damaged in (b"", written[:-1], written[:40] + b"x" + written[41:]):
        file.write_bytes(damaged)
        assert load_roadmap(folder, "one") is None
    with pytest.raises(InputError, match="--cache"):
        require_folder(file)


def test_what_blocks_is_said() -> None:
    # With next to no torque nothing moves.
    weak = problem_of(HEPTAGON).with_(torque_limit=0.02)
    own = RouteSearch(Roadmap(weak, 0.1), make_place(weak.scene, weak.start), Goal(flush=6))
    assert not list(own.run()) and own.settled == 1
    text = describe_block(own, [], "")
    assert text.startswith("nothing leads from x = 45 mm, phi = -1.984 deg to edge 6 on the palm")
    for contact in ("v3-finger1", "v1-finger1"):
        assert f"until {contact} from x = 45 mm, phi = -1.984 deg: no motion begins" in text


def test_a_goal_that_holds_is_no_goal() -> None:
    with pytest.raises(InputError, match="goal: edge 0 on the palm holds already"):
        find_route(read({"flush": 0}))


def test_a_goal_out_of_the_hand_s_reach_is_refused_without_a_search() -> None:
    scene, near = problem_of(HEPTAGON).scene, float(problem_of(HEPTAGON).start[2])
    for goal in (Goal(flush=1, x=0.02), Goal(phi=-0.9, x=0.0), Goal(flush=3)):
        require_reach(scene, goal, near)
    with pytest.raises(InfeasibleError, match=r"finger 2 is too short there; .* closes for x from"):
        find_route(read({"flush": 1, "x": 0.9}))


def test_python_and_time_limits_end_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(SolverError, match="time limit is over, and there is no plan yet"):
        find_route(read({"flush": 6}), time_limit=1e-9)
    monkeypatch.setattr("wholearm.search.route_choice.join_route", interrupt)
    with pytest.raises(KeyboardInterrupt):
        find_route(read({"flush": 6}))


def fail(*_: object) -> None:
    raise InputError("found", "", "cannot be written: No space left on device")


def test_route_prints_phases_that_load(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = HEPTAGON.read_text(encoding="utf-8").split("[[phases]]")[0]
    path = tmp_path / "goal.toml"
    path.write_text(f"{text}[goal]\nflush = 0\nx = 0.03\n", encoding="utf-8")
    found = tmp_path / "found"
    assert main(["route", str(path), "--cache", str(found)]) == 0
    (phase,) = tomllib.loads(capsys.readouterr().out)["phases"]
    assert phase["until"] == {"x": 0.03} and len(list(found.iterdir())) == 1
    plan = tmp_path / "plan.npz"
    assert main(["solve", str(path), "-o", str(plan), "--cache", str(found)]) == 0
    assert phase["until"] == load_plan(plan).problem.table["phases"][0]["until"]
    assert f"wrote {plan}" in capsys.readouterr().out
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wholearm.search.find_route.store_roadmap", fail)
        assert main(["route", str(path), "--cache", str(found)]) == 0
    said = capsys.readouterr()
    assert tomllib.loads(said.out)["phases"] == [phase]
    assert "wholearm: warning: found: cannot be written: No space left" in said.err
    assert main(["route", str(path), "--alternatives", "-1"]) == 2
    assert "--alternatives: -1 given" in capsys.readouterr().err
    assert main(["route", str(path), "--jobs", "0"]) == 2
    assert "--jobs: 0 given; allowed are whole numbers from 1" in capsys.readouterr().err
    # What needs phases says where they come from.
    assert main(["predict", str(path)]) == 2
    assert "`wholearm route FILE` finds" in capsys.readouterr().err


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
