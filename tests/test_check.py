"""Problems made of objects are checked like those read from a file."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import wholearm
from shipped import BOX, FOLDER, HEPTAGON, problem_of
from wholearm.common.errors import InputError
from wholearm.problem.definition import End, Problem, Until
from wholearm.problem.read import build_problem

FILES = sorted(FOLDER.glob("*.toml"))


def rebuild(problem: Problem, **changes: Any) -> Problem:
    """The problem made anew of its objects, with some of them changed."""
    names = ("name", "scene", "epsilon", "start", "phases")
    return Problem(**{name: getattr(problem, name) for name in names} | changes)


def refusal_of_file(problem: Problem, change: dict[str, Any]) -> str:
    with pytest.raises(InputError) as caught:
        problem.with_(change)
    return str(InputError("", caught.value.key, caught.value.problem))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_problem_of_objects_has_the_table_of_its_file(path: Any) -> None:
    given = problem_of(path)
    made = rebuild(given)
    assert made.table and made.source == ""
    again = build_problem(made.table)
    np.testing.assert_allclose(again.start, given.start, rtol=0, atol=1e-12)
    assert again.scene.friction == given.scene.friction
    for one, other in zip(again.phases, given.phases, strict=True):
        assert one.formation.names == other.formation.names
        assert one.formation.rolling == other.formation.rolling
        assert (str(one.until), one.end) == (str(other.until), other.end)


def test_a_problem_is_built_from_nothing() -> None:
    """The README's example."""
    link: dict[str, Any] = {
        "length": 0.11,
        "radius": 0.0,
        "inertia": 1e-4,
        "viscous": 0.0,
        "dry": 0.0,
    }
    scene = wholearm.Scene(
        wholearm.Polygon([[-0.03, 0.0], [0.03, 0.0], [0.03, 0.06], [-0.03, 0.06]], mass=0.2),
        (
            wholearm.Finger(base=(0.1, -0.01), torque_limit=2.0, **link),
            wholearm.Finger(base=(-0.1, -0.01), torque_limit=2.0, **link),
        ),
        wholearm.Friction(0.1, 0.1, 0.1),
    )
    start = wholearm.place_start(scene, flush=0, x=0.0)
    slide = wholearm.Phase(
        0,
        wholearm.read_formation(scene, ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"]),
        wholearm.read_until(scene, {"x": -0.01}),
    )
    problem = wholearm.Problem("box", scene, 0.05, start, (slide,))
    assert [finger.name for finger in problem.scene.fingers] == ["fingers.1", "fingers.2"]
    plan = wholearm.solve(problem, intervals=10)
    assert wholearm.verify(problem, plan).ok
    assert plan.meta["problem"]["start"] == {"flush": 0, "x": 0.0}


@pytest.mark.parametrize(
    ("objects", "file"),
    [
        ({"epsilon": -0.1}, {"epsilon": -0.1}),
        ({"epsilon": 1e9}, {"epsilon": 1e9}),
        ({"name": 3}, {"name": 3}),
        ({"mass": 1e9}, {"mass": 1e9}),
        ({"viscous": 1e6}, {"viscous1": 1e6}),
        ({"until": Until(coordinate="x", value=1e6)}, {"phases[1].until": {"x": 1e6}}),
        (
            {"until": Until(coordinate="phi", value=1e3)},
            {"phases[1].until": {"phi_deg": float(np.degrees(1e3))}},
        ),
        ({"until": "first"}, {"phases[1].until": "v0-palm"}),
        ({"until": Until()}, {"phases[1].until": None}),
        ({"end": End.IMPACT}, {"phases[5].end": "impact"}),
        ({"contacts": "twice"}, {"phases[1].contacts": ["v0-palm", "v0-palm"]}),
        ({"contacts": "other"}, {"phases[1].contacts": ["v3-palm"]}),
    ],
    ids=str,
)
def test_wrong_values_have_the_messages_of_files(
    objects: dict[str, Any], file: dict[str, Any]
) -> None:
    given = problem_of(HEPTAGON)
    ((key, value),) = objects.items()
    scene, phases = given.scene, list(given.phases)
    first = phases[0]
    if value == "first":
        value = Until(contact=first.formation.contacts[0])
    with pytest.raises(InputError) as caught:
        if key == "mass":
            body = wholearm.Polygon(scene.polygon.points, value)
            rebuild(given, scene=replace(scene, polygon=body))
        elif key == "viscous":
            right, left = scene.fingers
            rebuild(given, scene=replace(scene, fingers=(replace(right, viscous=value), left)))
        elif key == "contacts":
            own = first.formation.contacts[0]
            chosen = (own, own) if value == "twice" else (replace(own, index=3),)
            formation = replace(first.formation, contacts=chosen)
            rebuild(given, phases=(replace(first, formation=formation), *phases[1:]))
        elif key == "until":
            rebuild(given, phases=(replace(first, until=value), *phases[1:]))
        elif key == "end":
            rebuild(given, phases=(*phases[:-1], replace(phases[-1], end=value)))
        else:
            rebuild(given, **objects)
    assert str(caught.value) == refusal_of_file(given, file)


def test_what_only_objects_can_say_wrongly() -> None:
    given = problem_of(BOX)
    first = given.phases[0]
    for changes, text in (
        ({"start": given.start[:4]}, "start: .* is not a list of 5 numbers"),
        ({"phases": given.phases[1:]}, r"phases\[1\]: has the index 1; .* makes it 0"),
        (
            {"phases": (replace(first, until=Until(coordinate="y", value=0.1)),)},
            r"phases\[1\].until: 'y' given; allowed are 'x' and 'phi'",
        ),
    ):
        with pytest.raises(InputError, match=text):
            rebuild(given, **changes)


def test_a_start_that_no_file_can_say_leaves_the_table_empty() -> None:
    from wholearm.geometry.tracing import trace_phases

    given = problem_of(HEPTAGON)
    start = trace_phases(given)[3].end
    made = rebuild(given, start=start, phases=(replace(given.phases[4], index=0),))
    assert made.table == {} and copy.deepcopy(made).table == {}
