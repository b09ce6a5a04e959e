"""Searches of routes, changes that open a way, and routes that are joined, chosen and refined."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import wholearm
from refused import advising
from retelling import Retelling, Units
from shipped import FOLDER, HEPTAGON, HEXAGON, LANDING, problem_of, solved, table_of, text_of
from wholearm import Formation, Goal, Phase, PlanOptions, Problem, Scene, load_plan, verify
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.errors import Change, InputError, SolverError
from wholearm.common.files import make_folder
from wholearm.common.parallel import run_tasks
from wholearm.common.signals import OutOfTime, Reporter
from wholearm.contacts.closing import close_fingers, contact_table, place_at
from wholearm.geometry.curve import Curve
from wholearm.geometry.path_guess import guess_phase
from wholearm.geometry.tracing import CostToGo, trace_phase
from wholearm.mapping import formation_list
from wholearm.mapping.borders import NOWHERE, flush_track, label_cells
from wholearm.mechanics.statics import Statics
from wholearm.planning.lower_bound import bound_least_time
from wholearm.planning.time_domain.guesses import PROBLEM_MODES
from wholearm.planning.time_domain.time_motion import TimeMotion
from wholearm.problem.read import build_problem
from wholearm.problem.table import write_toml
from wholearm.search import astar, cuts, edge_plans
from wholearm.search.astar import MIN_STEP, RefinedPath, RouteSearch, bound_borders, search_release
from wholearm.search.astar import Route as SearchRoute
from wholearm.search.edges import Edge
from wholearm.search.find_route import find_route, format_phases, load_roadmap, store_roadmap
from wholearm.search.places import make_place, require_reach
from wholearm.search.roadmap import Roadmap, evaluate_paths


def read(goal: dict[str, Any], path: Path = HEPTAGON) -> Problem:
    return build_problem(table_of(path) | {"goal": goal})


@cache
def chart() -> Roadmap:
    return Roadmap(problem_of(HEPTAGON), 0.1)


def search(goal: Goal, changed: Problem | None = None) -> RouteSearch:
    """A search for the heptagon, or for another problem with a roadmap of its own."""
    problem = changed or problem_of(HEPTAGON)
    roadmap = Roadmap(changed, 0.1) if changed else chart()
    return RouteSearch(roadmap, make_place(problem.scene, problem.start), goal)


@cache
def to_edge_6() -> tuple[RouteSearch, SearchRoute]:
    own = search(Goal(flush=6))
    return own, next(own.run())


def test_the_first_route_is_about_as_fast_as_its_certified_bounds() -> None:
    _, route = to_edge_6()
    z, total = problem_of(HEPTAGON).start, 0.0
    for edge in route.edges:
        for step in edge.steps:
            formation = Formation(chart().scene, step.contacts)
            curve = trace_phase(Phase(0, formation, step.until, step.end), z)
            bound = bound_least_time((curve,), chart().epsilon)
            assert bound is not None
            total, z = total + bound.value, curve.end
        assert np.allclose(z, edge.stop.z, atol=1e-9)
    assert sum(edge.bound for edge in route.edges) <= total * (1 + 1e-6)
    assert route.estimate == pytest.approx(total, rel=5e-3)
    assert {c.name for c in route.edges[-1].stop.contacts} >= {"v6-palm", "v0-palm"}


def test_no_route_along_borders_is_faster() -> None:
    own, route = to_edge_6()
    bound = bound_borders(own, 1.0)
    least = sum(edge.fine_bound for edge in route.edges)
    assert bound.complete and 0.99 * route.estimate < bound.value <= least * (1 + 1e-9)
    assert bound_borders(own, 0.05).value == 0.05
    # A bound up to more says what one up to less does.
    assert bound.up_to(0.05) == bound_borders(own, 0.05) and bound.up_to(1.0) == bound


def test_under_rate_limits_motions_begin_on_borders_where_torques_hold() -> None:
    """As the linear programmes of statics say, in the direction of the border."""
    problem = problem_of(FOLDER / "triangle.toml").with_(friction=0.2, torque_rate_limit=500.0)
    roadmap, start = Roadmap(problem, 0.1), make_place(problem.scene, problem.start)
    borders = [chain.borders[0] for chain in roadmap.follow(start)]
    borders += [chain.borders[0] for each in borders for chain in roadmap.follow(each.stop)]
    assert any("verge" in border.limits.no_start for border in borders)
    for border in borders:
        static = Statics(border.formation, border.curve.start)
        (heading,) = border.curve.interpolate(np.zeros(1))[1]
        rates = np.append(static.A_t @ heading, heading[3:])
        along = [signs @ rates for _, signs in static.list_continuous(problem.epsilon) or ()]
        assert (max(along, default=0) > 0.9 * np.abs(rates).sum()) == (not border.limits.no_start)


@pytest.mark.parametrize("turned", [{"flush": 0}, {"phi_deg": -1.984}], ids=str)
def test_a_problem_with_a_goal_is_planned(turned: dict[str, float]) -> None:
    answer = find_route(read(turned | {"x": 0.03}))
    assert answer.bound is not None and answer.gap is not None and answer.gap < 0.02
    names = [phase.formation.names for phase in answer.problem.phases]
    assert names == [("v0-palm", "v1-palm", "v2-finger1", "v5-finger2")]
    assert verify(answer.problem, answer.plan).exit_status == 0
    phases = tomllib.loads(answer.to_text())["phases"]
    again = build_problem(table_of() | {"phases": phases})
    assert again.phases[0].until == answer.problem.phases[0].until
    (edge,) = answer.route.edges
    assert abs(edge.stop.z[0] - 0.03) < 1e-9 and edge.steps[0].until.value == 0.03


def test_charts_are_kept_in_files(tmp_path: Path) -> None:
    _, route = to_edge_6()
    folder = tmp_path / "new"
    make_folder(str(folder))
    store_roadmap(folder, "one", chart())
    known = load_roadmap(folder, "one")
    assert known is not None and load_roadmap(folder, "other") is None
    problem = problem_of(HEPTAGON)
    place = make_place(problem.scene, problem.start)
    again = next(RouteSearch(known, place, Goal(flush=6)).run())
    assert again.key == route.key and again.estimate == route.estimate
    (file,) = folder.iterdir()
    written = file.read_bytes()
    for damaged in (b"", written[:-1], written[:40] + b"x" + written[41:]):
        file.write_bytes(damaged)
        assert load_roadmap(folder, "one") is None
    with pytest.raises(InputError, match=f"{file.name}: cache: cannot be made: File exists"):
        find_route(read({"flush": 0, "x": 0.03}), cache=file)


def test_what_blocks_is_said() -> None:
    # With next to no torque nothing moves.
    own = search(Goal(flush=6), problem_of(HEPTAGON).with_(torque_limit=0.02))
    assert not list(own.run()) and len(own.reached) == 1
    text = cuts.describe_block(own, [], "")
    assert text.startswith("nothing leads from x = 45 mm, phi = -1.984 deg to edge 6 on the palm")
    for contact in ("v3-finger1", "v1-finger1"):
        assert f"until {contact} from x = 45 mm, phi = -1.984 deg: no motion begins" in text


def test_goals_that_hold_or_are_out_of_reach_are_refused_without_a_search() -> None:
    with pytest.raises(InputError, match="goal: edge 0 on the palm holds already"):
        find_route(read({"flush": 0}))
    scene, near = problem_of(HEPTAGON).scene, float(problem_of(HEPTAGON).start[2])
    for goal in (Goal(flush=1, x=0.02), Goal(phi=-0.9, x=0.0), Goal(flush=3)):
        require_reach(scene, goal, near)
    with pytest.raises(InputError, match=r"goal.x: 0.9 given; finger 2 is too short there; .* x"):
        find_route(read({"flush": 1, "x": 0.9}))


def test_python_and_time_limits_end_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SolverError, match="time limit is over, and there is no plan yet"):
        find_route(read({"flush": 6}), time_limit=1e-9)
    monkeypatch.setattr("wholearm.search.astar.plan_part", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        find_route(read({"flush": 6}))


def test_route_prints_phases_that_load(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "goal.toml"
    path.write_text(f"{text_of(phases=0)}[goal]\nflush = 0\nx = 0.03\n", encoding="utf-8")
    found = tmp_path / "found"
    assert main(["route", str(path), "--cache", str(found)]) == 0
    (phase,) = tomllib.loads(capsys.readouterr().out)["phases"]
    assert phase["until"] == {"x": 0.03} and len(list(found.iterdir())) == 1
    plan = tmp_path / "plan.npz"
    assert main(["solve", str(path), "-o", str(plan), "--cache", str(found)]) == 0
    assert phase["until"] == load_plan(plan).problem.table["phases"][0]["until"]
    # Coarse plans depend on options: with other ones another roadmap is kept.
    assert main(["solve", str(path), "-o", str(plan), "--cache", str(found), "--degree", "2"]) == 0
    assert len(list(found.iterdir())) == 2 and f"wrote {plan}" in capsys.readouterr().out
    with pytest.MonkeyPatch.context() as patch:
        full = InputError("found", "", "cannot be written: No space left on device")
        patch.setattr("wholearm.search.find_route.store_roadmap", Mock(side_effect=full))
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


def test_printed_phases_have_the_plan_that_they_are_printed_for() -> None:
    """Read again they begin with the modes and poses of that plan, but for rounding."""
    plan = solved(LANDING)
    motions = (own if isinstance(own, TimeMotion) else None for own in plan.trajectory.motions)
    pairs = zip(plan.problem.phases, motions, strict=True)
    phases = edge_plans.round_phases(plan.problem.scene, pairs, guesses=True)
    printed = replace(plan.problem, phases=phases)
    again = build_problem(table_of(LANDING) | tomllib.loads(format_phases(printed)))
    over_time = [phase.number for phase in plan.phases if phase.modes]
    assert over_time and [p.number for p in again.phases if p.guess] == over_time
    for one, other in zip(printed.phases, again.phases, strict=True):
        assert (one.until, one.end, one.guess) == (other.until, other.end, other.guess)
    found = wholearm.solve(again, replay=False)
    assert found.phases[over_time[0] - 1].attempt == PROBLEM_MODES
    # The issue allows 1e-4; both refine to that accuracy.
    assert found.duration == pytest.approx(plan.duration, rel=1e-4)


def test_what_is_advised_opens_the_way() -> None:
    """On a rough palm the slide cannot begin; with the friction that is named it can."""
    goal, rough = Goal(flush=0, x=0.03), problem_of(HEPTAGON).with_(friction_palm=1.5)
    own = search(goal, rough)
    assert not list(own.run())
    # All that leads on from what is reached is in the cut, and nothing that ends where it was.
    blocked = cuts.list_cut(own)
    assert blocked and all(edge.stop.key not in own.reached for edge in blocked)
    for opening in cuts.list_openings(blocked):
        for cut, value in ((blocked[k], value) for k, value in opening.values.items()):
            change = Change(opening.parameter, value)
            assert isinstance(cuts.change_edge(cut, change), Edge)
    planner = astar.RoutePlanner(rough, None, own, PlanOptions(), Reporter(None))
    text, (change,) = cuts.find_opening(planner, 0.0)
    assert change.parameter.key == "friction.palm" and change.value < 1.5
    assert text.startswith(f"with {change} the goal is reached, in about ")
    eased = rough.with_({"friction.palm": change.value})
    route = next(search(goal, eased).run())
    assert route.estimate == pytest.approx(float(text.split()[-2]), rel=0.05)
    coarse = PlanOptions(intervals=20)
    with advising(lambda wanted: wanted.key == "friction.palm"):
        said = cuts.describe_block(own, [], text, lambda at: cuts.explain_block(rough, coarse, at))
    assert "blocked; v0-palm" in said and said.endswith(text) and " N short; " in said


def test_fingers_that_cross_on_the_way_are_mounted_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With links of 0.18 m the fingers touch halfway through the slide; none closes at x = 0."""
    crossing = read({"flush": 0, "x": -0.01}, HEXAGON).with_(length=0.18)
    (goal,), told = crossing.goals, list[str]()
    own = search(goal, crossing)
    monkeypatch.setattr("wholearm.search.cuts.HANDS", (0.95,))
    planner = astar.RoutePlanner(crossing, None, own, PlanOptions(), Reporter(told.append))
    text, (change,) = cuts.find_hand(planner, 0.0)
    assert text.startswith(f"with {change} the goal is reached") and f"{change}" in told[0]
    assert change.values == {"fingers.1.base[1]": 0.076, "fingers.2.base[1]": -0.076}
    changed = crossing.with_(change.values)
    closed = [close_fingers(p.scene, np.zeros(1), p.start[2:3]) for p in (crossing, changed)]
    assert [bool(c.obstacle.any()) for c in closed] == [True, False]

    planner.report = Reporter(Mock(side_effect=OutOfTime))
    text, changes = cuts.find_hand(planner, 0.0)
    assert changes == () and "not reached with 0 other" in text


