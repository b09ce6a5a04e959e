"""Problem files: their keys, reading, validation, JSON Schema and a page of all keys.

Most keys are declared by the classes that hold their values: `Polygon`, `Finger`, `Friction`,
`Scene`, `Problem`, `Phase` and `Goal`; the other keys are declared here. Every message names file,
key, value and allowed values.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source, require_number, suggest
from ..common.fields import (
    NONNEGATIVE,
    NUMBER,
    POINT,
    Field,
    collect_keys,
    keys_of,
    name_fields,
    refer,
    unread,
)
from ..common.fields import key as declare
from ..common.sharing import exclusive
from ..contacts.closing import close_finger, describe_reach, place_flush
from ..contacts.contact_limits import evaluate_finger_gap
from ..contacts.elemental import Contact, parse_contact
from ..contacts.formation import Formation, describe, find_touching
from ..scene.model import FRICTION as COEFFICIENTS
from ..scene.model import PLACE, TURN, Finger, Friction, Polygon, Scene, check_ranges
from .definition import (
    CONTACT,
    GROUPS,
    INDEX,
    PARAMETERS,
    ROWS,
    End,
    Goal,
    ModeGuess,
    Phase,
    Problem,
    Until,
    expand_widths,
    read_widths,
)
from .table import REQUIRED_KEYS

Table = Mapping[str, Field]
"""Keys of a table by name."""


_DEFAULTS = read_widths({})
_WIDTHS = {field.name: replace(field, default=_DEFAULTS[field.name]) for field in PARAMETERS}
OBJECT, FINGER, FRICTION, PHASE, GOAL = (
    name_fields(*keys_of(field).values()) for field in (Polygon, Finger, Friction, Phase, Goal)
)
FINGERS = name_fields(
    declare("1", "The right finger.", unread(refer("finger"))),
    declare("2", "The left finger.", unread(refer("finger"))),
)
START = name_fields(
    declare(
        "flush", "The edge that lies on the palm; edge 0 runs from vertex 0 to vertex 1.", INDEX
    ),
    declare("x", "Of the centroid [m]; both fingers close on the object.", NUMBER, "length", PLACE),
)
UNTIL = name_fields(
    declare("contact", "", unread(refer("contact")), default=None),
    declare("x", "[m]", default=None),
    declare("phi_deg", "[degrees]", default=None),
)
MODE = name_fields(
    *map(declare, ("t", "x", "phi_deg")),
    declare("signs", "", unread({"type": "string", "pattern": "^[-+0]+ [-+]{2}$"})),
)
UNCERTAINTY = {name: _WIDTHS[names[0]] for name, names in GROUPS.items()} | _WIDTHS
_PARTS = name_fields(
    *(declare(name, kind=unread(refer(name))) for name in ("object", "fingers", "start")),
    declare("friction", "Coefficients of friction with the object.", unread(refer("friction"))),
    declare(
        "uncertainty",
        "Ranges of what is not known exactly, for robustness and solve --robust.",
        unread(refer("uncertainty")),
        default=None,
    ),
    declare(
        "goal",
        "Where the object shall come to lie, in place of phases; several are visited in order.",
        unread({"oneOf": [refer("goal"), {"type": "array", "items": refer("goal")}]}),
        default=None,
    ),
    declare("phases", kind=unread({"type": "array", "items": refer("phase")}), default=None),
)
TOP = name_fields(*keys_of(Problem).values(), *keys_of(Scene).values()) | _PARTS
_TABLES = {
    "object": OBJECT, "finger": FINGER, "friction": FRICTION, "start": START,
    "uncertainty": UNCERTAINTY, "goal": GOAL,
}  # fmt: skip
_PLACES = {
    "the top of the file": TOP, "[object]": OBJECT, "[fingers.1] and [fingers.2]": FINGER,
    "[start]": START, "[[phases]]": PHASE, "[goal]": GOAL,
}  # fmt: skip
"""Tables by name, for hints about keys in a wrong table."""

ROLLING = " rolling"  # follows the name of a contact that rolls in a phase's `contacts`


def read_problem(path: str | Path) -> Problem:
    """Read and validate a problem file; reachability of the phases is not checked.

    An `InputError` if it cannot be read, or for the first malformed value.
    """
    try:
        with open(path, "rb") as stream:
            content = stream.read()
        if content.startswith(b"PK"):
            text = "is no problem file but an archive, as a trajectory is; the problem comes first"
            raise InputError(str(path), "", text)
        # Editors on Windows may write a byte order mark.
        table = tomllib.loads(content.decode("utf-8-sig").replace("\r\n", "\n"))
    except OSError as error:
        raise InputError(str(path), "", f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(str(path), "", f"is not TOML: {error}") from None
    except RecursionError:
        raise InputError(str(path), "", "is nested too deeply") from None
    problem = build_problem(table, str(path))
    for key, parent in REQUIRED_KEYS.items():
        if key in table and not any(parent in part for part in (table, *table.get("phases", ()))):
            text = f"{table[key]!r} given without {parent}, and has no effect without it"
            raise InputError(str(path), key, text)
    return problem


@exclusive
def build_problem(table: Mapping[str, Any], source: str = "") -> Problem:
    """The problem from the nested tables of a file, or an `InputError` that names `source`."""
    with name_source(source):
        _table(table, "", TOP)
        polygon = Polygon(**collect_keys(Polygon, _table(table["object"], "object", OBJECT)))
        fingers = _table(table["fingers"], "fingers", FINGERS)
        coefficients = _table(table["friction"], "friction", FRICTION)
        friction = Friction(**collect_keys(Friction, coefficients))
        right, left = (
            Finger(**collect_keys(Finger, _table(fingers[key], name, FINGER)), name=name)
            for key, name in ((key, f"fingers.{key}") for key in FINGERS)
        )
        scene = Scene(polygon, (right, left), friction, **collect_keys(Scene, table))
        check_ranges(scene)
        start = _table(table["start"], "start", START)
        z = place_start(scene, start["flush"], start["x"])
        entries = table.get("phases", [])
        if not isinstance(entries, list):
            raise InputError("", "phases", f"{entries!r} is not a list of [[phases]]")
        uncertainty = None
        if "uncertainty" in table:
            uncertainty = _table(table["uncertainty"], "uncertainty", UNCERTAINTY)
        return Problem(
            scene=scene,
            start=z,
            phases=tuple(read_phase(scene, i, entry) for i, entry in enumerate(entries)),
            source=source,
            uncertainty=uncertainty,
            goals=read_goals(table),
            **collect_keys(Problem, table),
        )


def read_stored_problem(meta: Mapping[str, Any], source: str = "") -> Problem:
    """The problem stored in the `meta` of a trajectory.

    An `InputError` that names the file `source` if there is none, or it is malformed.
    """
    table = meta.get("problem")
    if not isinstance(table, Mapping) or not table:
        text = "the trajectory does not hold its problem's tables"
        raise InputError(source, "meta.problem", text)
    with name_source(source, "meta.problem."):
        return build_problem(table)


def _check_edge(scene: Scene, edge: object, key: str) -> None:
    count = scene.polygon.n_vertices
    if not isinstance(edge, int | np.integer) or isinstance(edge, bool) or not 0 <= edge < count:
        raise InputError("", key, f"{edge!r} is not an edge; allowed are 0 to {count - 1}")


@exclusive
def place_start(scene: Scene, flush: int, x: float) -> Array:
    """The configuration with edge `flush` on the palm and both fingers closed, shape (5,).

    InputError if there is no such edge, `x` [m], of the centroid, is out of its range, or a finger
    does not reach.
    """
    _check_edge(scene, flush, "start.flush")
    x = require_number(x, "start.x")
    PLACE.check("start.x", x, "m", scene)
    q = place_flush(scene, flush, x)
    try:
        z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    except InputError as error:
        text = f"{error.problem}; {describe_reach(scene, float(q[2]))}"
        raise InputError(error.source, error.key, text) from error
    z.setflags(write=False)
    return z


def read_phase(scene: Scene, index: int, value: object) -> Phase:
    """The phase of an entry of `[[phases]]`, or an `InputError`."""
    key = f"phases[{index + 1}]"
    entry = _table(value, key, PHASE)
    names = entry["contacts"]
    if not isinstance(names, list) or not names:
        raise InputError("", f"{key}.contacts", f"{names!r} is not a list of contact names")
    with name_source(prefix=f"{key}.contacts"):
        formation = read_formation(scene, names)
    end = End(PHASE["end"].kind.read(entry.get("end", "rest"), f"{key}.end"))
    with name_source(prefix=f"{key}.until"):
        until = read_until(scene, entry["until"]) if "until" in entry else Until()
    guess = _read_guess(formation, entry["guess"], f"{key}.guess") if "guess" in entry else None
    return Phase(index, formation, until, end, entry.get("settle"), guess)


def _read_guess(formation: Formation, value: object, key: str) -> tuple[ModeGuess, ...]:
    """The contact modes of an initial guess."""
    if not isinstance(value, list) or not value:
        raise InputError("", key, f"{value!r} is not a list of contact modes")
    scene, modes = formation.scene, list[ModeGuess]()
    count = formation.n_contacts
    for row, mode in enumerate(value, start=1):
        name = f"{key}[{row}]"
        entry = _table(mode, name, MODE)
        t, x, phi = (
            require_number(entry[quantity], f"{name}.{quantity}")
            for quantity in ("t", "x", "phi_deg")
        )
        if t <= (modes[-1].t if modes else 0.0):
            raise InputError("", f"{name}.t", f"{t:g} given; allowed is more than before")
        PLACE.check(f"{name}.x", x, "m", scene)
        TURN.check(f"{name}.phi_deg", phi, "degrees")
        signs = entry["signs"]
        if not isinstance(signs, str) or not re.fullmatch(rf"[-+0]{{{count}}} [-+]{{2}}", signs):
            text = f"allowed are {count} of -, +, 0 for {' '.join(formation.names)}"
            raise InputError("", f"{name}.signs", f"{signs!r} given; {text}, and - or + per joint")
        for contact, sign, mu in zip(formation.contacts, signs, formation.friction, strict=False):
            text = ""
            if contact in formation.rolling and sign != "0":
                text = f"{contact} rolls: allowed is 0"
            elif sign == "0" and mu == 0:
                text = f"{contact} cannot roll without friction"
            if text:
                raise InputError("", f"{name}.signs", f"{signs!r} given; {text}")
        values = tuple({"-": -1.0, "0": 0.0, "+": 1.0}[sign] for sign in signs if sign != " ")
        modes.append(ModeGuess(t, x, math.radians(phi), values))
    return tuple(modes)


def read_formation(scene: Scene, names: Sequence[object]) -> Formation:
    """The formation of contacts by name, each sliding unless its name is followed by ``rolling``.

    InputError if there is no such contact.
    """
    contacts, rolling = list[Contact](), list[Contact]()
    for name in names:
        stem = name.removesuffix(ROLLING) if isinstance(name, str) else name
        try:
            contacts.append(parse_contact(stem, scene))
        except InputError as error:
            if isinstance(stem, str) and " " in stem:
                raise InputError("", "", f"{error.problem}; {ROLLING!r} may follow") from None
            raise
        rolling += contacts[-1:] * (stem != name)
    return Formation(scene, tuple(contacts), tuple(rolling))


def read_until(scene: Scene, given: object) -> Until:
    """Terminal condition: the name of a contact, or a table of ``contact``, ``phi_deg`` and ``x``.

    Without a contact, the coordinate that is farthest away ends the phase (`Until.lead`); the
    others have to hold there. InputError for anything else.
    """
    if isinstance(given, str):
        return Until(contact=parse_contact(given, scene))
    allowed = "allowed are a contact name, or a table with contact, phi_deg or x, or several"
    if not isinstance(given, dict) or not given or not set(given) <= set(UNTIL):
        raise InputError("", "", f"{given!r} does not end a phase; {allowed}")
    pins = []
    for key, number in ((key, require_number(given[key], "")) for key in given if key != "contact"):
        if key == "phi_deg":
            TURN.check("", number, "degrees")
        pins.append((key, number) if key == "x" else ("phi", math.radians(number)))
    if "contact" in given:
        return Until(contact=parse_contact(given["contact"], scene), pins=tuple(pins))
    (coordinate, value), *others = pins
    return Until(None, coordinate, value, tuple(others))


def _table(value: object, key: str, fields: Table) -> Mapping[str, Any]:
    """The table at a key; an `InputError` if a required key is missing or a key is unknown."""
    if not isinstance(value, Mapping):
        raise InputError("", key, f"{value!r} is not a table")
    prefix = f"{key}." if key else ""
    for name in value:
        if name not in fields:
            allowed = f"allowed are {', '.join(sorted(fields))}"
            place = next((place for place, table in _PLACES.items() if name in table), "")
            hint = f"it belongs to {place}; " if place else suggest(name, fields)
            raise InputError("", f"{prefix}{name}", f"unknown key; {hint}{allowed}")
    for name in sorted(name for name, field in fields.items() if field.required):
        if name not in value:
            raise InputError("", f"{prefix}{name}", "is missing")
    return value


@exclusive
def check_problem(problem: Problem) -> None:
    """Raise an `InputError` for the first invalid value; curves of phases are not traced."""
    check_ranges(problem.scene)
    for attribute, field in keys_of(Problem).items():
        field.check(getattr(problem, attribute), field.name, problem.scene)
    expand_widths(problem.uncertainty or {}, "uncertainty.{}")
    PLACE.check("start.x", float(problem.start[0]), "m", problem.scene)
    for index, phase in enumerate(problem.phases):
        if phase.index != index:
            text = f"has the index {phase.index}; phases count up from 0, which makes it {index}"
            raise InputError("", f"phases[{index + 1}]", text)
        _check_formation(phase.formation, f"phases[{index + 1}].contacts")
        _check_until(problem.scene, phase, f"phases[{index + 1}].until")
        key, declared = f"phases[{index + 1}].settle", keys_of(Phase)["settle"]
        declared.check(declared.read(phase.settle, key), key, problem.scene)
        if phase.settle and phase.end is End.SMOOTH:
            text = f"{phase.settle:g} given, but the phase has end = 'smooth'"
            raise InputError("", key, text)
    for phase, following in zip_longest(problem.phases, problem.phases[1:]):
        _check_end(phase, following)
    for index, goal in enumerate(problem.goals):
        key = name_goal(problem.goals, index)
        _check_goal(problem.scene, goal, key)
        if problem.phases:
            raise InputError("", key, "given with [[phases]]; allowed is one of the two")
    _check_fingers(problem)
    _check_first_formation(problem)


def _check_goal(scene: Scene, goal: Goal, key: str) -> None:
    if (goal.flush is None) == (goal.phi is None):
        text = "flush and phi_deg are both" if goal.phi is not None else "neither flush nor phi_deg"
        raise InputError("", key, f"{text} given; allowed is one of the two")
    if goal.phi is not None:
        TURN.check(f"{key}.phi_deg", round(math.degrees(goal.phi), 9), "degrees")
    else:
        _check_edge(scene, goal.flush, f"{key}.flush")
    if goal.x is not None:
        PLACE.check(f"{key}.x", goal.x, "m", scene)


def read_goals(table: Mapping[str, Any]) -> tuple[Goal, ...]:
    """The goals of a problem file in the order of visits, or an `InputError`."""
    entries, goals = table.get("goal", []), list[Goal]()
    is_list = isinstance(entries, list)
    for index, entry in enumerate(entries if is_list else [entries], start=1):
        key = f"goal[{index}]" if is_list else "goal"
        if not isinstance(entry, Mapping):
            text = f"{entry!r} given; allowed is a table with flush or phi_deg, and x"
            raise InputError("", key, text)
        _table(entry, key, GOAL)
        values = {name: GOAL[name].read(entry[name], f"{key}.{name}") for name in entry}
        if "phi_deg" in values:
            values["phi"] = math.radians(values.pop("phi_deg"))
        goals.append(Goal(**values))
    return tuple(goals)


def name_goal(goals: Sequence[Goal], index: int) -> str:
    """The key of a goal by its index (from 0)."""
    return "goal" if len(goals) == 1 else f"goal[{index + 1}]"


def require_phases(problem: Problem) -> None:
    """Raise an `InputError` if a problem has no phases (a problem for a map needs none)."""
    if not problem.phases:
        text = "is missing, and so is [goal], from which wholearm finds them; "
        text += "`wholearm map FILE --list X,PHI ...` lists [[phases]] along a route"
        if problem.goals:
            text = "is missing; `wholearm route FILE` finds the [[phases]] that lead to the goal: "
            text += "put what it prints, as solve does, into the file"
        raise InputError(problem.source, "phases", text)


def _check_formation(formation: Formation, key: str) -> None:
    """Check that no contact is repeated, and that rolling contacts have friction."""
    contacts = formation.contacts
    if not contacts:
        raise InputError("", key, "[] is not a list of contact names")
    repeated = {contact.name for contact in contacts if contacts.count(contact) > 1}
    if repeated:
        raise InputError("", key, f"{', '.join(sorted(repeated))} is given twice")
    for row in formation.rolling_rows:
        if formation.friction[row] == 0:
            finger = contacts[row].finger
            part = "palm" if finger is None else f"finger{finger + 1}"
            text = f"{contacts[row]} cannot roll without friction, and friction.{part} is 0"
            raise InputError("", key, text)
    if formation.rolling and formation.n_constraints > 4:
        text = (
            f"{len(contacts)} contacts of which {formation.n_rolling} roll leave no freedom to "
            f"move: a rolling one counts twice, which makes {formation.n_constraints}; allowed are "
            "up to 4"
        )
        raise InputError("", key, text)


def _check_until(scene: Scene, phase: Phase, key: str) -> None:
    until = phase.until
    if until.is_release and phase.end is not End.SMOOTH:
        raise InputError("", key, "is missing; only a phase with end = 'smooth' has none")
    if until.contact is not None and until.contact in phase.formation.contacts:
        raise InputError("", key, f"{until} is already in the phase's contacts")
    coordinates = until.coordinates
    for coordinate, target in coordinates:
        if coordinate not in ROWS:
            raise InputError("", key, f"{coordinate!r} given; allowed are 'x' and 'phi'")
        value = require_number(target, key)
        if coordinate == "x":
            PLACE.check(key, value, "m", scene)
        else:
            # Rounding in radians must not matter at the bounds.
            TURN.check(key, round(math.degrees(value), 9), "degrees")
    freedoms = 5 - phase.formation.n_constraints
    if len({name for name, _ in coordinates}) < len(coordinates):
        raise InputError("", key, f"{until} gives a coordinate twice")
    if 1 < freedoms < (count := until.conditions):
        text = f"{until} gives {count} conditions; allowed are {freedoms}, as the contacts leave"
        raise InputError("", key, f"{text} {freedoms} freedoms")


def _check_end(phase: Phase, following: Phase | None) -> None:
    """Check that the transition `end` of a phase is possible."""
    if phase.end is End.REST:
        return
    key, until = f"phases[{phase.number}].end", phase.until
    end_text = f"{phase.end.value!r} given"
    if following is None:
        raise InputError("", key, f"{end_text}, but the last phase ends at rest")
    contacts = following.formation.contacts
    if phase.end is End.IMPACT and until.contact is None:
        raise InputError("", key, f"{end_text}, but until is {until}, not a contact that is gained")
    if phase.end is End.IMPACT and until.contact not in contacts:
        raise InputError("", key, f"{end_text}, but phase {following.number} does not have {until}")
    allowed = {*phase.formation.contacts, until.contact}
    added = [c.name for c in contacts if c not in allowed]
    if added:
        text = f"{end_text}, but phase {following.number} has {', '.join(added)} too"
        raise InputError("", key, text)
    same = set(contacts) == set(phase.formation.contacts)
    same = same and set(following.formation.rolling) == set(phase.formation.rolling)
    if until.is_release and same:
        text = f"phase {following.number} releases no contact, and none rolls or slides anew"
        raise InputError("", key, text)


def _check_fingers(problem: Problem) -> None:
    """Check that the fingers do not overlap at the start."""
    scene = problem.scene
    if not scene.fingers_collide:
        return
    gap = float(evaluate_finger_gap(scene, problem.start[None])[0])
    if gap < -scene.touching:
        text = (
            f"{problem.start[0]:g} closes the fingers into each other: their gap is {gap:.4g} m; "
            "allowed is 0 or more, unless fingers_collide = false; "
        )
        raise InputError("", "start.x", text + describe_reach(scene, float(problem.start[2])))


def _check_first_formation(problem: Problem) -> None:
    """Check that the contacts of the first phase touch; it may release others."""
    if not problem.phases:
        return
    formation, z = problem.phases[0].formation, problem.start[None]
    violation = max(np.abs(formation.evaluate(z, z).C).max(), -formation.evaluate_limits(z).min())
    if violation < problem.scene.touching:
        return
    # Only for the message: this evaluates all contacts.
    touching = find_touching(problem.scene, problem.start)
    first = formation.contacts
    if not set(first) <= set(touching):
        text = f"{describe(first)} given, but the closed fingers touch {describe(touching)}"
        raise InputError("", "phases[1].contacts", text)


def name_keys() -> dict[str, tuple[str, ...]]:
    """Short names for `Problem.with_`, and the dotted keys of each."""
    names: dict[str, tuple[str, ...]] = {key: (key,) for key in TOP}
    names |= {key: (f"object.{key}",) for key in OBJECT}
    names |= {key: (f"start.{key}",) for key in START}
    names |= {f"friction_{key}": (f"friction.{key}",) for key in FRICTION}
    names["friction"] = tuple(f"friction.{key}" for key in FRICTION)
    for finger, field in FINGER.items():
        name = f"finger_{finger}" if finger in OBJECT else finger
        names |= {f"{name}{number}": (f"fingers.{number}.{finger}",) for number in FINGERS}
        if field.kind is not POINT:
            names[name] = tuple(f"fingers.{number}.{finger}" for number in FINGERS)
    for number, (place, axis) in product(FINGERS, enumerate("xy", start=1)):
        names[f"base{number}_{axis}"] = (f"fingers.{number}.base[{place}]",)
    return names


def build_schema() -> dict[str, Any]:
    """The JSON Schema of problem files."""
    tables = {"object": OBJECT, "fingers": FINGERS} | _TABLES
    tables |= {"phase": PHASE, "until": UNTIL, "mode": MODE}
    definitions = {name: _describe(table) for name, table in tables.items()}
    smooth = {"required": ["end"], "properties": {"end": {"const": "smooth"}}}
    definitions["phase"]["anyOf"] = [{"required": ["until"]}, smooth]
    definitions["goal"]["oneOf"] = [{"required": ["flush"]}, {"required": ["phi_deg"]}]
    definitions["until"]["minProperties"] = 1
    definitions |= {
        "contact": CONTACT,
        "point": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "number"}},
        "coefficient": {**NONNEGATIVE.schema, "maximum": COEFFICIENTS.high},
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "wholearm problem",
        "description": "A polygon, a hand of a palm and two fingers, a start, and the contact "
        "formations to go through. SI units.",
        **_describe(TOP),
        "definitions": definitions,
    }


def _describe(table: Table) -> dict[str, Any]:
    return {
        "type": "object",
        "additionalProperties": False,
        "required": [name for name, field in table.items() if field.required],
        "properties": {name: field.schema for name, field in table.items()},
    }


def write_page() -> str:
    """All keys of a problem file, as tables in Markdown."""
    titles = {name: f"`[{name}]`" for name in _TABLES} | {"finger": "`[fingers.1]`, `[fingers.2]`"}
    tables = [("At the top", TOP), *((titles[name], table) for name, table in _TABLES.items())]
    parts = []
    for title, table in [*tables, ("`[[phases]]`", PHASE)]:
        lines = [f"| {title} | unit | default | allowed | |", "|---|---|---|---|---|"]
        for name, field in table.items():
            if name not in _PARTS:
                text = re.sub(r" ?\[[^]]*\]", "", field.text)
                default = "required" if field.required else field.describe_default()
                allowed = ", ".join(filter(None, (bounds.describe() for bounds in field.ranges)))
                lines.append(f"| `{name}` | {field.unit} | {default} | {allowed} | {text} |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)
