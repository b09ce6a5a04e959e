"""The JSON Schema of problem files, and changes of their keys."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shipped import BOX, FOLDER, HEPTAGON
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.geometry.path_guess import load
from wholearm.problem.definition import End, Problem
from wholearm.problem.keys import TOP, build_schema, write_page
from wholearm.problem.read import build_problem, read_problem
from wholearm.problem.table import describe_scene
from wholearm.scene.model import Friction

jsonschema = pytest.importorskip("jsonschema")
SCHEMA = build_schema()
TABLE = tomllib.loads(HEPTAGON.read_text(encoding="utf-8")) | {"uncertainty": {"mass": 0.1}}
PARTS = SCHEMA["properties"]
TABLES: dict[str, tuple[dict[str, Any], Callable[[Any], Any]]] = {
    "": (SCHEMA, lambda table: table),
    "object": (PARTS["object"], lambda table: table["object"]),
    "fingers": (PARTS["fingers"], lambda table: table["fingers"]),
    "fingers.1": (SCHEMA["definitions"]["finger"], lambda table: table["fingers"]["1"]),
    "friction": (PARTS["friction"], lambda table: table["friction"]),
    "uncertainty": (PARTS["uncertainty"], lambda table: table["uncertainty"]),
    "start": (PARTS["start"], lambda table: table["start"]),
    "phases[1]": (PARTS["phases"]["items"], lambda table: table["phases"][0]),
}


@pytest.mark.parametrize("where", TABLES)
def test_keys_are_those_that_the_reader_allows(where: str) -> None:
    part, find = TABLES[where]
    table = copy.deepcopy(TABLE)
    find(table)["surely_unknown"] = 1
    with pytest.raises(InputError, match="unknown key") as caught:
        build_problem(table)
    (allowed,) = re.findall(r"allowed are (.*)", str(caught.value))
    assert sorted(part["properties"]) == allowed.split(", ")
    # Each key that is left out is missed if the schema requires it, and only then.
    for key in part["properties"]:
        table = copy.deepcopy(TABLE)
        find(table).pop(key, None)
        # Only a phase with a smooth end may lack `until`; this one ends at rest.
        if key in part["required"] or key == "until":
            with pytest.raises(jsonschema.ValidationError):
                jsonschema.validate(table, SCHEMA)
            with pytest.raises(InputError, match="is missing"):
                build_problem(table)
        else:
            build_problem(table)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_problems_are_valid(path: Path) -> None:
    jsonschema.validate(tomllib.loads(path.read_text(encoding="utf-8")), SCHEMA)


@pytest.mark.parametrize(
    ("where", "key", "value"),
    [
        ("", "epsilon", -1.0),
        ("", "surely_unknown", 1),
        ("object", "vertices", [[0.0, 0.0], [1.0, 0.0]]),
        ("fingers.1", "length", "long"),
        ("friction", "palm", 11.0),
        ("uncertainty", "gain", 1.0),
        ("start", "flush", 0.5),
        ("phases[1]", "end", "soft"),
        ("phases[1]", "until", {"y": 1.0}),
        ("phases[1]", "contacts", ["v0-wall"]),
    ],
)
def test_what_the_schema_refuses_the_reader_refuses(where: str, key: str, value: object) -> None:
    table = copy.deepcopy(TABLE)
    TABLES[where][1](table)[key] = value
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(table, SCHEMA)
    with pytest.raises(InputError):
        build_problem(table)


def test_the_command_prints_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMA
    assert main(["schema", "-o", str(tmp_path / "schema.json")]) == 0
    assert json.loads((tmp_path / "schema.json").read_text(encoding="utf-8")) == SCHEMA
    capsys.readouterr()
    assert main(["schema", "--table"]) == 0
    assert capsys.readouterr().out == write_page()
    assert all(f"| `{key}` |" in write_page() for key, own in TOP.items() if own.text)


PROBLEMS = sorted(HEPTAGON.parent.glob("*.toml"))


@pytest.fixture
def heptagon() -> Problem:
    """Read anew, so that nothing is kept for its scene."""
    return load(str(HEPTAGON))


def check_scene(problem: Problem) -> None:
    assert all(phase.formation.scene is problem.scene for phase in problem.phases)


def check_table(problem: Problem) -> None:
    """The table alone makes the same problem."""
    again = build_problem(json.loads(json.dumps(dict(problem.table))), problem.source)
    assert describe_scene(again.scene) == describe_scene(problem.scene)
    assert (again.name, again.epsilon) == (problem.name, problem.epsilon)
    np.testing.assert_allclose(again.start, problem.start, rtol=1e-12, atol=1e-14)
    assert len(again.phases) == len(problem.phases)
    for own, other in zip(problem.phases, again.phases, strict=True):
        assert own.formation.contacts == other.formation.contacts
        assert own.formation.rolling == other.formation.rolling
        assert own.end == other.end and own.until.contact == other.until.contact
        assert (own.until.value or 0.0) == pytest.approx(other.until.value or 0.0, rel=1e-14)


@pytest.mark.parametrize("path", PROBLEMS, ids=lambda path: path.stem)
def test_a_problem_as_read_keeps_its_table(path: Path) -> None:
    problem = read_problem(str(path))
    assert replace(problem).table is problem.table
    check_table(problem)
    check_table(problem.with_())


def test_another_scene_is_the_scene_of_every_phase(heptagon: Problem) -> None:
    rough = replace(heptagon.scene, friction=Friction(0.2, 0.15, 0.12))
    other = replace(heptagon, scene=rough, epsilon=0.06)
    check_scene(other)
    check_table(other)
    assert other.phases[0].formation.friction == pytest.approx([0.2, 0.2, 0.15, 0.12])
    assert heptagon.phases[0].formation.friction == pytest.approx([0.1] * 4)
    assert other.table["friction"] == pytest.approx({"palm": 0.2, "finger1": 0.15, "finger2": 0.12})
    assert heptagon.table["friction"]["palm"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("changes", "key", "expected"),
    [
        ({"name": "other"}, "name", "other"),
        ({"epsilon": 0.01}, "epsilon", 0.01),
        ({"gravity": 1.62}, "gravity", 1.62),
        ({"fingers_collide": False}, "fingers_collide", False),
        ({"mass": np.float64(0.3)}, "object.mass", 0.3),
        ({"inertia": 2e-4}, "object.inertia", 2e-4),
        ({"friction_finger1": 0.3}, "friction.finger1", 0.3),
        ({"torque_limit1": 3}, "fingers.1.torque_limit", 3.0),
        ({"finger_inertia2": 0.01}, "fingers.2.inertia", 0.01),
        ({"base1": (0.081, -0.01)}, "fingers.1.base", [0.081, -0.01]),
        ({"speed_limit": 5.0}, "fingers.2.speed_limit", 5.0),
        ({"viscous": 0.02}, "fingers.1.viscous", 0.02),
        ({"fingers.2.dry": 0.03}, "fingers.2.dry", 0.03),
    ],
)
def test_names_change_what_they_say(
    heptagon: Problem, changes: dict[str, Any], key: str, expected: object
) -> None:
    other = heptagon.with_(changes)
    values = {"name": other.name, "epsilon": other.epsilon} | describe_scene(other.scene)
    number = not isinstance(expected, str | bool)
    assert values[key] == (pytest.approx(expected) if number else expected)
    check_scene(other)
    check_table(other)
    assert other.source == heptagon.source


def test_another_shape_closes_the_fingers_anew(heptagon: Problem) -> None:
    small = 0.99 * np.asarray(heptagon.scene.polygon.vertices)
    other = heptagon.with_(vertices=small)
    assert not np.allclose(other.start[3:], heptagon.start[3:], atol=1e-4)
    gaps = other.phases[0].formation.evaluate(other.start[None], np.zeros((1, 5))).C
    np.testing.assert_allclose(gaps, 0.0, atol=1e-12)
    check_table(other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"fricton": 0.2},
            "fricton: unknown name; did you mean 'friction'? allowed are actuator_lag, ",
        ),
        ({"friction": -1}, "friction.palm: -1 is not a number >= 0"),
        ({"mass": "a"}, "object.mass: 'a' is not a positive number"),
        ({"torque_limit": None}, "fingers.1.torque_limit: is missing"),
        ({"friction": {"palm": 0.1}}, "friction.finger1: is missing"),
        ({"object.masss": 1}, "object.masss: unknown key; did you mean 'mass'?"),
        ({"fingers.3.base": [0, 0]}, "fingers.3.base: there is no '3'; what is there: 1, 2"),
        ({"phases[9].end": "rest"}, "phases[9].end: there is no number 9; the list has 5"),
        ({"phases[9]": {}}, "phases[9]: there is no number 9; the list has 5"),
        ({"epsilon.much": 1}, "epsilon.much: 0.05 is not a table"),
        ({"phases[1].until": "v9-palm"}, "phases[1].until: 'v9-palm' does not exist"),
        ({"x": 9.0}, "start: finger 1 is too short to reach the object"),
        ({"": 1}, "unknown name; allowed are "),
    ],
)
def test_what_a_file_may_not_say_no_change_may(
    heptagon: Problem, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        heptagon.with_(changes)
    assert str(caught.value).startswith(f"{HEPTAGON}: {message}")


def test_a_problem_without_a_table_cannot_be_changed_by_name(heptagon: Problem) -> None:
    bare = replace(heptagon, table={})
    assert replace(bare, epsilon=0.1).table == {}
    with pytest.raises(InputError, match="has no table"):
        bare.with_(epsilon=0.1)


def test_other_phases_and_another_start_are_in_the_table(heptagon: Problem) -> None:
    check_table(replace(heptagon, phases=heptagon.phases[:2]))
    box = read_problem(str(BOX))
    last = replace(box.phases[-1], end=End.REST)
    short = replace(box, phases=(*box.phases[:-1], last))
    check_table(short)
    smooth = [replace(phase, end=End.SMOOTH) for phase in heptagon.phases[:-1]]
    passing = replace(heptagon, phases=(*smooth, heptagon.phases[-1]))
    assert [entry.get("end") for entry in passing.table["phases"]] == ["smooth"] * 4 + [None]
    moved = heptagon.with_(x=0.04)
    check_table(replace(heptagon, start=moved.start))
    tilted = heptagon.start + 0.1 * np.eye(5)[2]
    assert replace(heptagon, start=tilted).table == {}