# Where plans come from does not depend on how accurate they are.
OPTIONS = PlanOptions(accuracy=0.1, replay=False)


def test_parts_planned_at_the_same_time_make_the_same_plan() -> None:
    problem, (_, route) = problem_of(HEPTAGON), to_edge_6()
    parts = edge_plans.split_route(route.edges)
    assert tuple(edge for part in parts for edge in part) == route.edges
    assert len(parts) > 1 and not any(part[-1].in_cell for part in parts[:-1])

    def plan(part: list[Edge]) -> edge_plans.PartPlan | edge_plans.PlanFailure:
        begin = replace(problem, start=part[0].start.z)
        return edge_plans.plan_part(begin, [(edge, None) for edge in part], OPTIONS, lambda _: None)

    tasks = [partial(plan, part) for part in parts]
    for one, other in zip(run_tasks(tasks, 1), run_tasks(tasks, 2), strict=True):
        assert isinstance(one, list) and isinstance(other, list), (one, other)
        # Solves in another process may differ in the last bits, and by the solver's tolerance then.
        for (mine, motion), (theirs, again) in zip(one, other, strict=True):
            assert dict(mine.until.pins) == pytest.approx(dict(theirs.until.pins), abs=1e-6)
            if motion and again:
                assert motion.duration == pytest.approx(again.duration, rel=1e-6)
                ends = (part.evaluate(np.array([part.duration])).z for part in (motion, again))
                assert next(ends) == pytest.approx(next(ends), abs=1e-6)


