"""Reading problems: files in TOML, their nested tables, and the names of contacts.

Every message names the file and the key, says what was given and what is allowed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from typing import Any, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source
from ..common.require import require_number
from ..common.sharing import exclusive
from ..contacts.closing import close_finger, place_flush
from ..contacts.elemental import Contact, parse_contact
from ..contacts.formation import Formation
from ..contacts.reach import name_reach
from ..scene.model import HOLDS, Finger, Friction, Scene
from ..scene.polygon import Polygon
from ..scene.ranges import TURN, check_place, check_ranges
from .definition import End, Phase, Problem, Until
from .goal import read_goals
from .table import name_keys
from .uncertainty import GROUPS as PARAMETER_GROUPS
from .uncertainty import NAMES as PARAMETER_NAMES

_T = TypeVar("_T")

_THERE = 1e-3
"""How far from a goal a plan may end, in radii of gyration and in rad."""

ROLLING = " rolling"
"""Follows the name of a contact that rolls in a phase's `contacts`."""

_OPTIONAL = {
    "name", "gravity", "fingers_collide", "phases", "goal", "settle", "settle_gap", "uncertainty",
    "control_period", "control_hold",
}  # fmt: skip
_TOP = _OPTIONAL | {"epsilon", "object", "fingers", "friction", "start"}
_OBJECT = {"vertices", "mass", "inertia"}
_DEFAULTS = {"radius": 0.0, "viscous": 0.0, "dry": 0.0}
_FINGER = {
    own.name: own.default is MISSING and own.name not in _DEFAULTS
    for own in fields(Finger)
    if own.metadata
}
NAMES = name_keys(_TOP, _FINGER)
"""Short names for `Problem.with_` and the keys that each stands for."""
_ENDS = ", ".join(repr(end.value) for end in End)


