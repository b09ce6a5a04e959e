"""Problem files and their keys: read, written, checked, in the schema, and to begin with."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import pickle
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from rows import each
from shipped import BOX, FOLDER, HEPTAGON, LANDING, Edit, plan_of, problem_of, put, table_of
from wholearm import End, Goal, InfeasibleError, InputError, Problem, Until, compare, load, save
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.fields import NONNEGATIVE, Range, declare, keys_of
from wholearm.common.fields import key as declare_key
from wholearm.common.parallel import run_tasks
from wholearm.geometry.path_guess import find_end
from wholearm.geometry.tracing import check_phases, trace_phase, trace_phases
from wholearm.mapping.formation_list import write_template
from wholearm.planning.plan import solve
from wholearm.problem import read
from wholearm.problem.read import TOP, build_problem, build_schema, read_problem, write_page
from wholearm.problem.table import (
    describe_phase,
    describe_scene,
    format_until,
    write_table,
    write_toml,
)
from wholearm.results.adopt import adopt_phases, describe_origin
from wholearm.scene.model import Finger, Friction, find_unit_hint

TEXT = HEPTAGON.read_text(encoding="utf-8")
WHOLE = tomllib.loads(TEXT) | {"uncertainty": {"mass": 0.1}}


def read_edited(edit: Edit) -> Problem:
    table = tomllib.loads(TEXT)
    edit(table)
    return build_problem(table)


def both(*edits: Edit) -> Edit:
    return lambda table: [edit(table) for edit in edits]


def ending(phase: int, until: object, end: str) -> Edit:
    return both(put(f"phases.{phase}.until", until), put(f"phases.{phase}.end", end))


def test_heptagon_is_read() -> None:
    scene = (problem := read_problem(str(HEPTAGON))).scene
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
        del table["fingers"]["1"]["viscous"], table["fingers"]["1"]["dry"]

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
    assert str(problem.phases[3].until) == text and problem.table["phases"][3] == phase
    # What is written of the phase alone reads as the same.
    written = write_table(problem)["phases"][3]
    assert list(written["until"]) == list(given)
    again = read_edited(put("phases.3", written)).phases[3].until
    assert again == problem.phases[3].until
    assert tomllib.loads(f"until = {format_until(again)}")["until"] == pytest.approx(given)
    if "x" in given and "phi_deg" in given:
        # In either order the coordinate with the longer way ends the phase.
        for start, first in (([0.06, 0, -0.7, 0, 0], "x"), ([0.011, 0, -0.6, 0, 0], "phi")):
            led = again.lead(np.array(start), 0.05)
            assert led.coordinate == first and sorted(led.coordinates) == sorted(again.coordinates)


MODES = [
    {"t": 0.01, "x": -0.0212, "phi_deg": -51.25, "signs": "-+0 +-"},
    {"t": 0.1, "x": -0.03, "phi_deg": -61.9, "signs": "-++ ++"},
]
LATER = ["v3-finger1", "v0-finger2"]


def guessing(*changes: tuple[int, str, Any]) -> dict[str, Any]:
    """A phase with an initial guess, some values of which are others."""
    modes: list[dict[str, Any]] = [dict(mode) for mode in MODES]
    for row, key, value in changes:
        modes[row][key] = value
    return {"contacts": ["v1-palm", *LATER], "until": "v2-palm", "guess": modes}


def test_an_initial_guess_is_read_and_written_as_the_same() -> None:
    problem = read_edited(put("phases.3", guessing()))
    first, last = problem.phases[3].guess or ()
    assert first.t == 0.01 and first.signs == (-1.0, 1.0, 0.0, 1.0, -1.0)
    assert last.x == -0.03 and last.phi == math.radians(-61.9)
    written = describe_phase(problem.phases[3])
    assert written["guess"] == MODES
    text = write_toml({"phases": [written]})
    assert tomllib.loads(text)["phases"] == [written]
    # A plan is not another problem's for that.
    bare = {key: value for key, value in guessing().items() if key != "guess"}
    assert describe_origin(read_edited(put("phases.3", bare)), {"problem": problem.table}) == ""


def test_a_problem_for_a_map_needs_no_phases() -> None:
    problem = read_edited(lambda table: table.pop("phases"))
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


THREE = {
    "contacts": ["v1-palm", "v3-finger1", "v0-finger2"],
    "until": {"contact": "v2-palm", "x": 0.0, "phi_deg": 0.0},
}


@each(
    "edit, key, text",
    [
        (put("phases.1.contact", []), "phases[2].contact", "did you mean 'contacts'"),
        (put("name", 3), "name", "not a string"),
        (put("fingers_collide", 0), "fingers_collide", "0 given; allowed are true and false"),
        (put("fingers.2.base", [0.09, 0]), "fingers.1.base", "not to the right"),
        (put("start.flush", 0.0), "start.flush", "0 to 6"),
        (put("start.x", 9.0), "start", "finger 1 is too short"),
        (put("fingers.2.base", [0.03, 0.02]), "fingers.2.base", "inside the object"),
        (put("phases.2.contacts.1", "v7-palm"), "phases[3].contacts", "0 to 6"),
        (put("phases.0.contacts.2", "v4-finger1"), "phases[1].contacts", "fingers touch"),
        (put("start.x", 0.0), "phases[1].contacts", "v3-finger1 v5-finger2"),
        (put("phases.0.contacts.1", "v1-palm rolling"), "phases[1].contacts", "makes 5"),
        (put("phases.0.contacts.1", "v1-palm rolls"), "phases[1].contacts", "' rolling' may"),
        (put("phases.3.until", "v1-palm"), "phases[4].until", "already"),
        (put("phases.3.until", {"phi": 1}), "phases[4].until", "allowed are a contact name"),
        (put("phases.3.until", {"contact": 3}), "phases[4].until", "3 is not a contact"),
        (put("phases.3.until", {"contact": "v4-finger1", "x": 99.0}), "phases[4].until", "99"),
        (put("phases.3", THREE), "phases[4].until", "gives 3 conditions; allowed are 2"),
        (put("phases.3.until", {"phi_deg": "1"}), "phases[4].until", "'1'"),
        (put("phases.3", guessing() | {"guess": []}), "phases[4].guess", "contact modes"),
        (put("phases.3", guessing() | {"guess": [3]}), "phases[4].guess[1]", "not a table"),
        (put("phases.3", guessing((1, "t", 0.01))), "phases[4].guess[2].t", "more than before"),
        (put("phases.3", guessing((0, "x", 99.0))), "phases[4].guess[1].x", "99"),
        (put("phases.3", guessing((0, "phi_deg", "1"))), "phases[4].guess[1].phi_deg", "'1'"),
        (put("phases.3", guessing((0, "signs", "-+ +-"))), "phases[4].guess[1].signs", "3 of -"),
        (put("phases.3", guessing((0, "sign", 1))), "phases[4].guess[1].sign", "'signs'"),
        (put("phases.3", guessing() | {"contacts": ["v1-palm rolling", *LATER]}),
         "phases[4].guess[1].signs", "v1-palm rolls: allowed is 0"),
        (both(put("friction.finger2", 0.0),
              put("phases.3.contacts", ["v1-palm", "v0-finger2 rolling", "v3-finger1"])),
         "phases[4].contacts", "v0-finger2 cannot roll without friction, and friction.finger2 is"),
        (ending(0, "v3-finger1", "bang"), "phases[1].end", "allowed are 'rest', 'smooth',"),
        (ending(4, {"x": 0.0}, "impact"), "phases[5].end", "'impact' given, but the last"),
        (ending(4, {"x": 0.0}, "smooth"), "phases[5].end", "the last phase ends at rest"),
        (ending(0, {"x": 0.02}, "impact"), "phases[1].end", "x = 0.02 m, not a contact that is"),
        (ending(0, "v3-palm", "impact"), "phases[1].end", "but phase 2 does not have v3-palm"),
        (ending(2, "v3-palm", "smooth"), "phases[3].end", "but phase 4 has v0-finger2 too"),
        (both(put("phases.0.end", "impact"), put("phases.1.contacts.1", "v4-finger1")),
         "phases[1].end", "'impact' given, but phase 2 has v4-finger1 too"),
        (both(put("phases.0.end", "impact"), lambda table: table["phases"][0].pop("until")),
         "phases[1].until", "is missing; only a phase with end = 'smooth' has none"),
        (put("object.mass", 1e308), "object.mass", "1e+308 given; allowed are 1e-06 to 1e+06 kg"),
        (put("object.inertia", 1e-8), "object.inertia", "times uniform density"),
        (put("gravity", 1e-9), "gravity", "allowed are 0.001 to"),
        (put("friction.palm", 11.0), "friction.palm", "11 given; allowed are 0 to 10"),
        (put("fingers.2.length", 1e-9), "fingers.2.length", "times the object's size"),
        (put("fingers.1.radius", 1e-9), "fingers.1.radius", "allowed are 1.8e-05 to 0.18 m ("),
        (put("fingers.1.radius", 0.2), "fingers.1.radius", "times the length, or 0)"),
        (put("fingers.1.base", [1e9, 0.0]), "fingers.1.base", "times the object's size"),
        (put("fingers.1.torque_limit", 1e308), "fingers.1.torque_limit", "times m g length"),
        (put("epsilon", 1e308), "epsilon", "times what presses at most"),
        (put("start.x", -1e308), "start.x", "times the object's size"),
        (put("goal", {"flush": 6}), "goal", "given with [[phases]]"),
    ],
)  # fmt: skip
def test_bad_input_names_the_key(edit: Edit, key: str, text: str) -> None:
    """More of it is in the corpus, with whole messages."""
    with pytest.raises(InputError) as caught:
        read_edited(edit)
    assert caught.value.key == key
    assert text in caught.value.problem and "\n" not in str(caught.value)


def test_the_first_phase_may_let_go_of_what_touches() -> None:
    names = ["v1-palm", "v2-finger1", "v5-finger2"]
    assert [*read_edited(put("phases.0.contacts", names)).phases[0].formation.names] == names


@each(
    "old, new, key, text",
    [
        ("mass = 0.2", "mass = nan", "object.mass", "finite"),
        ("mass = 0.2", "mas = 0.2", "object.mas", "did you mean 'mass'"),
        ("mass = 0.2", "mass = ", "", "is not TOML"),
        ('"v5-finger2"]\nuntil', '"v9-finger2"]\nuntil', "phases[1].contacts", "does not exist"),
        (TEXT, "", "epsilon", "is missing"),
        ("epsilon", "settle_gap = 1e-4\nepsilon", "settle_gap", "given without settle, and has no"),
        ("epsilon", "control_hold = 'linear'\nepsilon", "control_hold", "without control_period"),
        # Those below need the curves.
        ('until = "v6-finger2"', 'until = "v2-palm"', "phases[2].until", "never reached"),
        ('until = "v6-finger2"', "until = { x = -9.0 }", "phases[2].until", "never reached"),
        ("phi_deg = -50.0", "phi_deg = 50.0", "phases[5].until", "phi = 50 deg is never reached"),
        ("phi_deg = -50.0", "phi_deg = -50.0, x = 1", "phases[5].until", "way phi = -50 deg at x"),
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


@each("content", [b"\xff\xfe", b"\x00", b"[[[[", b"a = " + b"9" * 5000, b"a = " + b"[" * 20_000])
def test_not_toml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"is not TOML|is nested too deeply"):
        read_problem(str(path))


def test_what_depends_on_where_a_landing_ends_is_left_to_the_planner() -> None:
    problem = problem_of(LANDING)
    z = problem.start
    for phase in problem.phases:
        z = find_end(phase, z, problem.phases[phase.number :])
    last = {"contacts": ["v1-palm", "v2-palm", "v4-finger1", "v6-finger2"], "until": {"x": z[0]}}
    longer = problem.with_(phases=[*problem.table["phases"], last])
    check_phases(longer)
    with pytest.raises(InputError, match="holds already at the start"):
        trace_phase(longer.phases[-1], z)


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
    bare = both(cross, put("phases", []))
    for own in map(float, re.findall(r"-?[\d.]+", text)):
        assert read_edited(both(bare, put("start.x", own))).start[0] == own
    passing = both(cross, put("fingers_collide", False), put("phases", WHOLE["phases"][1:2]))
    assert read_edited(passing).start[0] == 0.0


@pytest.mark.parametrize(
    "changes",
    [
        {"friction": 0.11, "name": 'a "b" \\ \u00fc', "fingers_collide": False, "inertia": 3e-4},
        {"uncertainty": {"mass": 0.1, "friction": 0.2}, "settle": "10 %", "settle_gap": 1e-4},
        {"phases": None, "goal": [{"flush": 1}, {"phi_deg": -50.0, "x": 0.01}], "settle_gap": 1e-4},
        {"phases[5].until": {"phi_deg": -50.0}, "speed_limit1": 20.0, "control_period": 0.005},
    ],
)
def test_a_saved_problem_loads_as_the_same(changes: dict[str, object], tmp_path: Path) -> None:
    problem = problem_of(HEPTAGON).with_(changes)
    save(problem, tmp_path / "x.toml")
    loaded = read_problem(str(tmp_path / "x.toml"))
    assert loaded.table == problem.table
    assert loaded.goals == problem.goals and (loaded.start == problem.start).all()


def test_default_ranges_follow_the_size() -> None:
    problem = problem_of(HEPTAGON)
    assert problem.ranges["start_x"] == pytest.approx(2e-4, rel=0.2)
    assert problem.ranges["start_x"] / problem.scene.scales.length == pytest.approx(6e-3)
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


FIRST = problem_of(HEPTAGON).phases[0]
PALM = FIRST.formation.contacts[0]


def alter(**changes: Any) -> Callable[[Problem], Problem]:
    """Makes a problem anew, with another first phase."""
    return lambda own: rebuild(own, phases=(replace(own.phases[0], **changes), *own.phases[1:]))


def touch(*contacts: Any) -> Callable[[Problem], Problem]:
    return alter(formation=replace(FIRST.formation, contacts=contacts))


@each("make, file",
    [
        (lambda own: rebuild(own, epsilon=-0.1), {"epsilon": -0.1}),
        (lambda own: rebuild(own, epsilon=1e9), {"epsilon": 1e9}),
        (lambda own: rebuild(own, name=3), {"name": 3}),
        (lambda own: rebuild(own, scene=replace(
            own.scene, polygon=wholearm.Polygon(own.scene.polygon.points, 1e9))), {"mass": 1e9}),
        (lambda own: rebuild(own, scene=replace(own.scene, fingers=(
            replace(own.scene.fingers[0], viscous=1e6), own.scene.fingers[1]))), {"viscous1": 1e6}),
        (alter(until=Until(coordinate="x", value=1e6)), {"phases[1].until": {"x": 1e6}}),
        (alter(until=Until(coordinate="phi", value=1e3)),
         {"phases[1].until": {"phi_deg": float(np.degrees(1e3))}}),
        (alter(until=Until(contact=PALM)), {"phases[1].until": "v0-palm"}),
        (alter(until=Until()), {"phases[1].until": None}),
        (lambda own: rebuild(own, phases=(*own.phases[:4], replace(own.phases[4], end=End.IMPACT))),
         {"phases[5].end": "impact"}),
        (touch(PALM, PALM), {"phases[1].contacts": ["v0-palm", "v0-palm"]}),
        (touch(replace(PALM, index=3)), {"phases[1].contacts": ["v3-palm"]}),
    ],
)  # fmt: skip
def test_wrong_values_have_the_messages_of_files(
    make: Callable[[Problem], Problem], file: dict[str, Any]
) -> None:
    given = problem_of(HEPTAGON)
    with pytest.raises(InputError) as caught:
        make(given)
    with pytest.raises(InputError) as refused:
        given.with_(file)
    assert str(caught.value) == str(InputError("", refused.value.key, refused.value.problem))


def test_what_only_objects_can_say_wrongly() -> None:
    given, sideways = problem_of(BOX), Until(coordinate="y", value=0.1)
    first = replace(given.phases[0], until=sideways)
    for changes, text in (
        ({"start": given.start[:4]}, "start: .* is not a list of 5 numbers"),
        ({"phases": given.phases[1:]}, r"phases\[1\]: has the index 1; .* makes it 0"),
        ({"phases": (first,)}, r"phases\[1\].until: 'y' given; allowed are 'x' and 'phi'"),
        ({"phases": (first, 1)}, "phases: .* given; allowed: tuple.Phase, ..."),
        ({"start": [0.0, 5.0, *given.start[2:].tolist()]}, "closed fingers touch nothing"),
    ):
        with pytest.raises(InputError, match=text):
            rebuild(given, **changes)
    public: Any = wholearm
    body = given.scene.polygon
    for call, text in (
        (lambda: public.Scene(5, 6, 7), "polygon: 5 given; allowed: Polygon"),
        (lambda: public.Scene(body, given.scene.fingers[:1], 0), "allowed: tuple.Finger, F"),
        (lambda: public.solve(None), "problem: None given; allowed: Problem"),
        (lambda: public.verify(given, "a"), "what: 'a' given; allowed are a plan, a simulation, a"),
        (lambda: public.load(True), "path: True given; allowed: str, Path"),
        (lambda: public.sweep(given, {"mass": 1}), "vary: .* given; allowed: Mapping.str, S"),
        (lambda: public.sweep([], {"mass": [0.2]}), "problems: COUNT: 0 given; allowed are"),
        (lambda: public.compare(given, []), "paths: COUNT: 0 given; allowed are whole"),
        (lambda: public.design_hand(given, "mass=1:2"), "over: .* given; allowed: Sequence.str"),
        (lambda: public.TorqueProfile.join_rows([[1, 0, 0], [0, 0, 0]]), "breaks: .* increase"),
        (lambda: replace(given, epsilon=-1), "epsilon: -1 is not a number >= 0"),
        (lambda: public.read_until(None, {"x": 0.1}), "scene: None given; allowed: Scene"),
        (lambda: public.place_start(given.scene, -1, 0.0), "start.flush: -1 is not an edge"),
        (lambda: public.list_formations(given, (0.1,), (0.2, 0.0)), "is not a list of 2 numbers"),
        (lambda: public.write_mjcf(given, step=math.nan), "step: nan is not a positive number"),
        (lambda: run_tasks([], jobs=-1), "jobs: -1 given; allowed are whole numbers from 1 to 256"),
    ):
        with pytest.raises(InputError, match=text):
            call()
    assert pickle.loads(pickle.dumps(public.solve)) is public.solve


def test_a_start_that_no_file_can_say_leaves_the_table_empty() -> None:
    own = problem_of(HEPTAGON)
    made = rebuild(own, start=trace_phases(own)[3].end, phases=(replace(own.phases[4], index=0),))
    assert made.table == {} and copy.deepcopy(made).table == {}


STIFF = Range(1e-3, 2.0, lambda _, own: own.torque_limit, "times the torque limit")
STIFFNESS = declare_key("stiffness", "Spring of the joint [N m/rad].", NONNEGATIVE, "torque", STIFF)


@declare(*keys_of(Finger).values(), STIFFNESS)
@dataclass(frozen=True, eq=False)
class SprungFinger(Finger):
    stiffness: float = 0.0


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(read, "Finger", SprungFinger)
    monkeypatch.setitem(read.FINGER, "stiffness", keys_of(SprungFinger)["stiffness"])
    return copy.deepcopy(dict(read_problem(str(HEPTAGON)).table))


def get_stiffness(problem: Problem) -> list[Any]:
    return [getattr(finger, "stiffness") for finger in problem.scene.fingers]  # noqa: B009


def test_a_new_key_is_read_left_out_changed_written(table: dict[str, Any], tmp_path: Path) -> None:
    problem = build_problem(table)
    assert get_stiffness(problem) == [0.0, 0.0]
    assert get_stiffness(problem.with_(stiffness=0.5)) == [0.5, 0.5]
    save(problem.with_(stiffness2=0.7), str(tmp_path / "sprung.toml"))
    assert get_stiffness(read_problem(str(tmp_path / "sprung.toml"))) == [0.0, 0.7]


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("stiffness", -1.0, "fingers.1.stiffness: -1.0 is not a number >= 0"),
        ("stiffness", 5.0, r"are 0.002 to 4 N m/rad \(0.001 to 2 times the torque limit\)"),
        ("stifness", 1.0, "fingers.1.stifness: unknown key; did you mean 'stiffness'?"),
    ],
)
def test_messages_know_it(table: dict[str, Any], name: str, value: object, text: str) -> None:
    table["fingers"]["1"][name] = value
    with pytest.raises(InputError, match=text):
        build_problem(table)


def test_schema_page_and_docstring_know_it(table: dict[str, Any]) -> None:
    key = read.build_schema()["definitions"]["finger"]["properties"]["stiffness"]
    assert key.pop("description") == "Spring of the joint [N m/rad]."
    assert key == {"type": "number", "minimum": 0, "default": 0.0}
    row = "| `stiffness` | N m/rad | 0 | 0.001 to 2 times the torque limit | Spring of the joint. |"
    assert row in read.write_page()
    assert "Spring of the joint" in (SprungFinger.__doc__ or "")


jsonschema = pytest.importorskip("jsonschema")
SCHEMA = build_schema()
PARTS = SCHEMA["definitions"]
TABLES: dict[str, tuple[dict[str, Any], Callable[[Any], Any]]] = {
    "": (SCHEMA, lambda table: table),
    "fingers.1": (PARTS["finger"], lambda table: table["fingers"]["1"]),
    "phases[1]": (PARTS["phase"], lambda table: table["phases"][0]),
}
for part in ("object", "fingers", "friction", "uncertainty", "start"):
    TABLES[part] = PARTS[part], itemgetter(part)


@pytest.mark.parametrize("where", TABLES)
def test_keys_are_those_that_the_reader_allows(where: str) -> None:
    part, find = TABLES[where]
    table = copy.deepcopy(WHOLE)
    find(table)["surely_unknown"] = 1
    with pytest.raises(InputError, match="unknown key") as caught:
        build_problem(table)
    (allowed,) = re.findall(r"allowed are (.*)", str(caught.value))
    assert sorted(part["properties"]) == allowed.split(", ")
    # Each key that is left out is missed if the schema requires it, and only then.
    for key in part["properties"]:
        table = copy.deepcopy(WHOLE)
        find(table).pop(key, None)
        # Only a phase with a smooth end may lack `until`; this one ends at rest.
        if key in part["required"] or key == "until":
            with pytest.raises(jsonschema.ValidationError):
                jsonschema.validate(table, SCHEMA)
            with pytest.raises(InputError, match="is missing"):
                build_problem(table)
        else:
            build_problem(table)


@each(
    "where, key, value",
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
    table = copy.deepcopy(WHOLE)
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
    keys = [key for key, own in TOP.items() if own.text and key not in PARTS]
    assert all(f"| `{key}` |" in write_page() for key in keys)


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


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_problem_has_a_valid_table_as_read_and_of_objects(path: Path) -> None:
    problem = read_problem(str(path))
    assert replace(problem).table == problem.table
    assert build_problem(problem.table).table == problem.table
    made = rebuild(problem)
    assert made.source == ""
    for own in (problem, problem.with_(), made):
        check_table(own)
        jsonschema.validate(json.loads(json.dumps(dict(own.table))), SCHEMA)


def test_another_scene_is_the_scene_of_every_phase(heptagon: Problem) -> None:
    rough = replace(heptagon.scene, friction=Friction(0.2, 0.15, 0.12))
    other = replace(heptagon, scene=rough, epsilon=0.06)
    check_scene(other)
    check_table(other)
    assert other.phases[0].formation.friction == pytest.approx([0.2, 0.2, 0.15, 0.12])
    assert heptagon.phases[0].formation.friction == pytest.approx([0.1] * 4)
    assert other.table["friction"] == pytest.approx({"palm": 0.2, "finger1": 0.15, "finger2": 0.12})
    assert heptagon.table["friction"]["palm"] == pytest.approx(0.1)


@each(
    "changes, key, expected",
    [
        ({"name": "other"}, "name", "other"),
        ({"epsilon": 0.01}, "epsilon", 0.01),
        ({"gravity": 1.62}, "gravity", 1.62),
        ({"fingers_collide": False}, "fingers_collide", False),
        ({"mass": np.float64(0.3)}, "object.mass", 0.3),
        ({"friction_finger1": 0.3}, "friction.finger1", 0.3),
        ({"torque_limit1": 3}, "fingers.1.torque_limit", 3.0),
        ({"finger_inertia2": 0.01}, "fingers.2.inertia", 0.01),
        ({"base1": (0.081, -0.01)}, "fingers.1.base", [0.081, -0.01]),
        ({"speed_limit": 5.0}, "fingers.2.speed_limit", 5.0),
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


@each(
    "changes, message",
    [
        ({"fricton": 0.2}, "fricton: unknown name; did you mean 'friction'? allowed are "),
        ({"torque_limit": None}, "fingers.1.torque_limit: is missing"),
        ({"friction": {"palm": 0.1}}, "friction.finger1: is missing"),
        ({"object.masss": 1}, "object.masss: unknown key; did you mean 'mass'?"),
        ({"fingers.3.base": [0, 0]}, "fingers.3.base: there is no '3'; what is there: 1, 2"),
        ({"phases[9].end": "rest"}, "phases[9].end: there is no number 9; the list has 5"),
        ({"epsilon.much": 1}, "epsilon.much: 0.05 is not a table"),
        ({"": 1}, "unknown name; allowed are "),
    ],
)
def test_what_a_file_may_not_say_no_change_may(
    heptagon: Problem, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        heptagon.with_(changes)
    assert str(caught.value).startswith(message)


def test_other_phases_and_another_start_are_in_the_table(heptagon: Problem) -> None:
    check_table(replace(heptagon, phases=heptagon.phases[:2]))
    box = problem_of(BOX)
    last = replace(box.phases[-1], end=End.REST)
    check_table(replace(box, phases=(*box.phases[:-1], last)))
    smooth = [replace(phase, end=End.SMOOTH) for phase in heptagon.phases[:-1]]
    passing = replace(heptagon, phases=(*smooth, heptagon.phases[-1]))
    assert [entry.get("end") for entry in passing.table["phases"]] == ["smooth"] * 4 + [None]
    moved = heptagon.with_(x=0.04)
    check_table(replace(heptagon, start=moved.start))
    tilted = replace(heptagon, start=heptagon.start + 0.1 * np.eye(5)[2])
    assert tilted.table == {} and replace(tilted, epsilon=0.1).table == {}
    with pytest.raises(InputError, match="has no table"):
        tilted.with_(epsilon=0.1)


def least_time(corners: int, size: float, mass: float | None = None, *vertices: Array) -> float:
    text = write_template("own", corners, size, mass, *vertices)
    return solve(build_problem(tomllib.loads(text))).value


def test_a_template_plans_as_it_is_or_is_refused() -> None:
    """Of given corners with another start, with less friction, or not at all."""
    assert all(least_time(corners, 0.05) > 0 for corners in (3, 4, 12))
    flat, tall = np.array([[0, 0], [1.2, 0], [0.1, 0.3]]), [[0, 0], [0.2, 0], [0.2, 3.0], [0, 3.0]]
    for corners in (flat, np.array(tall)):
        assert least_time(7, 0.05, None, corners) > 0
    falls = np.array([[0.01, 0], [0.02, 0], [0.18, 0.05], [0.17, 0.1]])
    with pytest.raises(InfeasibleError, match="have a plan: phase 1 is infeasible: c_n of "):
        least_time(7, 0.05, None, falls)


def test_templates_are_alike_in_every_size() -> None:
    # Under gravity times go with the root of lengths, whatever the mass; numbers have four digits.
    small, large = least_time(7, 0.05), least_time(7, 5.0, mass=3.0)
    assert large / small == pytest.approx(math.sqrt(100.0), rel=1e-2)


@pytest.mark.parametrize(
    ("given", "key"),
    [((2, 0.05, None), "--polygon"), ((7, -1.0, None), "--size"), ((7, 0.05, 0.0), "--mass")],
)
def test_what_makes_no_scene_is_refused(given: tuple[int, float, float | None], key: str) -> None:
    with pytest.raises(InputError, match=key):
        write_template("own", *given)


def test_new_writes_a_file_and_keeps_one_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", str(tmp_path / "mine"), "--polygon", "5"]) == 0
    text = (path := tmp_path / "mine.toml").read_text(encoding="utf-8")
    problem = load(str(path))
    assert problem.name == "mine" and problem.scene.polygon.n_vertices == 5
    few = [str(tmp_path / "few"), "--vertices", "0,0 1,1"]
    cases = {"is there already": [str(path)], ": 2 corners given; allow": few}
    for words, given in (cases | {"--size: 0.1 given; ": [*few, "--size", "0.1"]}).items():
        assert main(["new", *given]) == 2 and words in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == text


def read_file(goal: object) -> Problem:
    return build_problem(table_of() | {"goal": goal})


@pytest.mark.parametrize(
    ("given", "goals"),
    [
        ({"flush": 6}, (Goal(flush=6),)),
        ({"phi_deg": -50.0, "x": 0.02}, (Goal(phi=math.radians(-50.0), x=0.02),)),
        ([{"flush": 6, "x": 0.0}, {"flush": 0}], (Goal(flush=6, x=0.0), Goal(flush=0))),
    ],
)
def test_goals_are_read_and_written(given: object, goals: tuple[Goal, ...]) -> None:
    problem = read_file(given)
    assert problem.goals == goals and not problem.phases
    assert replace(problem, epsilon=0.1).table["goal"] == given
    other = replace(problem, goals=(Goal(flush=1, x=0.01),))
    assert other.table["goal"] == {"flush": 1, "x": 0.01}
    assert build_problem(other.table).goals == other.goals
    # What a search finds takes the place of goals.
    found = replace(problem, goals=(), phases=problem_of(HEPTAGON).phases)
    assert "goal" not in found.table and len(found.table["phases"]) == 5


@each(
    "given, text",
    [
        ({"x": 0.0}, "goal: neither flush nor phi_deg given"),
        ({"flush": 1, "phi_deg": 3.0}, "goal: flush and phi_deg are both given"),
        ({"flush": 7}, "goal.flush: 7 is not an edge; allowed are 0 to 6"),
        ({"flush": 1.5}, "goal.flush: 1.5 is not an edge"),
        ([{"flush": 1}, {"flush": 2, "x": 1e6}], r"goal\[2\].x: 1e+"),
        ({"flush": 1, "y": 0.0}, "goal.y: unknown key"),
        ("edge 6", "goal: 'edge 6' given"),
    ],
)
def test_other_goals_are_refused(given: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        read_file(given)


def test_a_plan_brings_the_phases_that_lead_to_its_goal(tmp_path: Path) -> None:
    plan, planned = plan_of(HEPTAGON), problem_of(HEPTAGON)
    phi = math.degrees(plan.q[-1, 2])
    problem = read_file({"phi_deg": phi})
    found = adopt_phases(problem, plan.meta, plan.q[-1])
    assert found.table["phases"] == planned.table["phases"] and not found.goals
    assert adopt_phases(planned, plan.meta, plan.q[-1]) is planned
    plan.save(tmp_path / "plan.npz")
    own, _ = compare(problem, [plan, tmp_path / "plan.npz"]).contenders
    assert own.ok and len(own.lasts) == 5
    for goal in ({"phi_deg": phi + 1.0}, {"phi_deg": phi, "x": plan.q[-1, 0] + 1e-3}, {"flush": 6}):
        with pytest.raises(InputError, match=r"goal: the plan ends at .*, and not with"):
            adopt_phases(read_file(goal), plan.meta, plan.q[-1])
    other = read_file({"phi_deg": phi + 1.0}).with_(vertices=[[0, 0], [0.08, 0], [0.04, 0.06]])
    with pytest.raises(InputError, match=r"vertices: 7 entries in the plan, 3 here"):
        adopt_phases(other, plan.meta, plan.q[-1])