def test_edges_that_cannot_be_planned_are_named() -> None:
    """With next to no torque the first edge has no plan, on any route."""
    _, route = to_edge_6()
    problem = problem_of(HEPTAGON).with_(torque_limit=0.02)
    edges = [(edge, None) for edge in edge_plans.split_route(route.edges)[0]]
    lost = edge_plans.plan_part(problem, edges, OPTIONS, lambda _: None)
    assert isinstance(lost, edge_plans.PlanFailure) and lost.phases == [1]
    assert "until" in lost and "phase 1" in lost


@pytest.mark.parametrize(("phases", "lost", "tries"), [([2], slice(1, 2), 1), ([], slice(0), 2)])
def test_edges_of_phases_without_a_plan_are_left_out_of_other_routes(
    phases: list[int], lost: slice, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a failure without known phases other guesses and routes of the same edges are tried."""
    own, route = to_edge_6()
    failed = edge_plans.PlanFailure("no plan")
    failed.phases, plan = phases, Mock(return_value=failed)
    monkeypatch.setattr(astar, "plan_phases", plan)
    monkeypatch.setattr(astar.RoutePlanner, "_plan_parts", Mock(return_value=[]))
    silent, problem = Reporter(None), problem_of(HEPTAGON)
    planner = astar.RoutePlanner(problem, None, own, OPTIONS, silent, routes=[route, route])
    planner.plan()
    assert not planner.plans and planner.failures == ["no plan"] * tries
    assert failed.edges == route.edges[lost] and plan.call_count == tries**2


@pytest.mark.parametrize(("best", "end"), [(0, -1), (-7, -8), (5, -20), (-3, -3)])
def test_a_border_is_left_where_that_is_best(best: int, end: int) -> None:
    """Paths through cells take longer away from a best place, and there is none beyond an end."""

    def plan(path: RefinedPath, _: object) -> edge_plans.CoarsePlan | None:
        if path.move is None or path.move < end:
            return None
        return edge_plans.CoarsePlan(1 + MIN_STEP * abs(path.move - best), (), [])

    found, *others = search_release(plan, edge_plans.CoarsePlan(1 + MIN_STEP * abs(best), (), []))
    assert found.duration == pytest.approx(1, abs=1e-9)
    assert all(own.duration >= found.duration for own in others)
    plan_on = lambda path, one: one._replace(duration=0.9) if one else plan(path, one)  # noqa: E731
    assert search_release(plan_on, found)[0].duration < 1


def test_a_border_is_left_with_regard_to_what_follows(heptagon: Problem) -> None:
    """An edge that lasts 1 + |k| with k steps of the place, before one that lasts |k + 3| twice."""

    def plan(path: RefinedPath, _: object = None) -> edge_plans.CoarsePlan | None:
        if path.move is None:
            return None
        z = np.full((1, 5), float(path.move))
        motion = SimpleNamespace(duration=0.0, evaluate=lambda _: SimpleNamespace(z=z, z_dot=z))
        begun: Any = [SimpleNamespace(motion=motion)]
        return edge_plans.CoarsePlan(1 + abs(path.move), (), begun)

    to_go = CostToGo(heptagon.phases[0], lambda z: 2 * abs(float(z[0]) + 3))
    for cost, duration in ((None, 1), (to_go, 4)):
        start = plan(RefinedPath(0))
        assert isinstance(start, edge_plans.CoarsePlan)
        assert search_release(plan, start, cost)[0].duration == duration


PHI = np.radians(-35.0)


def on_border(problem: Problem, phi: float) -> Array:
    """Where edge 6 lies flush on finger 2 with vertex 1 on the palm, as in the flip's plan."""
    track = flush_track(problem.scene, 1, 6, 1, np.array([phi]))
    return np.array(track.pose(track.places)).ravel()


def split_leg(scene: Scene, start: Array, stop: Array) -> list[formation_list.Part]:
    return formation_list.split_leg(scene, formation_list.choose_leg(scene, start, stop))


@pytest.mark.parametrize("back", [False, True])
def test_leg_through_cells_changes_one_contact_at_a_time(heptagon: Problem, back: bool) -> None:
    scene = heptagon.scene
    ends = [np.array([0.02, 0.3]), np.array([-0.08, -0.8])]
    start, stop = ends[::-1] if back else ends
    parts = split_leg(scene, start, stop)
    assert len(parts) == 7
    np.testing.assert_array_equal(parts[0].start, start)
    np.testing.assert_allclose(parts[-1].stop, stop, atol=1e-12)
    assert parts[-1].gained == () and parts[-1].coordinate == 0
    for one, two in pairwise(parts):
        np.testing.assert_allclose(one.stop, two.start, atol=1e-12)
        assert set(two.contacts) - set(one.contacts) == set(one.gained)
        z = close_fingers(scene, *one.stop[:, None]).z
        both = Formation(scene, tuple({*one.contacts, *two.contacts}))
        assert np.abs(both.evaluate(z, z).C).max() < 1e-9
    for part in parts:
        middle = (part.start + part.stop) / 2
        label = label_cells(scene, middle)
        table = contact_table(scene)
        assert part.contacts == tuple(table[i] for i in label if i != NOWHERE)


def test_leg_follows_a_border_that_both_ends_are_near(heptagon: Problem) -> None:
    near = formation_list.tolerance(heptagon.scene)
    for off in (0.0, 0.9, -0.9):
        ends = [on_border(heptagon, phi) + off * near for phi in (PHI, PHI + 0.15)]
        (part,) = split_leg(heptagon.scene, *ends)
        assert len(part.contacts) == 4 and part.coordinate == 1
        for place, end in ((part.start, ends[0]), (part.stop, ends[1])):
            np.testing.assert_allclose(place, on_border(heptagon, place[1]), atol=1e-12)
            assert (np.abs(place - end) < near).all()


def beside_border(problem: Problem, bulge: float) -> tuple[Array, Array]:
    """A leg whose ends are three times the tolerance off a border that bulges by so many times."""
    near = formation_list.tolerance(problem.scene)[0]
    for span in np.linspace(0.1, 0.6, 400):
        start, stop = on_border(problem, PHI), on_border(problem, PHI + span)
        away = ((start + stop) / 2 - on_border(problem, PHI + span / 2))[0]
        if abs(away) > bulge * near:
            break
    aside = np.array([-np.sign(away) * 3.0 * near, 0.0])
    return start + aside, stop + aside


@pytest.mark.parametrize("bulge, crosses", [(4.0, False), (9.0, True)])
def test_a_leg_beside_a_curved_border(heptagon: Problem, bulge: float, crosses: bool) -> None:
    """Where it is less than the tolerance beyond the border, it stays in its cell."""
    scene, leg = heptagon.scene, beside_border(heptagon, bulge)
    on_finger_2 = label_cells(scene, np.linspace(*leg, 300))[:, 2]
    assert (np.diff(on_finger_2) != 0).sum() == 2
    parts = split_leg(scene, *leg)
    touched = [next(c for c in part.contacts if c.finger == 1) for part in parts]
    changes = sum(one != two for one, two in pairwise(touched))
    assert changes == (2 if crosses else 0)
    assert touched[0] == touched[-1] == contact_table(scene)[on_finger_2[0]]


def test_a_crossing_is_named_by_its_contacts(heptagon: Problem) -> None:
    phi, x = heptagon.scene.polygon.flush_angle(0), -0.06368782401
    words = r"crossing of borders at x = -63.69 mm.*, of v1-palm, v3-finger1, v0-finger2, v0-palm"
    with pytest.raises(InputError, match=words):
        split_leg(heptagon.scene, np.array([x - 0.01, phi - 0.1]), np.array([x + 0.01, phi + 0.1]))


def test_near_miss_names_the_border_and_its_distance(heptagon: Problem) -> None:
    scene, near = heptagon.scene, formation_list.tolerance(heptagon.scene)
    aside = np.array([near[0], 0.0])
    start, stop = (on_border(heptagon, phi) + 2.0 * aside for phi in (PHI, PHI + 0.2))
    text = formation_list.choose_leg(scene, start, stop).note
    words = "e6 flush on finger 2", " up to 0.", "mm in x", "0.5 deg"
    assert all(word in text for word in words)
    assert not formation_list.choose_leg(scene, start + 10 * aside, stop + 10 * aside).note
    phi = scene.polygon.flush_angle(0) + 3 * near[1]
    palm = formation_list.choose_leg(scene, np.array([0.045, phi]), np.array([0.0, phi])).note
    assert "e0 flush on the palm, is up to 1.5 deg" in palm


HEPTAGON_TABLE = tomllib.loads(HEPTAGON.read_text(encoding="utf-8"))
FLAT = -1.984


def load_pasted(table: dict[str, Any], route: formation_list.Route, folder: Path) -> Problem:
    """What loading gives when the list replaces what it names in a problem file."""
    text = formation_list.format_route(route)
    kept = {key: value for key, value in table.items() if key not in tomllib.loads(text)}
    path = folder / "pasted.toml"
    path.write_text(write_toml(kept) + text, encoding="utf-8")
    return wholearm.load(str(path))


def list_degrees(problem: Problem, *poses: tuple[float, float]) -> formation_list.Route:
    return formation_list.list_formations(problem, *((x, np.radians(phi)) for x, phi in poses))


def test_slide_is_listed_as_in_the_problem_file(heptagon: Problem) -> None:
    text = formation_list.format_route(list_degrees(heptagon, (0.045, FLAT), (-0.0637, FLAT)))
    assert tomllib.loads(text)["phases"] == HEPTAGON_TABLE["phases"][:3]
    assert "[start]" not in text
    headings = [line.split("#")[1][:5] for line in text.splitlines() if "[[" in line]
    assert headings == [" 1: t", " 2: t", " 3: t"]


def test_route_along_curved_borders_is_the_whole_plan(
    heptagon: Problem, curves: tuple[Curve, ...], tmp_path: Path
) -> None:
    # Poses as read off the map: to a tenth of a millimetre and of a degree.
    poses = [(0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.0078, -50.0)]
    route = list_degrees(heptagon, *poses)
    assert tomllib.loads(formation_list.format_route(route))["phases"] == HEPTAGON_TABLE["phases"]
    for stretch, curve in zip(route, curves, strict=True):
        # Ends are those of the traced curves, but for the last, which the user gives.
        np.testing.assert_allclose(stretch.start, curve.start[[0, 2]], atol=1e-9)
    assert len(load_pasted(HEPTAGON_TABLE, route, tmp_path).phases) == 5


def test_turn_back_on_a_border_is_a_phase(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (0.045, FLAT), (0.03, FLAT), (0.04, FLAT))
    assert [str(stretch.until) for stretch in route] == ["x = 0.03 m", "x = 0.04 m"]
    assert set(route[0].contacts) == set(route[1].contacts)
    assert len(load_pasted(HEPTAGON_TABLE, route, tmp_path).phases) == 2
    onwards = list_degrees(heptagon, (0.045, FLAT), (0.04, FLAT), (0.03, FLAT))
    assert [str(stretch.until) for stretch in onwards] == ["x = 0.03 m"]


def test_route_that_starts_elsewhere_brings_its_start(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (-0.05, FLAT + 0.2), (0.03, FLAT))
    assert [str(stretch.until) for stretch in route] == ["v5-finger2", "v2-finger1", "x = 0.03 m"]
    text = formation_list.format_route(route)
    assert tomllib.loads(text)["start"] == {"flush": 0, "x": -0.05}
    assert "takes the place of the problem's own" in text
    assert load_pasted(HEPTAGON_TABLE, route, tmp_path).start[0] == -0.05


def test_route_that_starts_in_a_cell_is_led_there(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (0.03, -8.0), (0.01, -12.0))
    assert route.start is None and "from the problem's start" in formation_list.format_route(route)
    np.testing.assert_allclose(route[0].start, heptagon.start[[0, 2]], rtol=1e-12)
    assert len(load_pasted(HEPTAGON_TABLE, route, tmp_path).phases) == len(route)


def test_routes_that_cannot_be_followed_are_named(heptagon: Problem) -> None:
    x, phi = heptagon.start[[0, 2]].tolist()
    for words, *poses in (
        ("leg 1 cannot be followed .* finger 2 is too short", (x, phi), (0.2, 0.2)),
        ("two or more", (x, phi)),
        ("same place", (x, phi), (x, phi)),
        ("cannot start at .*: finger 1 is too short", (0.4, phi), (x, phi)),
        (r"route: -63\.7 given; allowed are .* m ", (x, phi), (-63.7, phi)),
    ):
        with pytest.raises(InputError, match=words):
            formation_list.list_formations(heptagon, *poses)


def test_lists_do_not_depend_on_units(heptagon: Problem) -> None:
    size = 700.0
    large = Retelling("large", Units.of(size, 1.0)).apply(heptagon)
    poses = [(0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.03, 3.0)]
    one = list_degrees(heptagon, *poses)
    two = list_degrees(large, *((size * x, phi) for x, phi in poses))
    assert [s.contacts for s in one] == [s.contacts for s in two]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.stop * [size, 1.0], b.stop, rtol=1e-4, atol=1e-4)


