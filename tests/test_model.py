"""Scenes at the ends of their ranges are planned, or refused with a reason; nothing warns."""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from plane import SQUARE, convex_polygon, cross, make_finger, make_scene
from retelling import RETELLINGS, Answer, Retelling, answer
from rows import each
from shipped import BOX, IMPACTS, text_of
from wholearm import Finger, Friction, Polygon, Problem, Scene, verify
from wholearm.common.arrays import Array
from wholearm.common.errors import InfeasibleError, InputError, JammingError, name_source
from wholearm.common.fields import keys_of
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem

FINGER, BODY = make_finger([0, 0]), Polygon(SQUARE, 1.0, 1.0)
POSITIVE: list[tuple[Any, str]] = [(BODY, "mass"), (BODY, "inertia")]
POSITIVE += [(FINGER, own) for own in ("length", "inertia", "torque_limit", "speed_limit")]
NUMBERS = POSITIVE + [(FINGER, own) for own in ("radius", "viscous", "dry")]
NUMBERS += [(Friction(0.1, 0.1, 0.1), own) for own in ("palm", "finger1", "finger2")]


@each(
    "given, key, value",
    [
        *((*own, value) for own in NUMBERS for value in (-1.0, math.nan, True, "1")),
        *((*own, value) for own in POSITIVE for value in (0.0, 10**400)),
    ],
)
def test_bad_numbers_are_named(given: Any, key: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        replace(given, **{key: value})
    assert caught.value.key.endswith(f".{key}") and repr(value) in caught.value.problem


@pytest.mark.parametrize("right", [-0.081, -0.2])
def test_swapped_fingers(right: float) -> None:
    scene = make_scene()
    with pytest.raises(InputError, match="not to the right") as caught:
        replace(scene, fingers=(make_finger([right, 0.0]), scene.fingers[1]))
    assert caught.value.key == "fingers.1.base"


def test_scene_vectors_follow_the_order_of_z() -> None:
    scene = make_scene()
    right, left = scene.fingers
    fingers = (
        replace(right, inertia=1.0, viscous=2.0, dry=3.0, torque_limit=4.0, speed_limit=5.0),
        replace(left, inertia=6.0, viscous=7.0, dry=8.0, torque_limit=9.0),
    )
    scene = Scene(Polygon(SQUARE, 0.5, 0.25), fingers, scene.friction, gravity=2.0)
    assert scene.mass_diagonal == pytest.approx([0.5, 0.5, 0.25, 1.0, 6.0])
    assert scene.applied_force == pytest.approx([0.0, -1.0, 0.0, 0.0, 0.0])
    assert scene.viscous == pytest.approx([0.0, 0.0, 0.0, 2.0, 7.0])
    assert scene.dry == pytest.approx([0.0, 0.0, 0.0, 3.0, 8.0])
    assert scene.torque_limit == pytest.approx([4.0, 9.0])
    assert scene.speed_limit == pytest.approx([5.0, math.inf])


def test_scales_follow_the_units() -> None:
    scales = (scene := make_scene(SQUARE)).scales
    assert scales.force == scene.polygon.mass * scene.gravity
    assert scales.speed * scales.time == pytest.approx(scales.length, rel=1e-14)
    assert scales.acceleration * scales.time**2 == pytest.approx(scales.length, rel=1e-14)
    assert scales.acceleration == pytest.approx(scene.gravity, rel=1e-14)


def test_without_gravity_the_weaker_finger_sets_the_force() -> None:
    long, short = make_finger([0.1, 0.0], length=0.3), make_finger([-0.1, 0.0], length=0.1)
    scene = replace(make_scene(SQUARE), gravity=0.0, fingers=(long, short))
    assert scene.scales.force == pytest.approx(long.torque_limit / 0.3 / 100, rel=1e-14)


def test_every_number_of_a_finger_has_a_unit_of_the_scene() -> None:
    """Problem files and planning in own units take new fields from here."""
    scene = make_scene()
    known = keys_of(Finger)
    assert {own.name for own in fields(Finger)} - set(known) == {"name"}
    assert all(getattr(scene.scales, own.scale) > 0 for own in known.values())


@each("given", ["\n" * 3, "\x00" * 5000, "x" * 5000, "\u2028", "\x1b[2J"])
def test_a_message_is_one_line(given: str) -> None:
    text = str(InputError("a.toml", "name", f"{given} is not allowed"))
    assert text.isprintable() and len(text) <= 1000 + 10
    assert text.startswith("a.toml: name: ") and text.endswith(" is not allowed")


def test_a_source_is_given_to_errors_without_one() -> None:
    with pytest.raises(InputError, match="b: key: problem"), name_source("b"):
        raise InputError("", "key", "problem")
    with pytest.raises(InputError, match="a: key: problem"), name_source("b"):
        raise InputError("a", "key", "problem")


PENTAGRAM = [[math.cos(a), math.sin(a)] for a in 2 * np.pi * np.arange(5) * 2 / 5]


def regular(count: int, radius: float) -> Array:
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def triangulate(corners: Array) -> tuple[float, Array, float]:
    """Area, centroid and polar second moment about it, by midside quadrature on triangles."""
    # The rule is exact for quadratics, and the second moment is one.
    area, first, points, weights = 0.0, np.zeros(2), [], []
    for one, two in pairwise(corners[1:]):
        triangle = np.array([corners[0], one, two])
        size = float(cross(one - corners[0], two - corners[0])) / 2
        area += size
        first += size * triangle.mean(axis=0)
        points.append((triangle + np.roll(triangle, -1, axis=0)) / 2)
        weights.append(np.full(3, size / 3))
    centroid = first / area
    arms = np.concatenate(points) - centroid
    return area, centroid, float(np.concatenate(weights) @ (arms**2).sum(axis=1))


@each("seed", range(6))
def test_centroid_and_inertia_equal_quadrature(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = convex_polygon(rng, 3 + seed)
    area, centroid, second = triangulate(corners)
    polygon = Polygon(corners, 0.7)
    np.testing.assert_allclose(polygon.centroid, centroid, atol=1e-13)
    assert polygon.inertia == pytest.approx(0.7 * second / area, rel=1e-11)
    assert polygon.gyration_radius == pytest.approx(math.sqrt(second / area), rel=1e-11)
    np.testing.assert_allclose(polygon.vertices, corners - centroid, atol=1e-13)


def test_arrays_are_read_only_copies() -> None:
    corners = np.array(SQUARE)
    polygon = Polygon(corners, 1.0)
    corners[0] = 9.0
    assert np.asarray(polygon.points)[0, 0] == pytest.approx(SQUARE[0][0])
    with pytest.raises(ValueError, match="read-only"):
        polygon.vertices[0, 0] = 0.0


@each(
    "points, key, text",
    [
        (SQUARE[::-1], "object.vertices", "clockwise"),
        ([[0, 0], [1, 0], [2, 0]], "object.vertices", "flat"),
        ([[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]], "object.vertices[4]", "convex"),
        ([[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]], "object.vertices[2]", "convex"),
        ([[0, 0], [1, 0], [1, 0], [1, 1]], "object.vertices[2]", "convex"),
        ([[0, 0], [0, 0], [1, 0], [1, 1]], "object.vertices[1]", "convex"),
        (PENTAGRAM, "object.vertices", "crosses itself"),
        ([[0, 0], [1, 0]], "object.vertices", "2 corners given"),
        ("square", "object.vertices", "3 or more"),
        ([[0, 0], [1, 0], [1, math.nan]], "object.vertices[3]", "finite"),
        ([[0, 0], [1, 0], [1, "1"]], "object.vertices[3]", "'1'"),
        ([[0, 0], [1, 0], [1, 1, 1]], "object.vertices[3]", "2 numbers"),
        ([[0, 0], 7, [1, 1]], "object.vertices[2]", "2 numbers"),
    ],
)
def test_bad_polygon_names_the_corner(points: Any, key: str, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        Polygon(points, 1.0)
    assert caught.value.key == key


def test_size_and_inertia_of_points_in_lists() -> None:
    polygon = Polygon([[0, 0], [3, 0], [3, 4], [0, 4]], 2, 1.0)
    known = polygon.mass, polygon.inertia, polygon.n_vertices, polygon.size
    assert known == pytest.approx((2.0, 1.0, 4, 5.0), rel=1e-13)
    assert polygon.uniform_inertia == pytest.approx(2.0 * 25 / 12, rel=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_far_from_the_origin_only_the_corners_lose_digits(seed: int) -> None:
    corners = convex_polygon(np.random.default_rng(seed), 7)
    size = Polygon(corners, 1.0).size
    away = Polygon(corners + np.array([700.0, -300.0]) * size, 1.0)
    here = Polygon(away.points - np.asarray(away.points)[0], 1.0)
    np.testing.assert_allclose(away.vertices, here.vertices, rtol=0, atol=1e-12 * size)


@each(
    "points, text",
    [
        (1e-5 * np.array(SQUARE) / np.abs(SQUARE).max(), "allowed are 0.0001 to 1000 m"),
        (2e3 * np.array(SQUARE) / np.abs(SQUARE).max(), "allowed are 0.0001 to 1000 m"),
        ([[1e300, 0], [0, 1e300], [-1e300, 0]], "allowed are coordinates up to 1e"),
        ([[1000, 0], [1000.1, 0], [1000, 0.1]], "m from the origin; allowed are 141 m"),
        ([[0, 0], [1, 0], [0.5, 9e-4]], "is 0.0009 m wide; allowed are 0.001 m and more"),
        ([[0, 0], [1, 0], [1, 1], [9e-5, 1], [0, 1 - 5e-5]], "0.000103 m; allowed are 0.000141 m"),
        (regular(501, 1.0), "501 corners given; allowed are 3 to 500"),
    ],
)
def test_polygons_beyond_all_reason(points: Any, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        Polygon(points, 1.0)
    assert caught.value.key.startswith("object.vertices")


def edited(**changes: float) -> Problem:
    """The first phase of the heptagon with other numbers."""
    return build_problem(tomllib.loads(text_of())).with_(changes)


EXTREME = [{"viscous": 16.0}, {"speed_limit": 0.1}, {"torque_limit": 350.0}]
EXTREME += [{"finger_inertia": 1e-9, "viscous": 0.0}, {"gravity": 100.0, "torque_limit": 20.0}]


@pytest.mark.parametrize("joints", EXTREME, ids=str)
def test_extreme_scenes_are_planned(joints: dict[str, Any]) -> None:
    problem = edited(**joints)
    # Links a thousand times as heavy let other contact forces be possible than the planned ones.
    plan = solve(problem, intervals=20, replay=False, uniqueness_margin=-5.0)
    report = verify(problem, plan, uniqueness_margin=-5.0)
    assert report.ok, report.failures


def test_strong_drag_bounds_the_speed() -> None:
    """Ten times the drag takes ten times as long: inertia does not matter any more."""
    slow, slower = (solve(edited(viscous=drag), replay=False).value for drag in (2.3, 23.0))
    assert slower / slow == pytest.approx(10.0, rel=1e-2)


@pytest.mark.usefixtures("unadvised")
def test_dry_friction_above_the_torque_limit_is_named() -> None:
    with pytest.raises(InfeasibleError, match=r"torque limit of finger \d = 2 N m is .* short"):
        solve(edited(dry=3.0), intervals=10)


def test_friction_is_advised_where_it_is_the_cause(request: pytest.FixtureRequest) -> None:
    """Each advised value does, and one halfway back to what is given does not."""
    rough = dict.fromkeys(("friction_palm", "friction_finger1", "friction_finger2"), 0.35)
    with pytest.raises(InfeasibleError, match="feasible with friction of palm = ") as caught:
        solve(edited(**rough), intervals=10)
    advised = re.findall(r"friction of (\w+)( \d)? = ([\d.]+) instead of 0.35", str(caught.value))
    assert advised
    request.getfixturevalue("unadvised")
    for part, number, value in advised:
        key = f"friction_{part}{number.strip()}"
        solve(edited(**rough | {key: float(value)}), intervals=10, replay=False)
        with pytest.raises(InfeasibleError):
            solve(edited(**rough | {key: (float(value) + 0.35) / 2}), intervals=10)


def test_jamming_says_which_friction_to_lower() -> None:
    rough = {"friction_palm": 3.0, "friction_finger1": 0.3, "friction_finger2": 0.3}
    with pytest.raises(JammingError, match=r"jams at .*; feasible with friction of palm = ") as jam:
        solve(edited(**rough), intervals=10)
    found = re.search(r"friction of palm = ([\d.]+) instead of 3", str(jam.value))
    assert found is not None
    (change,) = jam.value.changes
    assert change.parameter.key == "friction.palm" and str(change) in str(jam.value)
    solve(edited(**rough | {"friction_palm": float(found[1])}), intervals=10, replay=False)


CASES = [(IMPACTS, 2), (BOX, 1)]
"""Problems, and how many of their phases are planned, the last of them to rest."""
OPTIONS: dict[str, Any] = {"intervals": 10, "replay": False}
TELLINGS = [("time", telling) for telling in (RETELLINGS[1], *RETELLINGS[3:])]
TELLINGS += [("effort", RETELLINGS[4]), ("margin", RETELLINGS[1])]
"""Of other costs, the effort mirrored, which swaps the torques, and the margin in small units."""


@pytest.fixture(scope="module", params=CASES, ids=[case[0].stem for case in CASES])
def problem(request: pytest.FixtureRequest) -> Problem:
    table = tomllib.loads(text_of(*request.param))
    table["phases"][-1]["end"] = "rest"
    return build_problem(table)


@pytest.fixture(scope="module")
def answers(problem: Problem) -> dict[str, Answer]:
    goals, same = ("time", "effort", "margin"), Retelling("the same")
    return {goal: answer(problem, goal, same, **OPTIONS) for goal in goals}


@pytest.mark.parametrize("objective, telling", TELLINGS, ids=lambda p: getattr(p, "name", p))
def test_answers_do_not_depend_on_how_a_problem_is_told(
    problem: Problem, answers: dict[str, Answer], telling: Retelling, objective: str
) -> None:
    one = answers[objective]
    other = answer(problem, objective, telling, **OPTIONS)
    assert other.value == pytest.approx(one.value, rel=1e-8)
    np.testing.assert_allclose(other.breaks, one.breaks, rtol=0, atol=1e-7)
    np.testing.assert_allclose(other.torques, one.torques, rtol=0, atol=1e-7)


@each("telling", RETELLINGS)
def test_a_retelling_changes_what_it_says(problem: Problem, telling: Retelling) -> None:
    """Configurations at the ends of phases are those of the first telling, in other words."""
    other, length = build_problem(telling.apply(problem).table), telling.units.length
    for one, same in zip(trace_phases(problem), trace_phases(other), strict=True):
        z = telling.tell(np.append(one.end, np.zeros(5)))[:5]
        turns = (same.end - z) / (2 * np.pi) * [0, 0, 0, 1, 1]
        np.testing.assert_allclose(same.end - 2 * np.pi * np.round(turns), z, atol=1e-11 * length)
        assert same.length == pytest.approx(length * one.length, rel=1e-11)
