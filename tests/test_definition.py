"""Problem files are read and written; problems made of objects are checked like those."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from shipped import BOX, FOLDER, HEPTAGON, problem_of
from wholearm.common.errors import InputError
from wholearm.geometry.path_guess import load
from wholearm.problem.definition import End, Problem, Until
from wholearm.problem.read import build_problem, read_problem
from wholearm.problem.table import format_until, write_table
from wholearm.results.adopt import save
from wholearm.scene.model import find_unit_hint

TEXT = HEPTAGON.read_text(encoding="utf-8")
Edit = Callable[[dict[str, Any]], object]


def read_edited(edit: Edit) -> Problem:
    table = tomllib.loads(TEXT)
    edit(table)
    return build_problem(table)


def put(path: str, value: object) -> Edit:
    """An edit that sets a dotted key; numbers index lists."""

    def edit(table: Any) -> None:
        *parents, last = path.split(".")
        for key in parents:
            table = table[int(key)] if isinstance(table, list) else table[key]
        table[int(last) if isinstance(table, list) else last] = value

    return edit


def drop(path: str) -> Edit:
    def edit(table: Any) -> None:
        *parents, last = path.split(".")
        for key in parents:
            table = table[int(key)] if isinstance(table, list) else table[key]
        del table[int(last) if isinstance(table, list) else last]

    return edit


def test_heptagon_is_read() -> None:
    problem = read_problem(str(HEPTAGON))
    scene = problem.scene
    assert (problem.name, problem.epsilon) == ("heptagon, four contacts", 0.05)
    assert problem.source == str(HEPTAGON)
    numbers = (scene.polygon.mass, scene.gravity, scene.polygon.n_vertices)
    assert numbers == pytest.approx((0.2, 9.81, 7))
    assert np.asarray(scene.fingers[0].base) == pytest.approx([0.08, -0.01])
    assert np.asarray(scene.fingers[1].base) == pytest.approx([-0.08, -0.01])
    assert [phase.number for phase in problem.phases] == [1, 2, 3, 4, 5]
    assert problem.phases[2].formation.names == ("v0-palm", "v1-palm", "v3-finger1", "v6-finger2")
    until = [str(phase.until) for phase in problem.phases]
    assert until == ["v3-finger1", "v6-finger2", "v0-finger2", "v4-finger1", "phi = -50 deg"]
    assert problem.phases[4].until.value == pytest.approx(math.radians(-50))
    names = "v0-palm v1-palm v2-finger1 v5-finger2 v3-finger1 v6-finger2 v0-finger2 v4-finger1"
    assert " ".join(contact.name for contact in problem.contacts) == names


def test_defaults() -> None:
    def edit(table: dict[str, Any]) -> None:
        del table["name"], table["gravity"]
        for key in ("viscous", "dry"):
            del table["fingers"]["1"][key]

    problem = read_edited(edit)
    finger = problem.scene.fingers[0]
    assert problem.name == "unnamed" and problem.scene.gravity == pytest.approx(9.81)
    assert (finger.viscous, finger.dry, finger.speed_limit) == (0.0, 0.0, math.inf)
    assert problem.scene.speed_limit.tolist() == [math.inf, math.inf]


@pytest.mark.parametrize(
    "given, text",
    [
        ({"contact": "v2-palm", "x": -0.022}, "v2-palm at x = -0.022 m"),
        ({"contact": "v2-palm", "phi_deg": -61.9}, "v2-palm at phi = -61.9 deg"),
        ({"phi_deg": -40.0, "x": 0.01}, "phi = -40 deg, x = 0.01 m"),
        ({"x": 0.01, "phi_deg": -40.0}, "x = 0.01 m, phi = -40 deg"),
    ],
)
def test_both_freedoms_of_a_cell_may_be_given(given: dict[str, Any], text: str) -> None:
    phase = {"contacts": ["v1-palm", "v3-finger1", "v0-finger2"], "until": given}
    problem = read_edited(put("phases.3", phase))
    assert str(problem.phases[3].until) == text
    assert problem.table["phases"][3] == phase
    # What is written of the phase alone reads as the same.
    written = write_table(dataclasses.replace(problem, table={}))["phases"][3]
    assert list(written["until"]) == list(given)
    again = read_edited(put("phases.3", written)).phases[3].until
    assert again == problem.phases[3].until
    assert tomllib.loads(f"until = {format_until(again)}")["until"] == pytest.approx(given)


def test_a_problem_for_a_map_needs_no_phases() -> None:
    problem = read_edited(drop("phases"))
    assert problem.phases == () and repr(problem).endswith("0 phases)")
    assert problem.with_(mass=0.3).phases == ()
    with pytest.raises(InputError, match=r"phases: is missing, .* `wholearm map"):
        wholearm.solve(problem)
    torques = wholearm.TorqueProfile(np.array([0.0, 1.0]), np.zeros((1, 2, 1)))
    with pytest.raises(InputError, match="phases: is missing"):
        wholearm.simulate(problem, torques)


def test_a_contact_slides_unless_it_is_said_to_roll() -> None:
    problem = read_edited(put("phases.3.contacts", ["v1-palm rolling", "v0-finger2", "v3-finger1"]))
    phase, before = problem.phases[3].formation, problem.phases[0].formation
    assert [contact.name for contact in phase.rolling] == ["v1-palm"]
    assert phase.rolling[0] == before.contacts[1] and before.rolling == ()
    assert phase.names == ("v1-palm", "v0-finger2", "v3-finger1")
    assert [c.name for c in problem.contacts].count("v1-palm") == 1


def test_a_contact_without_friction_cannot_roll() -> None:
    def edit(table: dict[str, Any]) -> None:
        table["friction"]["finger2"] = 0.0
        table["phases"][3]["contacts"] = ["v1-palm", "v0-finger2 rolling", "v3-finger1"]

    with pytest.raises(InputError, match=r"v0-finger2 cannot roll .* friction\.finger2 is 0"):
        read_edited(edit)


ALLOWED_UNTIL = "allowed are a contact name"
THREE = {
    "contacts": ["v1-palm", "v3-finger1", "v0-finger2"],
    "until": {"contact": "v2-palm", "x": 0.0, "phi_deg": 0.0},
}


@pytest.mark.parametrize(
    "edit, key, text",
    [
        (put("epsilonn", 1), "epsilonn", "did you mean 'epsilon'"),
        (put("zzz", 1), "zzz", "epsilon, fingers, fingers_collide"),
        (put("fingers.1.torque_limits", 1), "fingers.1.torque_limits", "'torque_limit'"),
        (put("fingers.3", {}), "fingers.3", "allowed are 1, 2"),
        (put("friction.finger_1", 0), "friction.finger_1", "'finger1'"),
        (put("start.phi", 0), "start.phi", "allowed are flush, x"),
        (put("phases.1.contact", []), "phases[2].contact", "did you mean 'contacts'"),
        (drop("epsilon"), "epsilon", "is missing"),
        (put("phases", 3), "phases", "3 is not a list of [[phases]]"),
        (drop("object.mass"), "object.mass", "is missing"),
        (drop("fingers.2.length"), "fingers.2.length", "is missing"),
        (drop("start.x"), "start.x", "is missing"),
        (drop("phases.3.until"), "phases[4].until", "is missing"),
        (put("name", 3), "name", "not a string"),
        (put("epsilon", -0.1), "epsilon", ">= 0"),
        (put("epsilon", True), "epsilon", "True"),
        (put("fingers_collide", 0), "fingers_collide", "0 given; allowed are true and false"),
        (put("object", 3), "object", "not a table"),
        (put("object.mass", -0.2), "object.mass", "positive"),
        (put("object.inertia", 0), "object.inertia", "positive"),
        (put("object.vertices", [[0, 0], [0, 1], [1, 0]]), "object.vertices", "clockwise"),
        (put("fingers.1", []), "fingers.1", "not a table"),
        (put("fingers.2.base", [1]), "fingers.2.base", "2 numbers"),
        (put("fingers.2.base", [0.09, 0]), "fingers.1.base", "not to the right"),
        (put("fingers.2.speed_limit", -1), "fingers.2.speed_limit", "positive"),
        (put("start", 0), "start", "not a table"),
        (put("start.flush", 7), "start.flush", "0 to 6"),
        (put("start.flush", 0.0), "start.flush", "0 to 6"),
        (put("start.x", "left"), "start.x", "'left'"),
        (put("start.x", 9.0), "start", "finger 1 is too short"),
        (put("fingers.2.base", [0.03, 0.02]), "fingers.2.base", "inside the object"),
        (put("phases.0", 3), "phases[1]", "not a table"),
        (put("phases.0.contacts", []), "phases[1].contacts", "contact names"),
        (put("phases.2.contacts.1", "v7-palm"), "phases[3].contacts", "0 to 6"),
        (put("phases.2.contacts.1", "thumb"), "phases[3].contacts", "'thumb' is not a contact"),
        (put("phases.2.contacts.1", 5), "phases[3].contacts", "5 is not a contact"),
        (put("phases.2.contacts.1", "v0-palm"), "phases[3].contacts", "v0-palm is given twice"),
        (put("phases.0.contacts.2", "v4-finger1"), "phases[1].contacts", "fingers touch"),
        (put("start.x", 0.0), "phases[1].contacts", "v3-finger1 v5-finger2"),
        (put("phases.0.contacts.1", "v1-palm rolling"), "phases[1].contacts", "makes 5"),
        (put("phases.0.contacts.1", "v1-palm rolls"), "phases[1].contacts", "' rolling' may"),
        (put("phases.0.contacts.1", "v0-palm rolling"), "phases[1].contacts", "given twice"),
        (put("phases.3.until", "v0-palm rolling"), "phases[4].until", "not a contact"),
        (put("phases.3.until", "v0-palmm"), "phases[4].until", "not a contact"),
        (put("phases.3.until", "v1-palm"), "phases[4].until", "already"),
        (put("phases.3.until", {"phi": 1}), "phases[4].until", ALLOWED_UNTIL),
        (put("phases.3.until", {"x": 1, "phi": 1}), "phases[4].until", ALLOWED_UNTIL),
        (put("phases.3.until", {"contact": 3}), "phases[4].until", "3 is not a contact"),
        (put("phases.3.until", {"contact": "v4-finger1", "x": 99.0}), "phases[4].until", "99"),
        (put("phases.3", THREE), "phases[4].until", "gives 3 conditions; allowed are 2"),
        (put("phases.3.until", {"x": math.nan}), "phases[4].until", "finite"),
        (put("phases.3.until", {"phi_deg": "1"}), "phases[4].until", "'1'"),
    ],
)
def test_bad_input_names_the_key(edit: Edit, key: str, text: str) -> None:
    with pytest.raises(InputError) as caught:
        read_edited(edit)
    assert caught.value.key == key
    assert text in caught.value.problem


def test_ends_are_read() -> None:
    def edit(table: dict[str, Any]) -> None:
        table["phases"][0]["end"], table["phases"][1]["end"] = "impact", "rest"

    ends = [phase.end for phase in read_edited(edit).phases]
    assert ends == [End.IMPACT, *4 * [End.REST]]


@pytest.mark.parametrize(
    "index, until, end, key, text",
    [
        (0, "v3-finger1", "bang", "end", "'bang' given; allowed are 'rest', 'smooth', 'impact'"),
        (4, {"phi_deg": -50.0}, "impact", "end", "'impact' given, but the last phase ends at rest"),
        (4, {"phi_deg": -50.0}, "smooth", "end", "'smooth' given, but the last phase ends at rest"),
        (0, {"x": 0.02}, "impact", "end", "but until is x = 0.02 m, not a contact that is gained"),
        (0, "v3-palm", "impact", "end", "but phase 2 does not have v3-palm"),
        (2, "v3-palm", "smooth", "end", "'smooth' given, but phase 4 has v0-finger2 too"),
        (0, None, "impact", "until", "is missing; only a phase with end = 'smooth' has none"),
    ],
)
def test_bad_ends_name_the_key(index: int, until: object, end: str, key: str, text: str) -> None:
    def edit(table: dict[str, Any]) -> None:
        table["phases"][index] |= {"until": until, "end": end}
        if until is None:
            del table["phases"][index]["until"]

    with pytest.raises(InputError) as caught:
        read_edited(edit)
    assert caught.value.key == f"phases[{index + 1}].{key}"
    assert text in caught.value.problem and "\n" not in str(caught.value)


def test_an_impact_adds_only_the_contact_gained() -> None:
    def edit(table: dict[str, Any]) -> None:
        table["phases"][0]["end"] = "impact"
        table["phases"][1]["contacts"] = ["v0-palm", "v4-finger1", "v3-finger1", "v5-finger2"]

    with pytest.raises(InputError, match="'impact' given, but phase 2 has v4-finger1 too"):
        read_edited(edit)


@pytest.mark.parametrize(
    "old, new, key, text",
    [
        ("mass = 0.2", "mass = nan", "object.mass", "finite"),
        ("mass = 0.2", "mas = 0.2", "object.mas", "did you mean 'mass'"),
        ("mass = 0.2", "mass = ", "", "is not TOML"),
        ("mass = 0.2", "mass = 0.2\nmass = 0.3", "", "is not TOML"),
        ('"v5-finger2"]\nuntil', '"v9-finger2"]\nuntil', "phases[1].contacts", "does not exist"),
        (TEXT, "", "epsilon", "is missing"),
        # Those below need the curves.
        ('until = "v6-finger2"', 'until = "v2-palm"', "phases[2].until", "never reached"),
        ('until = "v6-finger2"', "until = { x = -9.0 }", "phases[2].until", "never reached"),
        ("phi_deg = -50.0", "phi_deg = 50.0", "phases[5].until", "phi = 50 deg is never reached"),
        ('until = "v3-finger1"', "until = { x = 0.03 }", "phases[2].contacts", "does not touch"),
        ('["v1-palm", "v3-finger1", "v6-finger2", "v0-finger2"]', '["v1-palm", "v3-finger1"]',
         "phases[5].contacts", "does not touch at the end of phase 4"),
    ],
)  # fmt: skip
def test_bad_file_names_the_file(tmp_path: Path, old: str, new: str, key: str, text: str) -> None:
    path = tmp_path / "bad.toml"
    assert old in TEXT
    path.write_text(TEXT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load(str(path))
    assert (caught.value.source, caught.value.key) == (str(path), key)
    assert text in caught.value.problem
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"\xff\xfe", b"\x00", b"[[[[", b"a = " + b"9" * 5000, b"a = " + b"[" * 20_000]
)
def test_not_toml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"is not TOML|is nested too deeply"):
        read_problem(str(path))


def test_a_hand_that_is_crossed_at_the_start_is_refused() -> None:
    """Long links close over an object in the middle, unless they pass each other."""

    def cross(table: dict[str, Any]) -> None:
        table["start"]["x"] = 0.0
        for finger in table["fingers"].values():
            finger["length"] = 0.3

    with pytest.raises(InputError, match=r"into each other: their gap is -0\.0") as caught:
        read_edited(cross)
    assert caught.value.key == "start.x" and "allowed is 0 or more" in caught.value.problem
    # It is said where the hand would close, and there it does.
    text = caught.value.problem.split("; at that angle the hand closes for x ")[1]
    for own in re.findall(r"-?[\d.]+", text):

        def move(table: dict[str, Any], x: float = float(own)) -> None:
            cross(table)
            table["start"]["x"] = x
            del table["phases"]

        assert read_edited(move).start[0] == float(own)

    def pass_by(table: dict[str, Any]) -> None:
        cross(table)
        table["fingers_collide"] = False
        table["phases"] = table["phases"][1:2]

    assert read_edited(pass_by).start[0] == 0.0


def test_the_first_phase_may_let_go_of_what_touches() -> None:
    def edit(table: dict[str, Any]) -> None:
        table["phases"][0]["contacts"].remove("v0-palm")

    first = read_edited(edit).phases[0].formation
    assert first.names == ("v1-palm", "v2-finger1", "v5-finger2")


@pytest.mark.parametrize(
    "changes",
    [
        {"friction": 0.11, "name": 'a "b" \\ \u00fc', "fingers_collide": False, "inertia": 3e-4},
        {"uncertainty": {"mass": 0.1, "friction": 0.2}, "settle": "10 %", "settle_gap": 1e-4},
        {"phases": None, "goal": [{"flush": 1}, {"phi_deg": -50.0, "x": 0.01}]},
        {"phases[5].until": {"phi_deg": -50.0}, "speed_limit1": 20.0, "control_period": 0.005},
    ],
)
def test_a_problem_that_is_saved_loads_as_the_same(
    changes: dict[str, object], tmp_path: Path
) -> None:
    problem = problem_of(HEPTAGON).with_(changes)
    save(problem, tmp_path / "x.toml")
    loaded = read_problem(str(tmp_path / "x.toml"))
    assert loaded.table == problem.table
    assert loaded.goals == problem.goals and (loaded.start == problem.start).all()


def test_default_ranges_follow_the_size() -> None:
    problem = problem_of(HEPTAGON)
    length = problem.scene.scales.length
    assert problem.ranges["start_x"] == pytest.approx(2e-4, rel=0.2)
    assert problem.ranges["start_x"] / length == pytest.approx(6e-3)
    assert problem.with_(uncertainty={"start_x": 1e-3}).ranges["start_x"] == 1e-3


def test_units_that_look_like_a_mistake_are_named() -> None:
    scene = problem_of(HEPTAGON).scene
    assert find_unit_hint(scene) == ""
    slow = dataclasses.replace(scene, control_period=2.0)
    assert find_unit_hint(slow).startswith("control_period: 2 s is ")
    large = wholearm.Polygon(1e3 * scene.polygon.vertices, scene.polygon.mass)
    assert "in mm?" in find_unit_hint(dataclasses.replace(scene, polygon=large))


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