HARD = {
    "a pointed tip runs off an edge that lies flush": (
        "-0.0861 -0.0032; -0.0337 -0.0679; 0.0661 -0.0493; 0.0721 0.0395; -0.0278 0.0712",
        [([0.0687, 0.0075], 0.2347, 0.0), ([-0.195, 0.0028], 0.2047, 0.0)],
        (0, -0.0009),
        [(-0.0009, 51.034), (0.0133, 51.034), (-0.109, 91.915)],
        "v3-finger2",
    ),
    "a pointed tip passes from edge to edge": (
        "0.0666 0.0695; 0.0511 0.0713; -0.0296 0.0332; -0.0733 -0.0178; -0.0678 -0.0691; "
        "-0.0189 -0.0631; 0.0071 -0.0494; 0.0694 0.011",
        [([0.2446, -0.0229], 0.3186, 0.0), ([-0.2226, 0.026], 0.2919, 0.0)],
        (6, 0.0873),
        [(0.0873, -44.138), (0.1379, -28.38), (0.1384, -27.663), (0.0715, -27.663)],
        "v2-finger2",
    ),
    "a vertex passes from the side of a link to its rounded tip": (
        "-0.0492 -0.092; -0.0364 -0.0739; 0.0087 0.0079; 0.0328 0.055; 0.0492 0.0923; "
        "0.0333 0.0687; -0.001 0.0068; -0.0404 -0.0706",
        [([0.1886, -0.0131], 0.1886, 0.0012), ([-0.1469, -0.0287], 0.1492, 0.0053)],
        (1, -0.0139),
        [(-0.0139, -61.107), (0.0364, -62.899), (-0.1043, -62.936)],
        "v5-tip1",
    ),
    "the end of a cell is far away": (
        "0.0771 0.0821; 0.0302 0.0392; -0.0333 -0.0287; -0.0767 -0.0826; -0.0332 -0.0422; "
        "0.0334 0.0288",
        [([0.117, -0.0326], 0.3934, 0.0128), ([-0.0972, -0.0252], 0.3999, 0.0093)],
        (4, -0.1417),
        [(-0.1417, -46.856), (-0.1387, -47.581), (0.3798, -42.853)],
        "v5-finger1",
    ),
    "a contact may be gained both ways along a border": (
        "0.1283 0.0553; -0.0557 0.0251; -0.0548 -0.0629",
        [([0.1915, -0.0479], 0.1946, 0.0), ([-0.1548, -0.0395], 0.1405, 0.0)],
        (2, 0.0151),
        [(0.0151, -32.848), (-0.1111, -32.848), (0.0093, -32.848)],
        "v0-finger1",
    ),
    "a vertex at a pointed tip is nearer than the edge that lies flush": (
        "-0.0647 -0.0725; -0.0373 -0.0694; -0.0031 -0.0481; 0.0298 -0.017; 0.0471 0.0042; "
        "0.0707 0.0505; 0.0622 0.0735; 0.0525 0.0739; 0.0158 0.0574; -0.0296 0.0173; "
        "-0.0521 -0.0113; -0.0708 -0.0508",
        [([0.2366, -0.0346], 0.2665, 0.0), ([-0.0996, -0.008], 0.3867, 0.0)],
        (11, 0.0098),
        [(0.0098, 74.176), (0.0183, 129.255)],
        "v9-palm",
    ),
}
"""Vertices [m], fingers (base, length, radius) [m], start (edge, x), poses [m, deg], an end."""


