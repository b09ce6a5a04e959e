"""The stress study: scenes, findings, and its own tracing and linear programmes."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rows import each
from shipped import HEPTAGON, tipping
from toys import plan_path
from wholearm import Friction, Phase, PlanOptions, Problem, Trajectory, load
from wholearm.benchmark import refusals
from wholearm.benchmark.scenes import draw_case, random_scene
from wholearm.benchmark.stress import check_exit, compare_values, run_file
from wholearm.common.arrays import Array
from wholearm.contacts.formation import find_touching
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.uniqueness import find_minors
from wholearm.problem.read import build_problem, read_problem
from wholearm.problem.table import write_toml


def test_a_scene_is_drawn_alike_again_and_is_the_same_as_a_file() -> None:
    case, again = draw_case(0, 2), draw_case(0, 2)
    assert case == again
    assert case.table["phases"]
    named = case.table | {"name": "\u4e2d\U0001f600"}
    assert tomllib.loads(write_toml(named)) == named


@pytest.mark.parametrize("number", range(12))
def test_damaged_files_end_clearly(number: int) -> None:
    record = run_file(6, number)
    assert record["findings"] == [] and record["status"] in (0, 1, 2)


@each(
    "status, out, err, written, count",
    [
        (2, "", "wholearm: mutant.toml: x\n", set(), 0),
        (2, "", "wholearm: x\n", set(), 1),
        (2, "", "wholearm: mutant.toml: x\nmore\n", set(), 1),
        (2, "", "", set(), 2),
        (2, "half a table", "wholearm: mutant.toml: x\n", set(), 1),
        (2, "", "wholearm: mutant.toml: x\n", {"out.npz"}, 1),
        (0, "fine", "", {"out.npz"}, 0),
        (0, "fine", "a warning\n", set(), 1),
        (3, "", "", set(), 1),
        (1, "a report", "", set(), 0),
        (1, "", "", set(), 1),
    ],
)
def test_what_counts_as_an_unclear_end(
    status: int, out: str, err: str, written: set[str], count: int
) -> None:
    assert len(check_exit(["verify"], status, out, err, written)) == count


def test_values_that_noise_changes_are_found() -> None:
    def row(value: float | None, number: int, what: str = "noise") -> dict[str, Any]:
        return {"case": ["problem", "a.toml", "time", what, number], "value": value}

    close = [row(1.0, 0), row(1.0 + 5e-7, 1), row(2.0, 0, "change"), row(None, 2)]
    assert compare_values(close) == []
    ((name, *_),) = compare_values([*close, row(1.0 + 5e-6, 3)])
    assert name == "a.toml, time"


def reach(phase: Phase, start: Array) -> refusals.Trace:
    """The way from there that reaches the end of a phase."""
    (reached,) = (way for way in refusals.follow(phase, start) if way.reached)
    return reached


@pytest.mark.parametrize("index", [1, 3])
def test_small_steps_end_where_the_curve_does(
    heptagon: Problem, curves: tuple[Curve, ...], index: int
) -> None:
    phase = heptagon.phases[index]
    ways = refusals.follow(phase, curves[index].start)
    (reached,) = (way for way in ways if way.reached)
    assert np.abs(reached.end - curves[index].end).max() < 1e-5
    endings = {way.ending for way in ways if not way.reached}
    assert endings <= {f"object and {part}" for part in ("palm", "finger 1", "finger 2")}


def test_rolling_keeps_its_place() -> None:
    problem = load(str(HEPTAGON.with_name("box_rolling.toml")))
    first, second = trace_phases(problem)[:2]
    reached = reach(problem.phases[1], first.end)
    assert np.abs(reached.end - second.end).max() < 1e-4


def test_places_where_a_contact_turns_are_on_the_grid(
    heptagon: Problem, curves: tuple[Curve, ...]
) -> None:
    phase, curve = heptagon.phases[2], curves[2]
    reached = reach(phase, curve.start)
    s, z, z_s = refusals.resample(phase.formation, reached, 20)
    turns = [part.start for part in curve.segments[1:]]
    assert turns, "this phase is here for its reversal"
    for turn in turns:
        assert np.abs(s - turn).min() < 1e-3 * curve.length
    rates = refusals.slides(phase.formation, z, z_s)
    assert (np.abs(rates[s == s[np.abs(s - turns[0]).argmin()]]).min()) < 1e-4


Course = tuple[Array, Array, Array]


@pytest.fixture(scope="module")
def course(heptagon: Problem, curves: tuple[Curve, ...]) -> tuple[Phase, Course]:
    phase = heptagon.phases[2]
    return phase, refusals.resample(phase.formation, reach(phase, curves[2].start), 12)


def test_where_a_plan_exists_a_motion_keeps_the_limits(
    heptagon: Problem, course: tuple[Phase, Course]
) -> None:
    phase, (s, z, z_s) = course
    slow = refusals.slow_margin(phase.formation, heptagon.epsilon, z, z_s)
    fast = refusals.fast_margin(phase.formation, heptagon.epsilon, (s, z, z_s))
    assert 0.0 < slow <= fast + 1e-9


def test_planner_and_linear_programme_agree_on_the_weakest_hand(
    heptagon: Problem, curves: tuple[Curve, ...], course: tuple[Phase, Course]
) -> None:
    """The planner still finds a motion where the programme has room, and the margin says so."""
    phase, (s, z, z_s) = course
    plan = plan_path(curves[2], heptagon.epsilon, PlanOptions(intervals=20), phase.number)
    peak = float(np.abs(plan.motion.evaluate(plan.motion.times).tau).max())
    weak = heptagon.with_(torque_limit=1.001 * peak).phases[2].formation
    assert refusals.fast_margin(weak, heptagon.epsilon, (s, z, z_s)) >= -1e-9


def test_least_minors_are_those_of_the_planner(
    heptagon: Problem, course: tuple[Phase, Course], curves: tuple[Curve, ...]
) -> None:
    phase, (_, z, z_s) = course
    rough = replace(heptagon.scene, friction=Friction(0.6, 0.9, 0.9))
    formation = replace(phase.formation, scene=rough)
    ratios = refusals.uniqueness_ratio(formation, z, z_s)
    part = curves[2].segments[0]
    minors = find_minors(formation, formation.evaluate(z[:1], z_s[:1]), part.Xi)
    assert ratios[0] == pytest.approx(minors.ratios[0], rel=1e-9)


def _ends() -> Array:
    problem = tipping()
    start = problem.start
    stop = float(start[0]), float(start[2]) + 0.2
    return refusals.list_ends(problem.phases[0], start, stop)


def test_ends_are_where_the_phase_ends() -> None:
    (phase,), ends = tipping().phases, _ends()
    assert len(ends) > 5 and np.ptp(ends[:, 0]) > 0.01
    assert np.degrees(ends[:, 2]) == pytest.approx(9.5, abs=1e-6)
    assert np.abs(phase.formation.evaluate(ends, ends).C).max() < 1e-9
    goal = ends[3]
    pinned = replace(phase, until=replace(phase.until, pins=(("x", float(goal[0])),)))
    (place,) = refusals.list_ends(pinned, tipping().start, (goal[0], goal[2]))
    assert place == pytest.approx(goal, abs=1e-9)


def test_ends_are_found_though_a_joint_turns_far_on_the_way() -> None:
    """Where the vertex in the corner leaves it, the finger turns by 76 degrees."""
    table = dict(read_problem(str(HEPTAGON.with_name("triangle.toml"))).table)
    flush, corner = ["v0-palm", "v1-palm"], ["v1-finger1", "v0-finger2"]
    phases = [
        {"contacts": [*flush, "v1-finger1", "v2-finger2"], "until": "v0-finger2"},
        {"contacts": [*flush, *corner], "until": {"x": 0.0373}},
        {"contacts": ["v1-palm", *corner], "until": "v2-finger1"},
    ]
    problem = build_problem({**table, "phases": phases})
    start, stop = trace_phases(problem)[1].end, (0.02953, -0.22767)
    ends = refusals.list_ends(problem.phases[2], start, stop)
    assert len(ends) > 5 and np.abs(ends[0, [0, 2]] - stop).max() < 1e-3
    assert ends[0, 3] - start[3] > 1.3


def test_the_best_curve_is_one_that_a_slow_motion_can_take() -> None:
    problem = tipping()
    (formation,) = (phase.formation for phase in problem.phases)
    margin, z, curves = refusals.find_best(formation, problem.epsilon, problem.start, _ends())
    assert margin > 1e-3 and curves > 0
    assert np.abs(formation.evaluate(z, z).C).max() < 1e-9
    assert np.degrees(z[-1, 2]) == pytest.approx(9.5, abs=1e-6)
    assert refusals.slow_margin(formation, problem.epsilon, z, np.gradient(z, axis=0)) > 0


@pytest.mark.parametrize("seed", range(4))
def test_scene_starts_with_closed_fingers(seed: int) -> None:
    problem = build_problem(random_scene(np.random.default_rng(seed)))
    assert set(find_touching(problem.scene, problem.start)) == set(problem.contacts)
    assert 3 <= problem.scene.polygon.n_vertices <= 12


SQUARE = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])


@each(
    "segment, apart",
    [
        ([[2.0, 0.5], [3.0, 0.5]], 1.0),
        ([[2.0, 2.0], [3.0, 2.0]], np.sqrt(2.0)),
        ([[-1.0, 1.2], [2.0, 1.2]], 0.2),
        ([[-1.0, 0.9], [2.0, 0.9]], -0.1),
        ([[0.95, 0.5], [3.0, 0.5]], -0.05),
        ([[0.5, 0.5], [0.5, 5.0]], -0.5),
    ],
)
def test_distance_of_a_segment_and_a_square(segment: list[list[float]], apart: float) -> None:
    assert refusals.separate(SQUARE, np.array([segment]))[0] == pytest.approx(apart)
    assert refusals.separate(np.array([segment]), SQUARE)[0] == pytest.approx(apart)


def test_crossing_segments_overlap() -> None:
    one, other = np.array([[[0.0, 0.0], [2.0, 0.0]]]), np.array([[[1.0, -0.25], [1.0, 3.0]]])
    assert refusals.separate(one, other)[0] == pytest.approx(-0.25)


def test_a_plan_touches_and_does_not_overlap(heptagon: Problem, trajectory: Trajectory) -> None:
    apart = refusals.clearances(heptagon.scene, trajectory.z)
    for pair in ("object and palm", "object and finger 1", "object and finger 2"):
        assert np.abs(apart[pair]).max() < 1e-12
    deeper = trajectory.z + np.array([0.0, -0.001, 0.0, 0.0, 0.0])
    assert refusals.clearances(heptagon.scene, deeper)["object and palm"].min() == pytest.approx(
        -0.001
    )