def read_problem(path: str) -> Problem:
    """Read and validate a problem file; whether each phase can be reached is not checked here.

    Raises
    ------
    InputError
        If the file cannot be read or anything in it is malformed.
    """
    try:
        with open(path, "rb") as stream:
            content = stream.read()
        if content.startswith(b"PK"):
            text = "is no problem file but an archive, as a trajectory is; the problem comes first"
            raise InputError(str(path), "", text)
        # Editors on Windows may begin a file with a byte order mark.
        table = tomllib.loads(content.decode("utf-8-sig").replace("\r\n", "\n"))
    except OSError as error:
        raise InputError(str(path), "", f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(str(path), "", f"is not TOML: {error}") from None
    except RecursionError:
        raise InputError(str(path), "", "is nested too deeply") from None
    return build_problem(table, str(path))


@exclusive
def build_problem(table: Mapping[str, Any], source: str = "") -> Problem:
    """Validate a problem given as the nested tables of a problem file.

    Raises
    ------
    InputError
        If anything in it is malformed; names `source`.
    """
    with name_source(source):
        return _build_problem(table, source)


def _build_problem(table: Mapping[str, Any], source: str) -> Problem:
    _check_keys(table, "", _TOP, required=_TOP - _OPTIONAL)
    scene = _read_scene(table)
    check_ranges(scene)
    start = _read_start(scene, _table(table, "start"))
    given = table.get("phases", [])
    if not isinstance(given, list):
        raise InputError("", "phases", f"{given!r} is not a list of [[phases]]")
    phases = tuple(_read_phase(scene, i, entry) for i, entry in enumerate(given))
    ranges = _read_ranges(table) if "uncertainty" in table else None
    name = table.get("name", "unnamed")
    return Problem(
        name,
        scene,
        table["epsilon"],
        start,
        phases,
        source,
        table,
        ranges,
        settle=table.get("settle", 0.0),
        settle_gap=table.get("settle_gap"),
        goals=read_goals(table),
    )


def read_own_problem(meta: Mapping[str, Any], source: str = "") -> Problem:
    """The problem whose tables the `meta` of a trajectory carries along.

    Raises
    ------
    InputError
        If there is none, or it is malformed; names `source`, the file of the trajectory.
    """
    table = meta.get("problem")
    if not isinstance(table, Mapping) or not table:
        raise InputError(
            source, "meta.problem", "the trajectory does not hold its problem's tables"
        )
    try:
        return build_problem(table)
    except InputError as error:
        raise InputError(source, f"meta.problem.{error.key}", error.problem) from None


def adopt_phases(problem: Problem, meta: Mapping[str, Any], q: Array, source: str = "") -> Problem:
    """The problem with the phases that a plan has found, where it has goals in their place.

    Parameters
    ----------
    problem : Problem
    meta : mapping
        Of the plan.
    q : ndarray, shape (3,), [m, m, rad]
        Where the plan ends.
    source : str
        The plan's file.

    Raises
    ------
    InputError
        If the plan does not hold its problem, or ends elsewhere than at the last goal.
    """
    if not problem.goals:
        return problem
    goal, (x, _, phi) = problem.goals[-1], q.tolist()
    turned = abs(goal.find_angle(problem.scene, phi) - phi) > _THERE
    if turned or (goal.x is not None and abs(goal.x - x) > _THERE * problem.scene.scales.length):
        place = f"x = {1e3 * x:.4g} mm, phi = {math.degrees(phi):.4g} deg"
        raise InputError(source, "goal", f"the plan ends at {place}, and not with {goal}")
    return replace(problem, phases=read_own_problem(meta, source).phases, goals=())


def _read_scene(table: Mapping[str, Any]) -> Scene:
    body = _table(table, "object")
    _check_keys(body, "object", _OBJECT, required=_OBJECT - {"inertia"})
    polygon = Polygon(body["vertices"], body["mass"], body.get("inertia"))
    fingers = _table(table, "fingers")
    _check_keys(fingers, "fingers", {"1", "2"}, required={"1", "2"})
    friction = _table(table, "friction")
    parts = {"palm", "finger1", "finger2"}
    _check_keys(friction, "friction", parts, required=parts)
    return Scene(
        polygon,
        (_read_finger(fingers, "1"), _read_finger(fingers, "2")),
        Friction(friction["palm"], friction["finger1"], friction["finger2"]),
        table.get("gravity", 9.81),
        table.get("fingers_collide", True),
        table.get("control_period", 0.0),
        table.get("control_hold", HOLDS[0]),
    )


def _read_ranges(table: Mapping[str, Any]) -> Mapping[str, float]:
    given = _table(table, "uncertainty")
    _check_keys(given, "uncertainty", {*PARAMETER_GROUPS, *PARAMETER_NAMES}, required=set())
    return given


def _read_finger(fingers: Mapping[str, Any], key: str) -> Finger:
    name = f"fingers.{key}"
    entry = _table(fingers, key, name)
    _check_keys(entry, name, set(_FINGER), required={k for k, needed in _FINGER.items() if needed})
    return Finger(**(_DEFAULTS | dict(entry)), name=name)


def _read_start(scene: Scene, start: Mapping[str, Any]) -> Array:
    _check_keys(start, "start", {"flush", "x"}, required={"flush", "x"})
    edge, count = start["flush"], scene.polygon.n_vertices
    if not isinstance(edge, int) or isinstance(edge, bool) or not 0 <= edge < count:
        raise InputError(
            "", "start.flush", f"{edge!r} is not an edge; allowed are 0 to {count - 1}"
        )
    return place_start(scene, edge, require_number(start["x"], "start.x"))


@exclusive
def place_start(scene: Scene, flush: int, x: float) -> Array:
    """The configuration with an edge flush on the palm and both fingers closed, shape (5,).

    Parameters
    ----------
    scene : Scene
    flush : int
        The edge.
    x : float, [m]
        Of the object's centroid.

    Raises
    ------
    InputError
        If `x` is out of its range, or a finger does not reach the object.
    """
    check_place(scene, "start.x", x)
    q = place_flush(scene, flush, x)
    try:
        z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    except InputError as error:
        text = f"{error.problem}; {name_reach(scene, float(q[2]))}"
        raise InputError(error.source, error.key, text) from error
    z.setflags(write=False)
    return z


def _read_phase(scene: Scene, index: int, entry: object) -> Phase:
    key = f"phases[{index + 1}]"
    if not isinstance(entry, dict):
        raise InputError("", key, f"{entry!r} is not a table")
    _check_keys(entry, key, {"contacts", "until", "end", "settle"}, required={"contacts"})
    names = entry["contacts"]
    if not isinstance(names, list) or not names:
        raise InputError("", f"{key}.contacts", f"{names!r} is not a list of contact names")
    formation = _at(f"{key}.contacts", lambda: read_formation(scene, names))
    given = entry.get("end", End.REST.value)
    if given not in [end.value for end in End]:
        raise InputError("", f"{key}.end", f"{given!r} given; allowed are {_ENDS}")
    until, end = Until(), End(given)
    if "until" in entry:
        until = _at(f"{key}.until", lambda: read_until(scene, entry["until"]))
    return Phase(index, formation, until, end, entry.get("settle"))


def read_formation(scene: Scene, names: Sequence[object]) -> Formation:
    """The formation of contacts by name, each sliding unless its name is followed by ``rolling``.

    Raises
    ------
    InputError
        If there is no such contact.
    """
    stems = [n.removesuffix(ROLLING) if isinstance(n, str) else n for n in names]
    contacts = tuple(_parse_name(stem, scene) for stem in stems)
    rolls = [stem != name for stem, name in zip(stems, names, strict=True)]
    rolling = tuple(contact for contact, own in zip(contacts, rolls, strict=True) if own)
    return Formation(scene, contacts, rolling)


def _parse_name(name: object, scene: Scene) -> Contact:
    try:
        return parse_contact(name, scene)
    except InputError as error:
        if isinstance(name, str) and " " in name:
            raise InputError("", "", f"{error.problem}; {ROLLING!r} may follow") from None
        raise


def read_until(scene: Scene, given: object) -> Until:
    """What ends a phase: the name of a contact, or a table of ``contact``, ``phi_deg`` and ``x``.

    Without a contact the first coordinate ends the phase; what else is given has to hold there.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if isinstance(given, str):
        return Until(contact=parse_contact(given, scene))
    allowed = "allowed are a contact name, or a table with contact, phi_deg or x, or several"
    if not isinstance(given, dict) or not given or not set(given) <= {"contact", "phi_deg", "x"}:
        raise InputError("", "", f"{given!r} does not end a phase; {allowed}")
    pins = tuple(_read_pin(key, value) for key, value in given.items() if key != "contact")
    if "contact" in given:
        return Until(contact=parse_contact(given["contact"], scene), pins=pins)
    (coordinate, value), *others = pins
    return Until(None, coordinate, value, tuple(others))


def _read_pin(key: str, value: object) -> tuple[str, float]:
    number = require_number(value, "")
    if key == "x":
        return key, number
    TURN.check("", number, "degrees")
    return "phi", math.radians(number)


def _at(key: str, read: Callable[[], _T]) -> _T:
    """Run `read`, giving the key to an error that does not know its own."""
    try:
        return read()
    except InputError as error:
        raise InputError("", key, error.problem) from None


def _table(parent: Mapping[str, Any], key: str, name: str = "") -> Mapping[str, Any]:
    value = parent[key]
    if not isinstance(value, dict):
        raise InputError("", name or key, f"{value!r} is not a table")
    return value


def _check_keys(
    table: Mapping[str, Any], where: str, allowed: set[str], required: set[str]
) -> None:
    prefix = f"{where}." if where else ""
    for key in table:
        if key not in allowed:
            from difflib import get_close_matches

            near = get_close_matches(key, allowed, 1, 0.5)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise InputError(
                "", f"{prefix}{key}", f"unknown key; {hint}allowed are {', '.join(sorted(allowed))}"
            )
    for key in sorted(required - set(table)):
        raise InputError("", f"{prefix}{key}", "is missing")