@pytest.mark.parametrize("name", HARD)
def test_hard_lists_load(name: str, tmp_path: Path) -> None:
    vertices, hands, (edge, x), poses, end = HARD[name]
    corners = [[float(x) for x in corner.split()] for corner in vertices.split(";")]
    changes: dict[str, Any] = {"vertices": corners, "phases": None}
    changes["start"] = {"flush": edge, "x": x}
    for k, hand in enumerate(hands, 1):
        changes |= zip((f"base{k}", f"length{k}", f"radius{k}"), hand, strict=True)
    problem = problem_of(HEPTAGON).with_(changes)
    route = list_degrees(problem, *poses)
    assert end in [str(stretch.until) for stretch in route]
    assert len(load_pasted(dict(problem.table), route, tmp_path).phases) == len(route)


def test_list_goes_on_where_loading_ends_a_phase(heptagon: Problem, tmp_path: Path) -> None:
    """Each phase of a list, loaded, ends where the next one's contacts touch."""
    route = list_degrees(heptagon, (0.045, FLAT), (0.03, -20.0), (-0.02, -30.0), (-0.0505, -23.4))
    problem = load_pasted(HEPTAGON_TABLE, route, tmp_path)
    z = problem.start
    for phase in problem.phases:
        gaps = phase.formation.evaluate(z[None], z[None]).C[0]
        assert np.abs(gaps).max() < 1e-9
        assert phase.formation.evaluate_limits(z[None]).min() > -1e-9
        z = guess_phase(phase, z)[-1].z[-1]


