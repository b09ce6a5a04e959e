from __future__ import annotations

import signal
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InfeasibleError, InputError, SolverError
from wholearm.common.signals import guard, yielding
from wholearm.contacts.formation import Formation
from wholearm.geometry.tracing import trace_phase
from wholearm.planning.lower_bound.lower_bound import bound_least_time
from wholearm.planning.options import PlanOptions
from wholearm.planning.saved import load_plan
from wholearm.problem.definition import Phase, Problem
from wholearm.problem.goal import Goal
from wholearm.problem.read import build_problem
from wholearm.search.astar import RoadmapRoute, RouteSearch
from wholearm.search.bounds import bound_borders
from wholearm.search.find_route import (
    find_route,
    load_roadmap,
    require_folder,
    require_reach,
    store_roadmap,
)
from wholearm.search.places import list_formations_at, make_place
from wholearm.search.result import describe_block
from wholearm.search.roadmap import Roadmap, cross, go_to
from wholearm.search.route_choice import Chooser
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


def test_ctrl_c_ends_a_search_that_has_an_answer() -> None:
    reached = []

    def run() -> int:
        try:
            with yielding():
                signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            reached.append("stopped")
        with pytest.raises(KeyboardInterrupt), yielding():
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                pass  # as a solver would
        return 0

    assert guard(run) == 0 and reached == ["stopped"]


def test_python_and_time_limits_end_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(SolverError, match="time limit is over, and there is no plan yet"):
        find_route(read({"flush": 6}), time_limit=1e-9)
    monkeypatch.setattr("wholearm.search.route_choice.join_route", interrupt)
    with pytest.raises(KeyboardInterrupt):
        find_route(read({"flush": 6}))


def test_a_route_whose_planning_is_interrupted_is_still_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own, route = to_edge_6()
    chooser = Chooser(problem_of(HEPTAGON), [], own, PlanOptions())
    chooser.found.append(route)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("wholearm.search.route_choice.join_route", interrupt)
        with pytest.raises(KeyboardInterrupt):
            chooser.plan(1, print)
    assert chooser.found == [route] and not chooser.made


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