def test_a_contact_that_a_leg_begins_with_has_been_gained(tmp_path: Path) -> None:
    """Also after a leg that ends in a cell, next to where another contact is gained."""
    square = problem_of(FOLDER / "square.toml")
    turns = [(0.0352104, -0.1879037), (0.0561329, -0.4940113), (0.0813296, -0.6529818)]
    route = formation_list.list_formations(square, (0.06, 0.0), (0.007424, 0.0), *turns)
    for before, after in pairwise(route):
        assert {*after.contacts} <= {*before.contacts, before.until.contact}
    # Legs that end in a cell do so where they are said to, to what is printed.
    unit = (square.scene.scales.length, 1.0)
    for turn in turns:
        assert min(np.abs((own.stop - turn) / unit).max() for own in route) < 1e-5
    assert sum(len(own.until.poses) == 2 for own in route) == len(turns)
    load_pasted(dict(square.table), route, tmp_path)


def test_a_place_out_of_reach_changes_nothing_at_others() -> None:
    scene, rng = problem_of(HEPTAGON).scene, np.random.default_rng(1)
    poses = np.column_stack([rng.uniform(-0.1, 0.1, 300), rng.uniform(-4, 4, 300)])
    labels, runs = label_cells(scene, poses), rng.normal(size=poses.shape)
    inside = (labels >= 0).all(axis=1)
    labels, poses, runs = labels[inside], poses[inside], runs[inside] * [0.03, 1.0]
    far = poses + np.array([1.0, 0.0])
    # A tip does not reach an edge that is 1 m away.
    lost = np.flatnonzero(np.isnan(place_at(scene, labels, far)).any(axis=1))[:1]
    assert len(lost)
    alone = evaluate_paths(scene, 0.05, labels, poses, runs).can_rest()
    assert 0.2 < alone.mean() < 0.8
    pairs = (labels, labels), (poses, far), (runs, runs)
    some, places, ways = (np.concatenate([part, own[lost]]) for part, own in pairs)
    both = evaluate_paths(scene, 0.05, some, places, ways).can_rest()
    np.testing.assert_array_equal(both, [*alone, False])
